"""Reward terms that several tasks share; all are smooth, for policies that are optimised by gradient."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.control import Setpoint
from jaxdrones.tasks.task import Term, World, square

_NEAR = 0.02  # m; below, the position term is a parabola
_SLOW = 0.1  # m/s; the same for the velocity term


def reach_and_stay(target: Callable[[Any, Array], Setpoint]) -> dict[str, tuple[float, Term]]:
    """Terms that bring a drone to a moving or resting target and keep it there, calmly."""

    def alive(world: World) -> Float[Array, " n"]:
        return jnp.ones_like(world.drones.pos[:, 0])

    def position(world: World) -> Float[Array, " n"]:
        error = square(world.drones.pos - target(world.variables, world.time).pos)
        return jnp.sqrt(error + _NEAR**2) - _NEAR

    def velocity(world: World) -> Float[Array, " n"]:
        error = square(world.drones.vel - target(world.variables, world.time).vel)
        return jnp.sqrt(error + _SLOW**2) - _SLOW

    return {
        "alive": (1.0, alive),
        "position": (-1.0, position),
        "velocity": (-0.1, velocity),
        "omega": (-0.005, turning),
        "action_change": (-0.02, action_change),
    }


def turning(world: World) -> Float[Array, " n"]:
    """Squared body rates, (rad/s)^2."""
    return square(world.drones.omega)


def action_change(world: World) -> Float[Array, " n"]:
    """Squared difference of the last two actions."""
    return square(world.actions[:, -1] - world.actions[:, -2])
