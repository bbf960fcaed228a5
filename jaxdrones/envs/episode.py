"""Phases of an episode: start, command and outcome of a control step. `env` is an `Env`."""

import functools
import math
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdrones.checks import short_repr
from jaxdrones.engine.step import HostStep
from jaxdrones.envs import randomize
from jaxdrones.envs.functions import scene_example
from jaxdrones.envs.observations import observe
from jaxdrones.errors import UserError
from jaxdrones.sensing import Scene
from jaxdrones.sensing.sensor import hold_between, init_sensors, measure_sensors
from jaxdrones.state import State
from jaxdrones.tasks.task import Task, World

DISTURBANCE, NOISE, START, RANDOMIZE, RESET, SENSORS, SCENE, VISION = range(8)
"""Random streams to fold into a key, so that only used draws cost time."""

P = ParamSpec("P")
R = TypeVar("R")
Key = Any  # a random key; `None` where nothing is drawn
_AWAY, _APART = 1e4, 100.0  # m: place of the drones whose episode has ended, and distance between them


def in_full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Multiply the matrices of a function in the precision of their type; GPUs round float32 to 10 bits by default."""

    @functools.wraps(function)
    def called(*arguments: P.args, **named: P.kwargs) -> R:
        with jax.default_matmul_precision("highest"):
            return function(*arguments, **named)

    return called


def check_period(env: Any) -> None:
    """Raise unless a step of the physics takes one control period, and a camera takes no more than one image in it."""
    if env.vision:
        env.vision.every(env.dt)
    period = env.physics.period
    if period is not None and not math.isclose(period, env.dt, rel_tol=1e-6):
        raise UserError(
            f"dt is {env.dt:.4g} s, and a step of the physics takes {period:.4g} s; make another environment, with "
            f"control_hz={1 / env.dt:.4g}"
        )


def has_solid(task: Task, scene: Scene) -> bool:
    """Whether a scene has obstacles that are solid for the drones of a task."""
    return scene.has_obstacles and ("obstacles" in task.contact or not task.obstacles_terminate)


def check_scene(env: Any) -> None:
    """Raise for a scene whose obstacles are not those of the physics, as one that replaces that of an environment."""
    step, scene = env.physics, scene_example(env.scene)
    if isinstance(step, HostStep):
        flat: Any = [jax.tree.flatten(x) for x in (scene, step.scene)]
        (given, structure), (own, own_structure) = flat
        same = structure == own_structure and all(map(np.array_equal, given, own))
        known = same or scene is not env.scene  # a random one is an argument of every call
    else:
        known = step.physics.takes_scene or not has_solid(env.task, scene)
    if not known:
        raise UserError(
            "the physics of the environment does not have the obstacles of its scene; make another environment, with "
            "this scene"
        )


def check_world(env: Any, world: Any) -> None:
    """Raise unless a world is of the task and the control period of an environment."""
    if isinstance(world, World) and (world.task, world.dt) == (env.task.name, env.dt):
        return
    given = f"of the task {world.task!r}, dt {world.dt:.4g} s" if isinstance(world, World) else short_repr(world)
    raise UserError(
        f"world is {given}; the environment has the task {env.task.name!r}, dt {env.dt:.4g} s: give a world of its own "
        "reset or step"
    )


def start(env: Any, key: jax.Array, progress: float | Array = 1.0) -> World:
    """World at the start of an episode, before the first measurement."""
    params = randomize.draw(env.draws, jax.random.fold_in(key, RANDOMIZE), env.params)
    scene = env.scene if isinstance(env.scene, Scene) else env.scene(jax.random.fold_in(key, SCENE))
    known = randomize.scaling_params(env.randomize, params, env.params)
    drones, variables = env.task.begin(jax.random.fold_in(key, START), known, scene, progress)
    history = max(2, math.ceil(env.delay_steps[1]) + 1, *(term.history for term in env.terms))  # 2 for `action_change`
    return World(
        params=params,
        drones=env.physics.init(params, drones),
        variables=jax.tree.map(_strongly_typed, variables),
        memory=env.action.team_memory(env.drones),
        actions=jnp.zeros((env.drones, history, env.action_size), drones.pos.dtype),
        step=jnp.zeros((), jnp.int32),
        active=jnp.ones(env.drones, bool),
        dt=env.dt,
        scene=scene,
        task=env.task.name,
    )


def _strongly_typed(x: Any) -> Any:
    """Array without a weak type, as after an automatic reset, so that all steps are made by one program."""
    return jnp.asarray(x, jnp.result_type(x)) if jax.typeof(x).weak_type else x


def first_world(env: Any, key: jax.Array) -> World:
    """World at the start of an episode, with the first readings."""
    world = start(env, key)
    return _first_readings(env, key, world, state_rate(env, world, world.drones.rpm))


def first_observation(env: Any, key: jax.Array, world: World, rate: State | None) -> tuple[Array, World]:
    """First observation, and world with the first readings."""
    world = _first_readings(env, key, world, rate)
    return _noisy_observation(env, key, world), world


def _first_readings(env: Any, key: jax.Array, world: World, rate: State | None) -> World:
    if rate is None:
        return world
    init_key, measure_key = jax.random.split(jax.random.fold_in(key, SENSORS))
    world = world.replace(sensors=init_sensors(env.sensors, init_key, world.params, world.drones))
    return _measured(env, measure_key, world, rate)


def _measured(env: Any, key: jax.Array, world: World, rate: State) -> World:
    after = measure_sensors(env.sensors, key, world.params, world.drones, rate, world.scene, world.sensors)
    sensors, readings = hold_between(env.sensors, world.step, env.dt, (world.sensors, world.readings), after)
    return world.replace(sensors=sensors, readings=readings)


def state_rate(env: Any, world: World, rpm: Array) -> State | None:
    """Time derivative of the state for the sensors, if any."""
    if not env.sensors:
        return None
    return env.physics.rate(world.params, world.drones, rpm, scene_for_step(env, world))


def scene_for_step(env: Any, world: World) -> Scene | None:
    """Scene as an argument of the step; `None` if the step needs none or was built with it."""
    if isinstance(env.physics, HostStep):
        return None if isinstance(env.scene, Scene) else world.scene
    return env.physics.physics.seen(world.scene)


def command(env: Any, key: Key, world: World, action: Array) -> tuple[World, Array]:
    """World with the new action and disturbance, and commanded rotor speeds."""
    action = jnp.clip(jnp.asarray(action, world.actions.dtype), -1, 1)
    actions = jnp.concatenate([world.actions[:, 1:], action[:, None]], axis=1)
    params = world.params
    if env.disturbance:
        params = env.disturbance(jax.random.fold_in(key, DISTURBANCE), params, env.dt)
    world = world.replace(actions=actions, params=params)
    if env.task.ends == "drone":
        world = world.replace(drones=_without_ended(env, world))

    def of_drone(params, memory, state, action, setpoint):
        return env.action.rpm(params, memory, state, action, setpoint, env.dt)

    if env.action.before_first and env.delay[1]:
        is_before = (jnp.arange(actions.shape[1])[::-1] > world.step)[None, :, None]
        actions = jnp.where(is_before, jax.vmap(env.action.before_first)(world.drones)[:, None], actions)
    delay = randomize.delay_of(params) if env.draws_delay else env.delay_steps[1]
    known = randomize.scaling_params(env.randomize, params, env.params)
    delayed, target = randomize.delayed(actions, delay), env.task.target_now(world)
    memory, rpm = jax.vmap(of_drone)(known, world.memory, world.drones, delayed, target)
    if env.task.ends == "drone":
        rpm = jnp.where(world.active[:, None], rpm, 0)
    return world.replace(memory=memory), rpm


def _without_ended(env: Any, world: World) -> State:
    """State of the team, in which drones whose episode has ended are far away from the others and from each other.

    They begin there anew, each with its load, if it has one: one that stays behind would pull the drone back.
    """
    n, dtype = len(world.active), world.drones.pos.dtype
    place = jnp.stack([_AWAY + _APART * jnp.arange(n, dtype=dtype), jnp.zeros(n, dtype), jnp.full(n, _AWAY, dtype)], -1)
    away = env.physics.init(world.params, State.at_rest(place))
    away = away.replace(aux=jax.tree.map(jnp.zeros_like, world.drones.aux) | away.aux)
    return jax.vmap(lambda active, *states: jax.tree.map(functools.partial(jnp.where, active), *states))(
        world.active, world.drones, away
    )


def outcome(
    env: Any, key: Key, world: World, rate: State | None
) -> tuple[Array, World, Array, Array, Array, dict[str, Any]]:
    """Result of `step`, given the world with the new state."""
    task = env.task
    world = world.replace(step=world.step + 1)
    if rate is not None:
        world = _measured(env, jax.random.fold_in(key, SENSORS), world, rate)
    world = world.replace(variables=task.advance(task, world))
    active, dtype = world.active, world.drones.pos.dtype
    rewards = {name: scale * jnp.asarray(term(task, world), dtype) for name, (scale, term) in task.rewards.items()}
    if task.ends == "drone":
        rewards = {name: jnp.where(active, term, 0) for name, term in rewards.items()}
    terminations, truncations = (
        {name: active & condition(task, world) for name, condition in conditions.items()}
        for conditions in (task.terminations, task.truncations)
    )
    terminated = task.shared(jnp.any, _any_of(terminations, jnp.zeros_like(active)))
    cut = task.shared(jnp.any, _any_of(truncations, jnp.zeros_like(active)))
    truncated = cut | active & (world.step >= env.steps)
    info = dict(rewards=rewards, metrics=task.measure(world), terminations=terminations, truncations=truncations)
    info |= dict(active=active, terminated=terminated, truncated=truncated)
    if task.ends == "drone":  # a step after the time limit is like any other
        world = world.replace(active=active & ~(terminated | cut))
    obs = _noisy_observation(env, key, world)
    return obs, world, sum(rewards.values()), *_ends_of_team(env, world, terminated, truncated), info


def _any_of(conditions: dict[str, Array], start: Array) -> Array:
    return functools.reduce(jnp.logical_or, conditions.values(), start)


def _ends_of_team(env: Any, world: World, terminated: Array, truncated: Array) -> tuple[Array, Array]:
    """Whether the episode of the team terminated and whether it was truncated.

    With `ends="drone"` it ends with the last drone: truncated at the time limit or as a drone of the last ones is, else
    terminated.
    """
    if env.task.ends == "team":
        return terminated[0], truncated[0]
    over, ended = world.step >= env.steps, ~jnp.any(world.active)
    cut = jnp.any(truncated & ~terminated)
    return ended & ~cut & ~over, over | ended & cut


def _noisy_observation(env: Any, key: Key, world: World) -> Array:
    if env.noise:
        world = world.replace(drones=env.noise(jax.random.fold_in(key, NOISE), world.drones))
    return observe(env.terms, env.task, world)
