"""Conditions of an unrecoverable flight."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdrones.quantity import described
from jaxdrones.tasks.task import Condition, Task, World

MAX_SPIN = 100.0  # rad/s; an episode in which a drone turns faster is terminated


def out_of_control(reach: float, center: tuple[float, float, float] | None = None) -> dict[str, Condition]:
    """Conditions of an unrecoverable flight or a state that is not finite.

    `lost`: a drone is farther than `reach` (m) from `center` (m, world; by default its target) along some axis.
    `spinning`: it rotates faster than 100 rad/s about some axis.
    """

    def lost(task: Task, world: World) -> Bool[Array, " n"]:
        pos = world.drones.pos
        middle = task.target_now(world).pos if center is None else jnp.asarray(center, pos.dtype)[None]
        return _beyond(pos - middle, reach)

    def spinning(task: Task, world: World) -> Bool[Array, " n"]:
        return _beyond(world.drones.omega, MAX_SPIN)

    place = "the target" if center is None else f"({', '.join(f'{x:g}' for x in center)}) m"
    return {
        "lost": described(f"A drone is {reach:g} m or more from {place} along some axis.", lost),
        "spinning": described(f"A drone rotates at {MAX_SPIN:g} rad/s or faster about some axis.", spinning),
    }


def _beyond(v: Float[Array, "n 3"], limit: float) -> Bool[Array, " n"]:
    x, y, z = (jnp.abs(column) < limit for column in v.T)  # false for NaN
    return ~(x & y & z)
