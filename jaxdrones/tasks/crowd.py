"""Task: a crowd of drones crosses a box without touching."""

from __future__ import annotations

import math
from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.arguments import Switch, checked, number
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.tasks import crossing
from jaxdrones.tasks.conditions import out_of_control
from jaxdrones.tasks.starts import thrown
from jaxdrones.tasks.task import Task, Team

FLOOR = 2.0  # m, height of the box above the ground
_SPACING = 4.0  # collision radii between starts, and between goals (GCBF+, arXiv 2401.14554)
_TRIES = 32  # random places of a drone, of which the first free one is taken
_SETTLING = 6.0  # s of an episode beyond the straight flight
_NARROWEST, _LONGEST = 0.6, 2.0  # sides of a random box over those of the cube


@checked
def crowd(
    drones: Team = 8,
    density: Annotated[float, number("1/m^3", above=0, at_most=8)] = 1.0,
    random_box: Switch = False,
    patience: Annotated[float, number(at_least=1)] = 1.0,
) -> Task:
    """Drones fly from random starts to random goals in a cube whose volume grows with their number.

    Starts are four collision radii apart where a random place permits it, and so are goals. Two drones touch when their
    centers come closer than two collision radii. A drone out of control ends its own episode.

    Args:
        drones: number of drones, at least two.
        density: drones per volume of the cube.
        random_box: whether the sides are drawn for every episode: 0.6 to 1.1 times those of the cube, in every second
            box with one side up to twice as long, in which drones meet at full speed. Meant for training.
        patience: duration of an episode over that of a straight flight along the diagonal plus 6 s.
    """
    side = (drones / density) ** (1 / 3)
    longest = side * (_LONGEST if random_box else 1)
    duration = patience * (_SETTLING + math.hypot(longest, side, side) / crossing.SPEED)

    def start(key: jax.Array, params: Params) -> tuple[State, dict[str, Array]]:
        """Nearly at rest at random places in the box."""
        box_key, start_key, place_key, goal_key = jax.random.split(key, 4)
        sides = _random_sides(box_key, side) if random_box else jnp.full(3, side)
        spacing = _SPACING * jnp.max(params.collision_radius)
        middle = jnp.array([[0, 0, FLOOR + side / 2]])
        place, goal = (middle + _places(k, drones, sides, spacing) for k in (place_key, goal_key))
        state = thrown(start_key, params, place, reach=0.0, speed=0.1, omega=0.1, tilt=0.1)
        return state, crossing.variables(state, goal)

    return crossing.task(
        name="crowd",
        summary="cross a box full of drones without touching",
        drones=drones,
        duration=duration,
        start=start,
        terminations=out_of_control(longest + 4.0, center=(0, 0, FLOOR + side / 2)),
        ends="drone",
    )


def _random_sides(key: jax.Array, side: float) -> Float[Array, "3"]:
    """Sides of a random box, m."""
    sides_key, which_key, long_key = jax.random.split(key, 3)
    sides = jax.random.uniform(sides_key, (3,), minval=_NARROWEST * side, maxval=1.1 * side)
    long = jax.random.uniform(long_key, (), minval=side, maxval=_LONGEST * side)
    return jnp.where(jnp.arange(3) == jax.random.randint(which_key, (), 0, 6), long, sides)


def _places(key: jax.Array, n: int, sides: Array, spacing: Array) -> Float[Array, "n 3"]:
    """Random places about the origin, `spacing` apart where one of the tries is."""
    tries = jax.random.uniform(key, (n, _TRIES, 3), minval=-0.5, maxval=0.5) * sides[None, None]

    def place(taken: Array, drone: tuple[Array, Array]) -> tuple[Array, None]:
        i, tries = drone
        apart = jnp.linalg.norm(tries[:, None] - taken[None], axis=-1)
        free = jnp.min(jnp.where(jnp.arange(n)[None] < i, apart, jnp.inf), axis=-1)
        first = jnp.argmax(jnp.where(free > spacing, spacing + _TRIES - jnp.arange(_TRIES), free))
        return taken.at[i].set(tries[first]), None

    return jax.lax.scan(place, jnp.zeros((n, 3)), (jnp.arange(n), tries))[0]
