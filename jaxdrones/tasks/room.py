"""Task: exchange places in a room with pillars."""

import math
from collections.abc import Mapping
from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones.arguments import checked, number, whole
from jaxdrones.checks import check_number
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.sensing import room as build_room
from jaxdrones.state import State
from jaxdrones.tasks import crossing, shaping, touching
from jaxdrones.tasks.starts import check_apart, thrown
from jaxdrones.tasks.task import Drones, Task

HEIGHT = 1.5  # m, of starts and goals
ROOM_HEIGHT = 3.0  # m
_BESIDE = 1.0  # m between the places and the walls
_SPACING = 1.0  # m between neighboring places on the ring
_CLEARANCE = 0.6  # m between a pillar and a place
_REACH = 0.1  # m, spread of the starts along each axis
_ARRIVED = 0.2  # m
_MAX_SIZE = 1000.0  # m


@checked
def room(
    drones: Drones = 4,
    pillars: Annotated[int, whole("number of pillars of {function}", 0)] = 4,
    size: Annotated[float, number("m", at_least=2 * _BESIDE + _SPACING, at_most=_MAX_SIZE)] = 6.0,
    duration: float = 8.0,
) -> Task:
    """Drones on a ring in a room exchange places without collisions with each other, walls or pillars.

    Args:
        drones: number of drones; their places are 1 m or more apart along the ring.
        pillars: number of random pillars; those too close to a start or a goal are left out.
        size: length and width of the room, m; at most 1,000.
        duration: duration of an episode, s.

    Raises:
        ValueError: a number out of range, or more drones than fit on the ring.
    """
    radius = size / 2 - _BESIDE
    check_number("number of drones of room", drones, at_most=int(2 * math.pi * radius / _SPACING))
    angles = [2 * math.pi * i / drones for i in range(drones)]
    ring = [(radius * math.cos(angle), radius * math.sin(angle), HEIGHT) for angle in angles]

    def scene(key: jax.Array) -> Scene:
        return build_room((size, size, ROOM_HEIGHT), key=key, pillars=pillars, keep_free=ring, clearance=_CLEARANCE)

    def start(key: jax.Array, params: Params, scene: Scene) -> tuple[State, dict[str, Array]]:
        """Nearly at rest on a ring in the room."""
        apart = 2 * radius * math.sin(math.pi / drones) - 2 * math.sqrt(2) * _REACH
        check_apart(params, apart, "a smaller vehicle or fewer drones")
        start_key, order_key = jax.random.split(key)
        places = jnp.asarray(ring, params.mass.dtype)
        state = thrown(start_key, params, places, reach=_REACH, speed=0.1, omega=0.1, tilt=0.1)
        goal = jnp.roll(places, jax.random.randint(order_key, (), 1, max(drones, 2)), axis=0)
        goal = -places + jnp.array([[0, 0, 2 * HEIGHT]], goal.dtype) if drones == 1 else goal
        return state, touching.variables(params, state.pos, scene) | {"goal": goal}

    return Task(
        name="room",
        summary="exchange places in a room with pillars without touching",
        drones=drones,
        duration=duration,
        start=start,
        target=shaping.goal,
        rewards=crossing.REWARDS_AMONG_OBSTACLES | {"touched": (-10.0, touching.METRICS["touched"])},
        terminations={"touched": shaping.flag("touched", "A drone touches a surface of the room or a drone.")}
        | shaping.out_of_control(size, center=(0, 0, HEIGHT)),
        advance=touching.advance,
        metrics=touching.METRICS,
        success=_arrived_untouched,
        observations=crossing.GOAL,
        control_hz=50.0,
        substeps=2,
        scene=scene if pillars else build_room((size, size, ROOM_HEIGHT)),
        obstacles_terminate=True,
        action="thrust_and_rates",
        observation=crossing.OBSERVATION_AMONG_OBSTACLES,
    )


def _arrived_untouched(metrics: Mapping[str, Array], dt: float) -> Array:
    """Whether a drone was within 20 cm of its goal in the end and touched nothing."""
    return (metrics["error"][-1] < _ARRIVED) & (metrics["touched"][-1] == 0)
