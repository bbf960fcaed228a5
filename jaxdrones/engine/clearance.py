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
from jaxdrones.accelerate.where_needed import in_all_worlds, where_needed
from jaxdrones.checks import bind
from jaxdrones.dynamics.contact import contact_radius, rim, stop_at
from jaxdrones.engine.physics import Contact
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.sensing.distances import merged
from jaxdrones.sensing.sweep import Disc, Planes, planes
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
        """Team after a physics step among the obstacles, by `advance(contact)`: that after a step with this contact.

        Where no drone leaves its ball in any world, this is the unobstructed step, and so is its derivative.
        """
        unobstructed = advance(_no_contact)
        still = jax.lax.stop_gradient((params, before, unobstructed))
        clear = jnp.all(self._free.hold(*still[:2]) & self._free.hold(still[0], still[2]))

        def among_obstacles() -> State:
            return self._stopped(params, before, advance(self._contact))

        return jax.lax.cond(in_all_worlds(clear), lambda: unobstructed, among_obstacles)

    def _contact(self, params: Params, state: State) -> Wrench:
        """Wrench of the obstacles on every drone of a team."""

        def on_all(params: Params, state: State, scene: Scene) -> Wrench:
            first, *others = (jax.vmap(bind(f, scene=scene))(params, state) for f in self._contacts)
            return sum(others, first)

        still = jax.lax.stop_gradient((params, state))
        return where_needed(on_all, _ONE_IN)(~jnp.all(self._free.hold(*still)), params, state, self._scene)

    def _stopped(self, params: Params, before: State, after: State) -> State:
        """Team at the end of a physics step, with no drone inside or behind an obstacle, at any speed.

        Compliant contact yields, and depends on the start of a step alone, so the path of every step is swept. The
        stopping planes are constants of the gradient: it is exact for flat obstacles, and neglects the curvature of
        round obstacles and derivatives with respect to the obstacles' poses. `after` is the end of an unobstructed
        step.
        """

        def find(params: Params, before: State, after: State, scene: Scene) -> Planes:
            kinds = merged(scene.shapes(before.pos.dtype))
            start, end = jax.vmap(_core)(params, before), jax.vmap(_core)(params, after)
            return jax.vmap(lambda *way: planes(kinds, *way))(start, end)

        def stop(params: Params, state: State, planes: Planes) -> State:
            core = _core(params, state)
            below = [dot(normal, state.pos) - core.lowest(normal) for normal in planes.normals]
            return stop_at(state, planes.normals, planes.heights + jnp.stack(below))

        still = jax.lax.stop_gradient((params, before, after, self._scene))
        free = self._free.hold(*still[:2]) & self._free.hold(still[0], still[2])
        return jax.vmap(stop)(params, after, where_needed(find, _ONE_IN)(~jnp.all(free), *still))


def _no_contact(params: Params, state: State) -> Wrench:
    return Wrench(jnp.zeros_like(state.pos), jnp.zeros_like(state.pos))


def _core(params: Params, state: State) -> Disc:
    """Core of a drone, impenetrable for obstacles."""
    radius, ring = rim(params)
    return Disc.of(state.pos, state.quat, params.collision_offset, ring, _CLEAR * radius)
