"""Observations of the other drones of a team and of obstacles."""

from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.arguments import Count, checked, number
from jaxdrones.quantity import Quantity, quantities
from jaxdrones.tasks.pairs import CORE, Vectors, closest_approach, dot, nearby, nearest, seen_from
from jaxdrones.tasks.task import ObservationTerm, Task, Term, World, norm

_MAX_DISTANCE = 20.0  # m: bound of the observations, and place of a drone or obstacle that does not exist
_HORIZON = 1.5  # s: latest closest approach
_RANKS = {0: "", 1: "second-", 2: "third-"}
_NEAR, _NEARNESS = 0.1, 0.3  # m: direction of a drone, scaled by nearness


def adjacency(task: Task, world: World, radius: float = 10.0) -> Array:
    """Equation 8: 1 for every drone within `radius` (m) and for the drone itself, else 0."""
    return (_distances(world.drones.pos) < radius).astype(world.drones.pos.dtype)


@checked
def neighbors(count: Count) -> ObservationTerm:
    """Observation term of the nearest drones, nearest first: relative position (m) and velocity (m/s), world axes.

    In smaller teams the remaining rows are those of a drone 35 m away with the same velocity.
    """

    def observe(task: Task, world: World) -> Array:
        """Position and velocity of the nearest drones, relative to the drone."""
        drones = world.drones
        index = nearest(drones.pos, count)
        return _rows([*seen_from(drones.pos, index), *seen_from(drones.vel, index)], count)

    entries: list[Quantity] = []
    for which in _names(count, "drone"):
        entries += quantities(f"position of the {which}", "m", "world")
        entries += quantities(f"velocity of the {which}", "m/s", "world")
    return ObservationTerm(observe, _MAX_DISTANCE, entries=tuple(entries), name=f"neighbors({count})")


@checked
def encounters(count: Count, reach: Annotated[float, number("m", above=0)] = 1.2) -> ObservationTerm:
    """Observation term of the nearest drones as a set, for a network that does not depend on their number or order.

    A row has the position (m), the velocity (m/s), the position at the closest approach within 1.5 s at constant
    velocities (m), the time until then (s), and the direction, scaled by nearness; relative to the drone, world axes.
    In teams of no more than `count` drones the remaining rows are beyond `reach` (m), at which a drone is out of sight.
    """

    def observe(task: Task, world: World) -> Array:
        """Position, velocity and closest approach of the nearest drones, relative to the drone."""
        drones = world.drones
        index = nearby(drones.pos, count)
        return _rows(_meetings(seen_from(drones.pos, index), seen_from(drones.vel, index)), count)

    return _set(observe, count, reach, "encounters", "drone")


@checked
def obstacles(count: Count, reach: Annotated[float, number("m", above=0)] = 1.2) -> ObservationTerm:
    """Observation term of the nearest obstacles as a set, with the rows of `encounters`.

    An obstacle is represented by its nearest point, at rest; the ground is one of them. Arguments are as for
    `encounters`.
    """

    def observe(task: Task, world: World) -> Array:
        """Position, velocity and closest approach of the nearest obstacles, relative to the drone."""

        def seen(pos: Float[Array, "3"]) -> Float[Array, "k 3"]:
            surface = world.scene.nearest_few(pos, count)
            is_there = jnp.isfinite(surface.distance)[:, None]
            return jnp.where(is_there, surface.point - pos[None], jnp.array([[_MAX_DISTANCE, 0, 0]], pos.dtype))

        pos = list(jnp.moveaxis(jax.vmap(seen)(world.drones.pos), (2, 1), (0, 1)))
        vel = [jnp.broadcast_to(-v, pos[0].shape) for v in world.drones.vel.T]
        return _rows(_meetings(pos, vel), count)

    return _set(observe, count, reach, "obstacles", "obstacle")


def _meetings(pos: Vectors, vel: Vectors) -> list[Float[Array, "k n"]]:
    """Position (m), velocity (m/s), closest approach (m), its time (s), direction by nearness of relative motions."""
    time, approach = closest_approach(pos, vel, _HORIZON)
    away = jnp.sqrt(dot(pos, pos) + CORE**2)
    nearness = _NEARNESS / (away * (away + _NEAR))
    return [*pos, *vel, *approach, time, *(nearness * x for x in pos)]


def _set(observe: Term, count: int, reach: float, name: str, what: str) -> ObservationTerm:
    entries: list[Quantity] = []
    for which in _names(count, what):
        entries += quantities(f"position of the {which}", "m", "world")
        entries += quantities(f"velocity of the {which}", "m/s", "world")
        entries += quantities(f"closest approach of the {which}", "m", "world")
        entries += [Quantity(f"time to the closest approach of the {which}", "s")]
        entries += quantities(f"direction of the {which}, by nearness", "-", "world")
    name = f"{name}({count}, {reach:g})"
    return ObservationTerm(observe, _MAX_DISTANCE, entries=tuple(entries), name=name, rows=count, reach=reach)


def _names(count: int, what: str) -> list[str]:
    return [f"{_RANKS.get(i, f'{i + 1}th-')}nearest {what}" for i in range(count)]


def _rows(columns: list[Float[Array, "k n"]], count: int) -> Float[Array, "n d"]:
    """Rows of k drones side by side, followed by drones that are far away, up to `count` rows."""
    rows = jnp.stack(columns, axis=-1).swapaxes(0, 1)
    n, known, size = rows.shape
    far = jnp.zeros((n, count - known, size), rows.dtype).at[..., :3].set(_MAX_DISTANCE)
    return jnp.concatenate([rows, far], axis=1).reshape(n, -1)


def _distances(pos: Float[Array, "n 3"]) -> Float[Array, "n n"]:
    return jax.vmap(lambda own: norm(pos - own[None]))(pos)
