"""Tasks: hover from any start, recover from a throw, land."""

from collections.abc import Mapping
from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones import rotation
from jaxdrones.arguments import Seconds, checked, number
from jaxdrones.params import Params
from jaxdrones.quantity import described
from jaxdrones.state import State
from jaxdrones.tasks import shaping
from jaxdrones.tasks.starts import standing_height, thrown
from jaxdrones.tasks.task import Drones, Task, World, upright

SPACING = 3.0  # m between neighboring goals, more than the spread of the starts
_MAX_REACH = 5.0  # m; a drone is lost 3 m or more beyond it
_MAX_HEIGHT = 1000.0  # m; float32 resolves 0.1 mm there
_MAX_SPEED = 100.0  # m/s
_TOUCHING = 0.02  # m above the ground: height at which the touchdown speed is measured
_SOFT = 0.6  # m/s
Height = Annotated[float, number("m", above=0, at_most=_MAX_HEIGHT)]
SETTLED = 2.0  # s: time in hover at the end for success


@checked
def hover(
    drones: Drones = 1,
    reach: Annotated[float, number("m", at_least=0, at_most=_MAX_REACH)] = 1.0,
    speed: Annotated[float, number("m/s", at_least=0, at_most=_MAX_SPEED)] = 1.0,
    omega: Annotated[float, number("rad/s", at_least=0, below=shaping.MAX_SPIN)] = 1.0,
    tilt: Annotated[float, number("degrees", at_least=0, at_most=180)] = 90.0,
    height: Height = 2.0,
    duration: Seconds = 5.0,
    precision: Annotated[float, number(at_least=0, at_most=100)] = 0.0,
    heading: Annotated[float, number(at_least=0, at_most=100)] = 0.0,
) -> Task:
    """Fly to the goal and hover there.

    Args:
        drones: number of drones; their goals are 3 m apart in x.
        reach: drones start within +-reach of the goal along each axis, m; at most 5.
        speed: the initial velocity is within +-speed along each axis, m/s; at most 100.
        omega: the initial body rates are within +-omega about each axis, rad/s; below 100, where episodes terminate.
        tilt: largest initial tilt, degrees.
        height: height of the goal, m; at most 1,000.
        duration: duration of an episode, s; of 2 s or less there is no criterion of success.
        precision: weight of an additional reward exp(-distance / 10 cm - speed / 0.2 m/s) for training, at most 100. It
            is steep near the goal, so that PPO, whose actions are noisy, learns to stay there and not to oscillate.
        heading: weight of a penalty 1 - cos(heading), at most 100; without it a drone may turn away from its start.
    """

    def start(key: jax.Array, params: Params) -> tuple[State, dict[str, Array]]:
        goal = _goals(params, height)
        state = thrown(key, params, goal, reach=reach, speed=speed, omega=omega, tilt=jnp.radians(tilt))
        return state, {"goal": goal}

    added = {"near": (precision, shaping.near), "heading": (-heading, shaping.heading)}
    chosen = {name: term for name, term in added.items() if term[0]}
    where = f"Within +-{reach:g} m of the goal, +-{speed:g} m/s, +-{omega:g} rad/s, tilted by up to {tilt:g} degrees."
    return Task(
        name="hover",
        summary="fly to the goal from any motion and stay",
        drones=drones,
        duration=duration,
        start=described(where, start),
        target=shaping.goal,
        rewards=shaping.REACH_AND_STAY | chosen,
        terminations=shaping.out_of_control(_MAX_REACH + SPACING * drones),
        success=settled if duration > SETTLED else None,
    )


@checked
def recovery(drones: Drones = 1, height: Height = 5.0, duration: float = 4.0) -> Task:
    """Recover from an upside-down, tumbling start: level out, then fly back. Reports the altitude lost."""

    def start(key: jax.Array, params: Params) -> tuple[State, dict[str, Array]]:
        """Near the goal, upside down, moving and rotating."""
        goal = _goals(params, height)
        state = thrown(key, params, goal, reach=0.2, speed=2.0, omega=5.0, tilt=jnp.radians(60.0))
        half_turn = jnp.array([1, 0, 0, 0], goal.dtype)
        quat = jax.vmap(rotation.multiply, (0, None))(state.quat, half_turn)
        return state.replace(quat=quat), {"goal": goal, "lowest": state.pos[:, 2], "start": state.pos[:, 2]}

    def altitude_lost(task: Task, world: World) -> Array:
        """Height of the start above the lowest point so far, m."""
        return world.variables["start"] - world.variables["lowest"]

    def advance(task: Task, world: World):
        lowest = jnp.minimum(world.variables["lowest"], world.drones.pos[:, 2])
        return world.variables | {"lowest": lowest}

    return Task(
        name="recovery",
        summary="level out from upside down and fly back",
        drones=drones,
        duration=duration,
        start=start,
        target=shaping.goal,
        rewards=shaping.REACH_AND_STAY | {"upright": (0.1, upright)},
        terminations=shaping.out_of_control(_MAX_REACH + SPACING * drones),
        advance=advance,
        metrics={
            "altitude_lost": altitude_lost,
            "upright": upright,
        },
        success=_recovered,
    )


@checked
def landing(
    drones: Drones = 1,
    height: Annotated[float, number("m", above=0, at_most=_MAX_REACH)] = 1.0,
    duration: float = 4.0,
) -> Task:
    """Land on the pad at the origin softly, and come to rest level."""

    def start(key: jax.Array, params: Params) -> tuple[State, dict[str, Array]]:
        """Above the pad, in slow motion and slightly tilted."""
        pad = _goals(params, 0.0).at[:, 2].set(standing_height(params))
        over = pad.at[:, 2].add(height)
        reach = jnp.array([0.5, 0.5, height / 2], pad.dtype)
        state = thrown(key, params, over, reach=reach, speed=0.5, omega=0.5, tilt=jnp.radians(20.0))
        return state, {"goal": pad, "sinking": -state.vel[:, 2], "touch_speed": jnp.zeros_like(params.mass)}

    def above(world: World) -> Array:
        """Height above rest on the pad, m."""
        return world.drones.pos[:, 2] - world.variables["goal"][:, 2]

    def descent(task: Task, world: World):
        """Excess of the sink rate over 0.3 m/s plus half the height per second, m/s."""
        return jnp.maximum(-world.drones.vel[:, 2] - (0.3 + 0.5 * jnp.maximum(above(world), 0)), 0)

    def advance(task: Task, world: World) -> dict[str, Array]:
        before, sinking = world.variables["sinking"], -world.drones.vel[:, 2]
        fastest = jnp.where(above(world) < _TOUCHING, jnp.maximum(before, sinking), 0)
        touch_speed = jnp.maximum(world.variables["touch_speed"], fastest)
        return world.variables | {"sinking": sinking, "touch_speed": touch_speed}

    return Task(
        name="landing",
        summary="land on the pad, softly and level",
        drones=drones,
        duration=duration,
        start=start,
        target=shaping.goal,
        rewards=shaping.REACH_AND_STAY | {"descent": (-1.0, descent)},
        terminations=shaping.out_of_control(_MAX_REACH + SPACING * drones) | {"crashed": _upside_down},
        advance=advance,
        metrics={
            "upright": upright,
            "touch_speed": shaping.variable("touch_speed", "Largest sink rate within 2 cm of the ground, m/s."),
        },
        success=_landed,
        contact=("ground",),
    )


def settled(metrics: Mapping[str, Array], dt: float) -> Array:
    """Whether a drone was within 5 cm of the target and slower than 0.1 m/s for the last two seconds.

    False for an episode shorter than that.
    """
    steps = round(SETTLED / dt)
    near = (metrics["error"][-steps:] < 0.05) & (metrics["speed"][-steps:] < 0.1)
    return jnp.all(near, axis=0) & (len(near) >= steps)


def _recovered(metrics: Mapping[str, Array], dt: float) -> Array:
    """Whether a drone was level to 15 degrees, slower than 0.5 m/s and within half a meter of the goal in the end."""
    level = metrics["upright"][-1] > jnp.cos(jnp.radians(15.0))
    return level & (metrics["speed"][-1] < 0.5) & (metrics["error"][-1] < 0.5)


def _landed(metrics: Mapping[str, Array], dt: float) -> Array:
    """Whether a drone was within 10 cm of the pad, at rest and level in the end, and touched down below 0.6 m/s."""
    rests = (metrics["error"][-1] < 0.1) & (metrics["speed"][-1] < 0.05) & (metrics["upright"][-1] > 0.95)
    return rests & (metrics["touch_speed"][-1] < _SOFT)


def _upside_down(task: Task, world: World):
    """A drone is upside down on the ground."""
    return (upright(task, world) < 0) & (world.drones.pos[:, 2] < 2 * world.params.collision_radius)


def _goals(params: Params, height: float) -> Array:
    n = len(params.mass)
    x = SPACING * (jnp.arange(n) - (n - 1) / 2)
    return jnp.stack([x, jnp.zeros_like(x), jnp.full_like(x, height)], axis=-1)
