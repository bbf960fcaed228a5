"""Reward terms that several tasks share; all are smooth, for policies that are optimised by gradient."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.tasks.task import Task, Term, World, square

_NEAR, _FAR = 0.02, 3.0  # m: the position term is a parabola below the first, and levels off beyond the second
_SLOW = 0.1  # m/s; below, the velocity term is a parabola
_SLOW_TURN = 1.0  # rad/s; below, the term of the body rates is a parabola


def alive(task: Task, world: World) -> Float[Array, " n"]:
    """One for every step of the episode."""
    return jnp.ones_like(world.drones.pos[:, 0])


def position(task: Task, world: World) -> Float[Array, " n"]:
    """Distance from the target, m; it levels off far away."""
    distance = _length(world.drones.pos - task.target_now(world).pos, _NEAR)
    return distance / (1 + distance / _FAR)


def velocity(task: Task, world: World) -> Float[Array, " n"]:
    """Speed relative to the target, m/s."""
    return _length(world.drones.vel - task.target_now(world).vel, _SLOW)


def body_rates(task: Task, world: World) -> Float[Array, " n"]:
    """Magnitude of the body rates, rad/s; quadratic where they are small."""
    return _length(world.drones.omega, _SLOW_TURN)


def action_change(task: Task, world: World) -> Float[Array, " n"]:
    """Squared difference of the last two actions."""
    return square(world.actions[:, -1] - world.actions[:, -2])


REACH_AND_STAY: dict[str, tuple[float, Term]] = {
    "alive": (2.0, alive),
    "position": (-1.0, position),
    "velocity": (-0.1, velocity),
    "omega": (-0.02, body_rates),
    "action_change": (-0.02, action_change),
}
"""Terms that bring a drone to a moving or resting target and keep it there with small body rates."""


def _length(v: Float[Array, "n 3"], small: float) -> Float[Array, " n"]:
    """Length of every row; below `small` it is a parabola."""
    return jnp.sqrt(square(v) + small**2) - small
