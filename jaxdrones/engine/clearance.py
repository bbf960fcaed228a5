"""Contact with obstacles for the drones that are near one: none touches anything in a ball that is free of obstacles.

The distance from the nearest obstacle changes by no more than the way that a drone moves. So one distance for every
control step tells in all its physics steps which drones cannot touch anything, exactly and at whatever speed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdrones.accelerate.where_needed import where_needed
from jaxdrones.checks import with_scene
from jaxdrones.dynamics.contact import contact_radius, rim, stop_at
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.sensing.distances import merged
from jaxdrones.sensing.sweep import Disc, planes
from jaxdrones.state import State
from jaxdrones.vector import dot, safe_sqrt
from jaxdrones.wrench import Wrench

_ROUNDING = 1e-3  # m: what may be touched reaches a little farther than what is touched
_ONE_IN = 32  # worlds
_CLEAR = 0.2  # of the thickness of a drone: the part that no obstacle enters; the rest yields in compliant contact


class FreeBalls(NamedTuple):
    """A ball about every drone of a team in which there is no obstacle."""

    center: Float[Array, "n 3"]
    """m, world."""
    radius: Float[Array, " n"]
    """m; negative where the center is in an obstacle."""

    @classmethod
    def about(cls, state: State, scene: Scene) -> FreeBalls:
        """The largest balls about the drones."""
        pos, scene = jax.lax.stop_gradient((state.pos, scene.replace(ground=False)))
        return cls(pos, jax.vmap(scene.distance)(pos))

    def hold(self, params: Params, state: State) -> Bool[Array, " n"]:
        """Whether all of each drone is in its ball."""

        def is_inside(center: Array, radius: Array, params: Params, state: State) -> Array:
            moved = state.pos - center
            return safe_sqrt(dot(moved, moved)) + contact_radius(params) + _ROUNDING < radius

        return jax.vmap(is_inside)(*self, params, state)


def contact_of_team(contact: Callable, params: Params, state: State, scene: Scene, free: FreeBalls | None) -> Wrench:
    """Contact with obstacles of every drone of a team.

    Args:
        contact: effect that declares it, such as `obstacle_contact`.
        params: of a team of n drones.
        state: of the team.
        scene: obstacles.
        free: balls without obstacles. Of many worlds, only those are computed in which a drone is not in its ball;
            all, if left out.
    """

    def on_all(params: Params, state: State, scene: Scene) -> Wrench:
        return jax.vmap(with_scene(contact, scene))(params, state)

    if free is None:
        return on_all(params, state, scene)
    still = jax.lax.stop_gradient((params, state))
    return where_needed(on_all, _ONE_IN)(~jnp.all(free.hold(*still)), params, state, scene)


def stopped_by_obstacles(params: Params, before: State, after: State, scene: Scene, free: FreeBalls) -> State:
    """The team at the end of a physics step in which no drone passed through an obstacle, however fast it is.

    Compliant contact yields, and knows only where a drone is at the start of a step. So the way of every step is swept.

    Args:
        params: of a team of n drones.
        before: the team at the start of the step.
        after: the team at its end, if nothing is in the way.
        scene: obstacles.
        free: balls without obstacles; the way of a drone from one point of its ball to another one is free.
    """

    def find(params: Params, before: State, after: State, scene: Scene) -> tuple[Array, Array]:
        kinds = merged(scene.shapes(before.pos.dtype))

        def of_drone(params: Params, before: State, after: State) -> tuple[Array, Array]:
            start, end = _core(params, before), _core(params, after)
            normals, heights = planes(kinds, start, end)
            return normals, heights - normals @ (end.center - after.pos)  # of the center of mass

        return jax.vmap(of_drone)(params, before, after)

    still = jax.lax.stop_gradient((params, before, after, scene))
    free_way = free.hold(*still[:2]) & free.hold(still[0], still[2])
    normals, heights = where_needed(find, _ONE_IN)(~jnp.all(free_way), *still)
    return jax.vmap(stop_at)(after, normals, heights)


def _core(params: Params, state: State) -> Disc:
    """The part of a drone that no obstacle enters."""
    radius, ring = rim(params)
    return Disc.of(state.pos, state.quat, params.collision_offset, ring, _CLEAR * radius)
