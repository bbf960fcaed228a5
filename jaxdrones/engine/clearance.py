"""Skip obstacle contact of drones that are provably clear.

The distance from the nearest obstacle is 1-Lipschitz in the position. One distance query per control step therefore
gives a free ball around each drone, and contact is exact without any computation for as long as the drone stays in
its ball.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdrones.accelerate.stored import stored
from jaxdrones.accelerate.where_needed import where_needed
from jaxdrones.checks import bind
from jaxdrones.dynamics.contact import contact_radius, rim, stop_at
from jaxdrones.engine.physics import Contact
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.sensing.distances import merged
from jaxdrones.sensing.sweep import Disc, planes
from jaxdrones.state import State
from jaxdrones.vector import dot, safe_sqrt
from jaxdrones.wrench import Wrench

_ROUNDING = 1e-3  # m: margin of the search beyond contact
_ONE_IN = 32  # worlds
_CLEAR = 0.2  # of the thickness of a drone: the core that no obstacle enters; the rest yields in compliant contact


class FreeBalls(NamedTuple):
    """Obstacle-free ball around every drone of a team."""

    center: Float[Array, "n 3"]
    """m, world."""
    radius: Float[Array, " n"]
    """m; negative where the center is in an obstacle."""

    @classmethod
    def about(cls, state: State, scene: Scene) -> FreeBalls:
        """Largest free balls around the drones."""
        pos, scene = jax.lax.stop_gradient((state.pos, scene.replace(ground=False)))
        return cls(pos, jax.vmap(scene.distance)(pos))

    def hold(self, params: Params, state: State) -> Bool[Array, " n"]:
        """Whether each drone is entirely inside its ball."""

        def is_inside(center: Array, radius: Array, params: Params, state: State) -> Array:
            moved = state.pos - center
            return safe_sqrt(dot(moved, moved)) + contact_radius(params) + _ROUNDING < radius

        return jax.vmap(is_inside)(*self, params, state)


class NearObstacles:
    """Obstacle contact in the physics steps of a control step, for drones outside their free balls.

    Under `vmap`, contact is computed only in worlds with a drone outside its ball.
    """

    def __init__(self, contacts: Sequence[Callable], state: State, scene: Scene):
        """Find the free balls of a team at the start of a control step, for effects with declared obstacle contact."""
        self._contacts, self._scene, self._free = contacts, scene, stored(FreeBalls.about(state, scene))

    def step(self, params: Params, before: State, advance: Callable[[Contact], State]) -> State:
        """Team after a physics step, by `advance(contact)`, with no drone inside or behind an obstacle, at any speed.

        Compliant contact yields, and depends on the start of a step alone, so the path of every step is swept. The
        stopping planes are constants of the gradient: it is exact for flat obstacles, and neglects the curvature of
        round obstacles and derivatives with respect to the obstacles' poses.
        """
        after = advance(self._contact)
        still = jax.lax.stop_gradient((params, before, after))
        is_free = self._free.hold(*still[:2]) & self._free.hold(still[0], still[2])
        path = jax.vmap(_core)(*still[:2]), jax.vmap(_core)(params, after)
        unobstructed = after.pos, after.vel
        stopped = where_needed(_stopped, _ONE_IN)
        needed = ~jnp.all(is_free)
        pos, vel = stopped(needed, *path, *unobstructed, self._scene, otherwise=unobstructed)
        return after.replace(pos=pos, vel=vel)

    def _contact(self, params: Params, state: State) -> Wrench:
        """Wrench of the obstacles on every drone of a team."""

        def on_all(params: Params, state: State, scene: Scene) -> Wrench:
            first, *others = (jax.vmap(bind(f, scene=scene))(params, state) for f in self._contacts)
            return sum(others, first)

        still = jax.lax.stop_gradient((params, state))
        return where_needed(on_all, _ONE_IN)(~jnp.all(self._free.hold(*still)), params, state, self._scene)


def _stopped(
    start: Disc, end: Disc, pos: Float[Array, "n 3"], vel: Float[Array, "n 3"], scene: Scene
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """Positions and velocities of a team whose drones obstacles stop; `end`, `pos` and `vel` are those without them."""
    kinds = merged(scene.shapes(pos.dtype))

    def of_drone(start: Disc, end: Disc, pos: Float[Array, "3"], vel: Float[Array, "3"]) -> tuple[Array, Array]:
        normals, heights = planes(kinds, *jax.lax.stop_gradient((start, end)))
        below = jnp.stack([dot(normal, pos) - end.lowest(normal) for normal in normals])
        return stop_at(pos, vel, normals, heights + below)

    return jax.vmap(of_drone)(start, end, pos, vel)


def _core(params: Params, state: State) -> Disc:
    """Core of a drone, impenetrable for obstacles."""
    radius, ring = rim(params)
    return Disc.of(state.pos, state.quat, params.collision_offset, ring, _CLEAR * radius)
