"""Hover from anywhere, recover from a throw, land."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones import rotation
from jaxdrones.control import Setpoint
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.tasks import shaping
from jaxdrones.tasks.starts import standing_height, thrown
from jaxdrones.tasks.task import Task, World, out_of_control, upright

SPACING = 3.0  # m between the goals of neighbours, further than they are thrown apart


def hover(
    drones: int = 1,
    reach: float = 1.0,
    speed: float = 1.0,
    omega: float = 1.0,
    tilt: float = 90.0,
    height: float = 2.0,
    duration: float = 5.0,
) -> Task:
    """Fly to the goal and stay.

    Args:
        drones: number of drones; their goals are 3 m apart in x.
        reach: start within +-reach of the goal along each axis, m.
        speed: +-, m/s.
        omega: +-, rad/s.
        tilt: up to, degrees.
        height: of the goal, m.
        duration: of an episode, s.
    """

    def start(key: jax.Array, params: Params) -> tuple[State, Array]:
        goal = _goals(params, height)
        return thrown(key, params, goal, reach=reach, speed=speed, omega=omega, tilt=jnp.radians(tilt)), goal

    return Task(
        name="hover",
        summary="fly to the goal from any motion and stay",
        drones=drones,
        duration=duration,
        start=start,
        target=_stay,
        rewards=shaping.reach_and_stay(_stay),
        ends=out_of_control((0, 0, height), 5.0 + SPACING * drones),
        success=settled,
    )


def recovery(drones: int = 1, height: float = 5.0, duration: float = 4.0) -> Task:
    """Upside down, thrown and tumbling: level out at once, then fly back. Reports the altitude lost."""

    def start(key: jax.Array, params: Params) -> tuple[State, dict[str, Array]]:
        goal = _goals(params, height)
        state = thrown(key, params, goal, reach=0.2, speed=2.0, omega=5.0, tilt=jnp.radians(60.0))
        half_turn = jnp.array([1, 0, 0, 0], goal.dtype)
        quat = jax.vmap(rotation.multiply, (0, None))(state.quat, half_turn)
        return state.replace(quat=quat), {"goal": goal, "lowest": state.pos[:, 2], "start": state.pos[:, 2]}

    def target(variables, t):
        return Setpoint.at(variables["goal"])

    def advance(world: World):
        lowest = jnp.minimum(world.variables["lowest"], world.drones.pos[:, 2])
        return world.variables | {"lowest": lowest}

    return Task(
        name="recovery",
        summary="level out from upside down and fly back",
        drones=drones,
        duration=duration,
        start=start,
        target=target,
        rewards=shaping.reach_and_stay(target) | {"upright": (0.1, upright)},
        ends=out_of_control((0, 0, height), 5.0 + SPACING * drones),
        advance=advance,
        metrics={
            "altitude_lost": lambda world: world.variables["start"] - world.variables["lowest"],
            "upright": upright,
        },
        success=_recovered,
    )


def landing(drones: int = 1, height: float = 1.0, duration: float = 4.0) -> Task:
    """Land on the pad at the origin: softly, level, at rest."""

    def start(key: jax.Array, params: Params) -> tuple[State, Array]:
        pad = _goals(params, 0.0).at[:, 2].set(standing_height(params))
        over = pad.at[:, 2].add(height)
        reach = jnp.array([0.5, 0.5, height / 2], pad.dtype)
        return thrown(key, params, over, reach=reach, speed=0.5, omega=0.5, tilt=jnp.radians(20.0)), pad

    def descent(world: World):
        """How much faster than 0.3 m/s plus half the height per second it sinks."""
        height = world.drones.pos[:, 2] - world.variables[:, 2]
        return jnp.maximum(-world.drones.vel[:, 2] - (0.3 + 0.5 * jnp.maximum(height, 0)), 0)

    return Task(
        name="landing",
        summary="land on the pad, softly and level",
        drones=drones,
        duration=duration,
        start=start,
        target=_stay,
        rewards=shaping.reach_and_stay(_stay) | {"descent": (-1.0, descent)},
        ends=out_of_control((0, 0, height), 5.0 + SPACING * drones) | {"crashed": _upside_down},
        metrics={"upright": upright},
        success=_landed,
        contact=("ground",),
    )


def settled(
    metrics: Mapping[str, Array], dt: float, within: float = 0.05, speed: float = 0.1, last: float = 2.0
) -> Array:
    """Within 5 cm of the target and slower than 0.1 m/s for the last two seconds."""
    steps = round(last / dt)
    return jnp.all((metrics["error"][-steps:] < within) & (metrics["speed"][-steps:] < speed), axis=0)


def _recovered(metrics: Mapping[str, Array], dt: float) -> Array:
    """Level to 15 degrees, slower than 0.5 m/s and within half a metre of the goal in the end."""
    level = metrics["upright"][-1] > jnp.cos(jnp.radians(15.0))
    return level & (metrics["speed"][-1] < 0.5) & (metrics["error"][-1] < 0.5)


def _landed(metrics: Mapping[str, Array], dt: float) -> Array:
    """Within 10 cm of the pad, at rest and level in the end."""
    return (metrics["error"][-1] < 0.1) & (metrics["speed"][-1] < 0.05) & (metrics["upright"][-1] > 0.95)


def _upside_down(world: World):
    return (upright(world) < 0) & (world.drones.pos[:, 2] < 2 * world.params.collision_radius)


def _goals(params: Params, height: float) -> Array:
    n = len(params.mass)
    x = SPACING * (jnp.arange(n) - (n - 1) / 2)
    return jnp.stack([x, jnp.zeros_like(x), jnp.full_like(x, height)], axis=-1)


def _stay(goal: Array, t: Array) -> Setpoint:
    return Setpoint.at(goal)
