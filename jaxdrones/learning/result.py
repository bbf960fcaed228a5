"""Training loop, its state and result, and optimizers."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, Protocol, Self, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Int

from jaxdrones.accelerate.compiler import is_inside_jit
from jaxdrones.arguments import Key, Scalar, checked
from jaxdrones.checks import check_function, is_concrete, short_repr
from jaxdrones.envs import Env
from jaxdrones.errors import UserError
from jaxdrones.learning import collect, compilation
from jaxdrones.learning.metrics import with_unknown, without_unknown
from jaxdrones.learning.networks import OwnNetwork, Policy
from jaxdrones.learning.settings import Config, check_config, check_environment
from jaxdrones.pytree import PyTreeNode

MAX_CALL = 64
"""Largest number of updates in one call of a compiled program."""
PATIENCE = 10
"""Number of consecutive updates with gradients that are not finite at which a training counts as diverged."""

_RATE_FACTOR = 1.2  # factor of an adaptation of the learning rate

SMALLER = "try a smaller learning rate, for example learning_rate=1e-3"
_NEVER_FINITE = (
    "no update had finite gradients, so the learning rate is not the cause: look in the task for NaN, large rewards, "
    "and roots or norms of zero, whose gradient is not finite"
)


class Diverged(RuntimeError):
    """Diverged training: parameters or gradients are not finite."""


class TrainState(PyTreeNode):
    """Complete state of a training."""

    step: Array
    """() number of updates."""
    key: Array
    policy: Policy
    opt_state: optax.OptState
    worlds: collect.Worlds

    def with_policy(self, policy: Policy) -> Self:
        """State before the first update of a training that starts from a policy."""
        return self.replace(policy=policy)


Settings = TypeVar("Settings", bound=Config, contravariant=True)
Callback = Callable[[int, dict[str, float], Any], Any]
"""(updates made, metrics of the newest update, training state) -> True to stop the training."""


class Result(PyTreeNode):
    """Trained policy, training state and history."""

    policy: Policy
    train_state: Any
    """State for further training."""
    history: dict[str, Array]
    """(updates,) every metric of `update`. `nonfinite_gradients` counts the gradients of an update that were not
    finite, and so replaced by zero."""

    def __repr__(self) -> str:
        return f"<Result: {self.policy!r}, history of {', '.join(self.history)}>"


def init_policy(key: jax.Array, env: Env, config: Config, network: Any) -> Policy:
    """Policy before the first update, with the network of the settings or of the user."""
    sizes = (config.recurrent_size, network, config.set_sizes)
    return Policy.init(key, env, config.hidden_sizes, config.per_agent, *sizes)


class Train(Protocol[Settings]):
    """The `train` of a learner; see `make_train`."""

    def __call__(
        self,
        key: jax.Array,
        env: Env,
        config: Settings,
        *,
        network: Any = None,
        callback: Callback | Sequence[Callback] = (),
        state: Any = None,
    ) -> Result:
        """Make all updates."""


def make_train(kind: type[Settings], init: Callable, update: Callable) -> Train[Settings]:
    """Build the `train` of a learner from its settings, `init(key, env, config, network)` and `update`."""

    def train(
        key: Key,
        env: Env,
        config: Settings,
        *,
        network: Any = None,
        callback: Callback | Sequence[Callback] = (),
        state: Any = None,
    ) -> Result:
        """Make all updates.

        Inside `jax.jit` or `jax.vmap`, or with traced settings, the updates become part of that function. Otherwise the
        program is compiled and cached for equal settings and the same environment.

        Args:
            key: random key; unused with a `state`.
            env: environment.
            config: settings of the learner.
            network: a flax linen, flax nnx or equinox module in place of the network of the settings; see
                `learning.networks.OwnNetwork`.
            callback: function, or several, called after every update; see `Callback`.
            state: state to continue from, the `train_state` of a result with the same worlds, network and episodes; up
                to `config.updates` updates in total, or as many more if the state is traced, so that its number of
                updates is unknown. Vehicle, action type and rewards may differ.

        Raises:
            ValueError: no random key, the settings of another learner, or a state that does not fit them or is without
                updates left.
            Diverged: gradients that are not finite in `PATIENCE` updates in a row. Inside `jax.jit` nothing is raised;
                see `history["nonfinite_gradients"]`.
        """
        check_environment(env)
        check_config(config, kind)
        callbacks = (callback,) if callable(callback) else tuple(callback or ())
        if not all(map(callable, callbacks)):
            raise UserError(f"callback is {short_repr(callback)}; give functions (update, metrics, state)")
        for one in callbacks:
            check_function("callback", one, ("update", "metrics", "state"))
        if state is not None:
            _check_state(state, functools.partial(init, env=env, config=config), network)
        if not is_concrete(config.updates):
            raise UserError("config.updates is traced; give a number, or take each `update` yourself")
        made = int(state.step) if state is not None and is_concrete(state.step) else 0
        if made >= config.updates:
            raise UserError(f"state has made {made} updates; give more updates, config.updates is {config.updates}")
        if is_inside_jit() or not all(map(is_concrete, (key, *vars(config).values()))):
            if callbacks:
                raise UserError("callback is not supported inside jax.jit and jax.vmap; call train outside")
            state = init(key, env, config, network) if state is None else state
            length: Any = config.updates - made
            state, history = jax.lax.scan(lambda state, _: update(env, config, state), state, length=length)
            return Result(state.policy, state, history)
        start, program = _programs(init, update, env, config)
        if state is None:
            state = start(key) if network is None else init(key, env, config, network)
        total, step = int(config.updates), made
        rows, streak, stop = [], 0, False
        while step < total and not stop:
            count = 1 if callbacks else min(MAX_CALL, total - step)
            state, metrics = program(state, jnp.asarray(count, jnp.int32), jnp.asarray(total, jnp.int32))
            rows.append({name: x[:count] for name, x in metrics.items()})
            step += count
            nonfinite = rows[-1]["nonfinite_gradients"]
            if is_concrete(nonfinite):  # not so when an environment with traced parameters is mapped
                streak = check_gradients(np.asarray(nonfinite), min(PATIENCE, total), streak, step - count)
            newest = with_unknown({name: x[0] for name, x in rows[-1].items()}) if callbacks else {}
            values = {name: x.item() for name, x in newest.items()}
            stop = any([_is_true(call(step, values, state)) for call in callbacks])
        history = with_unknown({name: jnp.concatenate([row[name] for row in rows]) for name in rows[0]})
        return Result(state.policy, state, history)

    train.__module__, train.__qualname__ = kind.__module__, "train"
    return checked(train)


def _is_true(answer: Any) -> bool:
    """Whether the answer of a callback is a true boolean, of Python, NumPy or JAX."""
    is_array = isinstance(answer, np.bool_ | np.ndarray | jax.Array) and answer.dtype == bool and answer.ndim == 0
    return bool(answer) if is_array else answer is True


def _check_state(state: Any, init: Callable, network: Any) -> None:
    """Raise unless a training of the network can continue from a state, whose shapes are then those of `init(key)`."""
    if not isinstance(state, TrainState):
        raise UserError(f"state is {short_repr(state)}; give the train_state of a result")
    if network is None and isinstance(state.policy.network, OwnNetwork):
        network = state.policy.network.module
    expected = jax.eval_shape(lambda: init(jax.random.key(0), network=network))
    if type(state) is not type(expected):
        raise UserError(f"state is of {type(state).__module__}; give one of {type(expected).__module__}")
    shapes, found = (
        {jax.tree_util.keystr(path): jnp.shape(x) for path, x in jax.tree_util.tree_leaves_with_path(tree)}
        for tree in (expected, state)
    )
    remedy = "continue with the environment, the worlds and the network that the state was trained with"
    for name in shapes | found:
        if shapes.get(name) != found.get(name):
            of_state, of_init = found.get(name, "none"), shapes.get(name, "none")
            raise UserError(f"state{name} has shape {of_state}, expected {of_init}; {remedy}")
    structures: list[Any] = [jax.tree.structure(x.worlds) for x in (expected, state)]
    if structures[0] != structures[1]:
        raise UserError(f"state is of another task or control period; {remedy}")


def advance(update: Callable, env: Env, config: Any, state: Any, count: Array, total: Array) -> tuple[Any, dict]:
    """Run `count` updates, at most `MAX_CALL`, of a training of `total`.

    The metrics are arrays (MAX_CALL,) for `metrics.with_unknown`.
    """

    @jax.jit  # traced once, for the shapes and the loop
    def updated(state: Any, total: Array) -> tuple[Any, dict]:
        state, metrics = update(env, dataclasses.replace(config, updates=total), state)
        return state, without_unknown(metrics)

    metrics = jax.tree.map(lambda x: jnp.zeros((MAX_CALL, *x.shape), x.dtype), jax.eval_shape(updated, state, total)[1])

    def body(i: Array, carry: tuple[Any, dict]) -> tuple[Any, dict]:
        state, metrics = carry
        state, new = updated(state, total)
        return state, jax.tree.map(lambda all, x: all.at[i].set(x), metrics, new)

    return jax.lax.fori_loop(0, count, body, (state, metrics))


def _programs(init: Callable, update: Callable, env: Env, config: Any) -> tuple[Callable, Callable]:
    try:
        return _cached_programs(init, update, env, config)
    except TypeError:  # settings that cannot be hashed, such as arrays
        return _cached_programs.__wrapped__(init, update, env, config)


@functools.lru_cache(maxsize=8)
def _cached_programs(init: Callable, update: Callable, env: Env, config: Any) -> tuple:
    start = compilation.jit(lambda key: init(key, env, config), env)
    return start, compilation.jit(functools.partial(advance, update, env, config), env, config)


def check_gradients(
    nonfinite: Sequence[int] | np.ndarray, patience: int = PATIENCE, before: int = 0, made: int = 0
) -> int:
    """Raise `Diverged` after `patience` consecutive updates with gradients that are not finite.

    `nonfinite` (updates,) is their number in each update, `before` the number of such updates in a row before these,
    and `made` the number of all updates before these. Return the new `before`.
    """
    streak = before
    for update, count in enumerate(nonfinite, made + 1):
        streak = streak + 1 if count else 0
        if streak >= patience:
            advice = SMALLER if streak < update else _NEVER_FINITE
            raise Diverged(f"gradients were not finite in {streak} updates in a row; {advice}")
    return streak


def cosine_adam(
    learning_rate: Scalar, steps: Scalar, max_grad_norm: Scalar, adam_b2: Scalar = 0.999
) -> optax.GradientTransformation:
    """Adam with clipped gradients and a cosine decay of the learning rate to zero in a number of steps.

    All parameters are flattened to one vector, which compiles faster; `adam_b2` is the decay rate of the mean of
    squared gradients.
    """

    def schedule(step):  # optax.cosine_decay_schedule, for a traced number of steps
        return learning_rate * (0.5 * (1 + jnp.cos(jnp.pi * jnp.minimum(step, steps) / steps)))

    return optax.flatten(optax.chain(clip_gradient(max_grad_norm), optax.adam(schedule, b2=adam_b2)))


def adapted_learning_rate(config: Any, updates: Scalar, learning_rate: Scalar, kl: Scalar) -> Array:
    """Learning rate of PPO after `updates` updates, adapted to the divergence from the behavior policy."""
    raised = jnp.where(kl < config.target_kl / 2, _RATE_FACTOR, 1)
    factor = jnp.where(kl > 2 * config.target_kl, 1 / _RATE_FACTOR, raised)
    high = annealed(config, updates, config.max_learning_rate, config.min_learning_rate)
    return jnp.clip(learning_rate * factor, config.min_learning_rate, high)


def annealed(config: Any, updates: Scalar, high: Scalar, low: Scalar) -> Array:
    """Geometric decay from `high` to `low` in the last updates."""
    remaining = jnp.clip((1 - updates / config.updates) / jnp.maximum(config.anneal_fraction, 1e-6), 0, 1)
    return low * (high / low) ** remaining


def clip_gradient(max_grad_norm: Scalar) -> optax.GradientTransformation:
    """Scale gradients to a norm of at most `max_grad_norm`; replace those that are not finite by zero."""

    def update(gradient, state, params=None):
        norm = optax.tree.norm(gradient)
        finite = jnp.isfinite(norm)
        scale = jnp.where(finite, jnp.minimum(1, max_grad_norm / jnp.where(norm > 0, norm, 1)), 0)
        return jax.tree.map(lambda g: jnp.where(finite, g, 0) * scale.astype(g.dtype), gradient), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), update)


def count_nonfinite(norm: Array) -> Int[Array, ""]:
    """Number of gradients with a norm that is not finite."""
    return jnp.sum(~jnp.isfinite(norm))
