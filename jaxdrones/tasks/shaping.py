"""Reward terms that several tasks share; all are smooth, for policies that are optimised by gradient."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.control import Setpoint
from jaxdrones.tasks.task import Term, World, square

_NEAR, _FAR = 0.02, 3.0  # m: the position term is a parabola below the first, and levels off beyond the second
_SLOW = 0.1  # m/s; below, the velocity term is a parabola
_CALM = 1.0  # rad/s; the same for the body rates


def reach_and_stay(target: Callable[[Any, Array], Setpoint]) -> dict[str, tuple[float, Term]]:
    """Terms that bring a drone to a moving or resting target and keep it there, calmly."""

    def alive(world: World) -> Float[Array, " n"]:
        return jnp.ones_like(world.drones.pos[:, 0])

    def position(world: World) -> Float[Array, " n"]:
        distance = _length(world.drones.pos - target(world.variables, world.time).pos, _NEAR)
        return distance / (1 + distance / _FAR)

    def velocity(world: World) -> Float[Array, " n"]:
        return _length(world.drones.vel - target(world.variables, world.time).vel, _SLOW)

    return {
        "alive": (2.0, alive),
        "position": (-1.0, position),
        "velocity": (-0.1, velocity),
        "omega": (-0.02, turning),
        "action_change": (-0.02, action_change),
    }


def turning(world: World) -> Float[Array, " n"]:
    """Body rates, rad/s; squared where they are small."""
    return _length(world.drones.omega, _CALM)


def action_change(world: World) -> Float[Array, " n"]:
    """Squared difference of the last two actions."""
    return square(world.actions[:, -1] - world.actions[:, -2])


def _length(v: Float[Array, "n 3"], small: float) -> Float[Array, " n"]:
    """Length of every row, but a parabola where it is below `small`."""
    return jnp.sqrt(square(v) + small**2) - small
