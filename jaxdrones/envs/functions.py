"""Validation of users' functions (of tasks, scenes and policies) and of the calling process."""

import functools
import os
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.checks import check_function, check_params, is_concrete, short_repr
from jaxdrones.control import Setpoint
from jaxdrones.engine.team import check_state
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.state import State
from jaxdrones.tasks.task import ObservationTerm, Task, World
from jaxdrones.user_code import place

DrawScene = Callable[[jax.Array], Scene]
"""(key) -> scene of an episode."""
_NUMBERS = "biuf"  # kinds of dtypes
_DRAWS = 64  # random keys, with which functions of users are called
_processes: set[int] = set()  # in which environments were made


def check_process() -> None:
    """Raise in a process forked after environments were made, where JAX would hang."""
    if os.getpid() not in _processes:
        if _processes:
            raise RuntimeError(
                f"process {os.getpid()} was forked from process {next(iter(_processes))}, in which JAX runs, and JAX "
                "hangs in a forked process; start processes by 'spawn', for example "
                "gymnasium.vector.AsyncVectorEnv(..., context='spawn')"
            )
        _processes.add(os.getpid())


def scene_example(scene: Scene | DrawScene) -> Scene:
    """Scene, or shapes and types of a random scene."""
    if isinstance(scene, Scene):
        return scene
    if not callable(scene):
        raise UserError(f"scene is {short_repr(scene)}; give a jaxdrones.sensing.Scene, or a function of a key")
    check_function("scene", scene, ("key",))
    example = jax.eval_shape(scene, jax.random.key(0))
    if not isinstance(example, Scene):
        returned = short_repr(scene(jax.random.key(0)))
        raise UserError(f"the function that draws the scene returned {returned}; return a jaxdrones.sensing.Scene")
    return example


def is_own(function: Any) -> bool:
    """Whether a function belongs to this library, and so needs no check."""
    return str(getattr(getattr(function, "func", function), "__module__", "")).startswith("jaxdrones.")


def check_episode(
    task: Task,
    params: Params,
    draws: Sequence[Callable],
    scene: Any,
    terms: Sequence[ObservationTerm],
    dt: float,
    first_world: Callable[[jax.Array], World],
    noise: Callable | None = None,
    disturbance: Callable | None = None,
) -> list[int]:
    """Validate the results of users' functions by tracing them; those of starts and randomizations for some keys.

    The arguments are those of the environment; `first_world` is `(key) -> world` at the start of an episode, with the
    first readings of the sensors. Return the length of each observation term of a drone.

    Raises:
        UserError: an invalid result; the message names the function and its file.
    """
    one = jax.tree.map(lambda x: x[0], params)

    def sizes(key: jax.Array) -> list[Any]:
        for k, function in enumerate(draws, 1):
            _check_replaced("a randomization", function, jax.random.fold_in(key, k), one)
        _check_start(task, params, scene, jax.random.fold_in(key, 0))
        world = first_world(key)
        noise_key, disturbance_key = (jax.random.fold_in(key, len(draws) + i) for i in (1, 2))
        if noise is not None:
            _check_replaced("noise", noise, noise_key, world.drones)
        if disturbance is not None:
            _check_replaced("disturbance", disturbance, disturbance_key, world.params, dt)
        _check_functions(task, world, dt)
        _check_terms(task, terms, world)
        return [term.observe(task, world) for term in terms]

    lengths = [x.shape[-1] for x in jax.eval_shape(sizes, jax.random.key(0))]
    for function in draws:
        if not is_own(function):
            _check_values("a randomization", function, lambda key, draw=function: draw(key, one), check_params)
    if not is_own(task.start):
        check = functools.partial(check_state, "state")
        _check_values("start", task.start, lambda key: task.begin(key, params, _scene_of(scene, key))[0], check)
    return lengths


def _scene_of(scene: Scene | DrawScene, key: jax.Array) -> Scene:
    return scene if isinstance(scene, Scene) else scene(jax.random.fold_in(key, 1))


def _check_values(what: str, function: Callable, draw: Callable, check: Callable) -> None:
    """Check the values that a user's function draws with some random keys, unless they are traced."""
    drawn = jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(0), _DRAWS))
    if not all(map(is_concrete, jax.tree.leaves(drawn))):
        return
    drawn = jax.device_get(drawn)
    try:
        for i in range(_DRAWS):
            check(jax.tree.map(lambda x, i=i: x[i], drawn))
    except UserError as error:
        raise UserError(f"{where_is(what, function)} returns values that cannot fly: {error}") from None


def _check_start(task: Task, params: Params, scene: Any, key: jax.Array) -> None:
    """Raise unless a task's start returns the state of the team and the task's variables."""
    if is_own(task.start):
        return
    where, n = where_is("start", task.start), task.drones
    returned = task.begin(key, params, _scene_of(scene, key))
    if not (isinstance(returned, tuple) and len(returned) == 2 and isinstance(returned[0], State)):
        raise UserError(f"{where} returns {kind_of(returned)}; return a State of the team and the task's variables")
    _check_like(where, "a state", returned[0], State.at_rest(jnp.zeros((n, 3))))
    _check_arrays(f"{where} returns variables", returned[1])


def equipped(task: Task, params: Params) -> Params:
    """Parameters of a team with the constants of the task's models."""
    returned = task.equip(params)
    if not is_own(task.equip):
        where, n = where_is("equip", task.equip), task.drones
        if not isinstance(returned, Params):
            raise UserError(f"{where} returns {kind_of(returned)}; return params.replace(...)")
        _check_like(where, "parameters", returned, params)
        check_params(returned)
        for leaf in jax.tree.leaves(returned.aux):
            if (shape_of(leaf) or ())[:1] != (n,):
                raise UserError(f"{where} returns parameters whose aux has {kind_of(leaf)}; give an array ({n}, ...)")
    return returned


def _check_replaced(what: str, function: Callable, key: jax.Array, given: State | Params, *dt: float) -> None:
    """Raise unless a function of a state or of parameters returns one with arrays of the same shapes."""
    returned = function(key, given, *dt)
    if not is_own(function):
        where, name = where_is(what, function), "params" if isinstance(given, Params) else "state"
        if not isinstance(returned, type(given)):
            raise UserError(f"{where} returns {kind_of(returned)}; return {name}.replace(...)")
        _check_like(where, {"params": "parameters", "state": "a state"}[name], returned, given)


def _check_terms(task: Task, terms: Sequence[ObservationTerm], world: World) -> None:
    """Raise unless each observation term returns a row of numbers for every drone."""
    n = task.drones
    for term in terms:
        if is_own(term.observe):
            continue
        where = where_is(f"observation {term.name!r}", term.observe)
        x = term.observe(task, world)
        shape = shape_of(x)
        if shape is None or len(shape) != 2 or shape[0] != n or shape[1] == 0:
            raise UserError(f"{where} returns {kind_of(x)}; return an array ({n}, d), one row for every drone")
        if jnp.result_type(x).kind not in "iuf":
            raise UserError(f"{where} returns {kind_of(x)}; return real numbers")
        if shape_of(again := term.observe(task, world)) != shape:
            raise UserError(f"{where} returns {kind_of(x)}, and {kind_of(again)} when called again; keep its shape")
        if term.rows and shape[1] % term.rows:
            raise UserError(f"{where} returns {shape[1]} numbers in {term.rows} rows; give rows of equal length")
        for name, given in ("bound", term.bound), ("entries", term.entries):
            if isinstance(given, tuple) and given and len(given) != shape[1]:
                raise UserError(f"{where} returns {shape[1]} numbers and has {len(given)} in {name}; give one for each")


def _check_functions(task: Task, world: World, dt: float) -> None:
    """Validate target, rewards, conditions, metrics, `advance` and `success` in a traced world at the start."""
    n = task.drones
    if not is_own(task.target):
        where, target = where_is("target", task.target), task.target(world.variables, world.time)
        if not isinstance(target, Setpoint):
            raise UserError(f"{where} returns {kind_of(target)}; return Setpoint.at(pos), pos of shape ({n}, 3)")
        _check_like(where, "a target", target, Setpoint.at(jnp.zeros((n, 3))))
    if not is_own(task.advance):
        where = where_is("advance", task.advance)
        check_kept(where, "variables", world.variables, task.advance(task, world))
    for name, (_, term) in task.rewards.items():
        _check_one_each(f"reward {name!r}", term, n, (task, world))
    for kind, conditions in ("termination", task.terminations), ("truncation", task.truncations):
        for name, condition in conditions.items():
            _check_one_each(f"{kind} {name!r}", condition, n, (task, world), "b")
    for name, metric in task.metrics.items():
        _check_one_each(f"metric {name!r}", metric, n, (task, world))
    if not (task.success is None or is_own(task.success)):
        metrics = {name: jnp.stack([x] * _ROWS) for name, x in task.measure(world).items()}
        _check_one_each("success", task.success, n, (metrics, dt), "b")


def check_policy(name: str, policy: Any, obs: Any, shape: tuple[int, int]) -> None:
    """Raise unless a policy, recurrent or not, returns actions of this shape for observations (or their shapes)."""

    def act(obs):
        state, action = None, None
        if hasattr(policy, "initial_hidden_state"):
            state = policy.initial_hidden_state((shape[0],))
            _check_arrays(f"{name}: initial_hidden_state returns a hidden state", state)
            returned = policy.act(state, obs)
            if not (isinstance(returned, tuple) and len(returned) == 2):
                raise UserError(f"{name}: act returns {kind_of(returned)}; return the hidden state and the actions")
            check_kept(f"{name}: act", "hidden state", state, returned[0])
            action = returned[1]
        else:
            action = policy(obs)
        if shape_of(action) != shape:
            what = f"return actions of shape {shape}, one row for every drone"
            raise UserError(f"{name} returns {kind_of(action)}; {what}")
        if jnp.result_type(action).kind not in "iuf":
            raise UserError(f"{name} returns {kind_of(action)}; return real numbers")
        return 0

    jax.eval_shape(act, obs)


_ROWS = 100  # of the metrics for the trial call of `success`


def _check_one_each(what: str, function: Callable, n: int, arguments: tuple, kinds: str = _NUMBERS) -> None:
    """Raise unless a function returns one number or boolean for each of n drones."""
    if is_own(function):
        return
    x = function(*arguments)
    wanted = "boolean" if kinds == "b" else "number"
    if shape_of(x) != (n,) or jnp.result_type(x).kind not in kinds:
        where = where_is(what, function)
        raise UserError(f"{where} returns {kind_of(x)}; return one {wanted} for every drone, an array ({n},)")


def _check_like(where: str, what: str, given: Any, wanted: Any) -> None:
    for field, like in vars(wanted).items():
        if field == "aux" or like is None:
            continue
        x = getattr(given, field)
        kinds = "f" if isinstance(wanted, State) else "iuf"  # a state is integrated
        if shape_of(x) != np.shape(like) or jnp.result_type(x).kind not in kinds:
            wants = f"give an array {np.shape(like)} of {like.dtype}"
            raise UserError(f"{where} returns {what} whose {field} is {kind_of(x)}; {wants}")


def check_kept(where: str, what: str, before: Any, after: Any) -> None:
    """Raise unless a tree keeps its structure, shapes and types from step to step."""
    _check_arrays(f"{where} returns {what}", after)
    leaves, structure = jax.tree.flatten(before)
    others, other = jax.tree.flatten(after)
    if str(structure) != str(other):
        raise UserError(f"{where} returns {what} {other}, not {structure}; return the same kind of tree")
    for x, y in zip(leaves, others, strict=True):
        same = jnp.result_type(x) == jnp.result_type(y) or getattr(x, "weak_type", not hasattr(x, "dtype"))
        if np.shape(x) != np.shape(y) or not same:
            raise UserError(
                f"{where} returns {what} with {kind_of(y)}, which was {kind_of(x)}; keep its shape and type"
            )


def _check_arrays(what: str, tree: Any) -> None:
    for leaf in jax.tree.leaves(tree):
        if shape_of(leaf) is None:
            raise UserError(f"{what} that hold {short_repr(leaf)}; give arrays and numbers")


def shape_of(x: Any) -> tuple[int, ...] | None:
    """Shape of an array or a number; `None` otherwise."""
    if isinstance(x, jax.Array | np.ndarray | np.generic | bool | int | float | complex):
        return np.shape(x)
    return None


def kind_of(x: Any) -> str:
    """Shape and type of an array, or the representation of another value, for error messages."""
    shape = shape_of(x)
    if isinstance(x, jax.Array | np.ndarray) and shape is not None:
        return f"an array {shape} of {x.dtype}"
    return short_repr(x)


def where_is(what: str, function: Any) -> str:
    """Role and location of a function of a task, for error messages."""
    where = place(function)
    return f"{where}: {what}" if where else what
