"""Benchmark programs and timers: the plant, the plant under a controller, and an environment."""

import functools
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.control import Setpoint, for_team, pid
from jaxdrones.engine.rollout import rollout
from jaxdrones.engine.step import Step
from jaxdrones.envs import AutoReset, Env
from jaxdrones.params import Params, repeat
from jaxdrones.state import State
from jaxdrones.urdf import load_params

_SHORTEST = 0.02  # s, of a measurement


def crazyflies(worlds: int, drones: int) -> tuple[Params, State, Float[Array, "w n 4"]]:
    """Team of Crazyflies, its starts in all worlds, and constant rotor speeds near hover, RPM."""
    params = repeat(load_params("cf2x"), drones)
    i = jnp.arange(drones)
    start = State.at_rest(jnp.stack([0.2 * i, 0.0 * i, 1.0 + 0.3 * i], axis=-1))
    starts = jax.tree.map(lambda x: jnp.broadcast_to(x, (worlds, *x.shape)) + 0.0, start)
    return params, starts, params.hover_rpm[0] * (1 + 0.01 * jax.random.normal(jax.random.key(0), (worlds, drones, 4)))


def held(step: Step, params: Params, length: int) -> Callable[[State, Float[Array, "n 4"]], Float[Array, "n 3"]]:
    """`(start, rpm) -> final positions` of one world with constant rotor speeds for `length` steps."""

    def fly(start: State, rpm: Array) -> Array:
        return jax.lax.scan(lambda state, _: (step(params, state, rpm), None), start, length=length)[0].pos

    return fly


def controlled(step: Step, params: Params, length: int, dt: float) -> Callable[[State], Float[Array, "n 3"]]:
    """`start -> final positions` of one world with a position hold by the PID for `length` steps."""
    pilot = functools.partial(pid.control, pid.gains("cf2x"), dt=dt)

    def fly(start: State) -> Array:
        def control(params, memory, state, k):
            return jax.vmap(pilot)(params, memory, state, Setpoint.at(start.pos))

        memory = for_team(pid.init(), len(params.mass))
        return rollout(step, control, params, start, memory=memory, length=length)[0].pos

    return fly


def episodes(env: Env, worlds: int, length: int) -> tuple[Callable[[Any, Array], Any], Any]:
    """Steps of many worlds of an environment with random actions and automatic resets.

    Episodes end at different steps. Every step stores all inputs of a learner.

    Returns:
        `fly(episodes, key)` for `length` control steps in every world, and the initial episodes.
    """
    auto = AutoReset(env)
    _, begun = jax.jit(jax.vmap(auto.reset))(jax.random.split(jax.random.key(0), worlds))
    age = jax.random.randint(jax.random.key(1), (worlds,), 0, env.steps)
    begun = begun.replace(world=begun.world.replace(step=age))
    actions = jax.random.uniform(jax.random.key(2), (worlds, env.drones, env.action_size), minval=-0.1, maxval=0.1)

    def fly(begun: Any, key: Array) -> Any:
        def advance(carry, key):
            keys = jax.random.split(key, worlds)
            obs, now, *outcome = jax.vmap(auto.step)(keys, carry[0], actions)
            return (now, obs, *outcome[:3]), None

        first = advance((begun,), key)[0]
        return jax.lax.scan(advance, first, jax.random.split(key, length))[0]

    return fly, begun


def seconds(program: Callable, *arguments: Any, repeats: int) -> dict[str, float]:
    """Median and best duration of a call after warm-up, s; short calls are timed in groups."""

    def of_calls(calls: int) -> float:
        start = time.perf_counter()
        for _ in range(calls):
            jax.block_until_ready(program(*arguments))
        return (time.perf_counter() - start) / calls

    of_calls(1)
    calls = 1 + int(_SHORTEST / of_calls(1))
    times = [of_calls(calls) for _ in range(repeats)]
    return {"median": statistics.median(times), "best": min(times)}
