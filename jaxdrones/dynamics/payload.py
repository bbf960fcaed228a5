"""Point-mass load on cables: a load for every drone, or one load that a team carries.

A cable has no mass. Along the unit vector e from the drone to the load it pulls with the tension

    T = max(0, k s + c min(s / d, 1) s'),  s = max(0, |r| - l),

for the distance r from its anchor on the drone to the load, the length l of the slack cable, the stiffness k and the
damping c. A slack cable exerts no force. The damping grows with the stretch s up to the stretch d of a cable that holds
the load at rest, so the tension is continuous where a cable becomes taut; it never pushes, and never adds energy.

The drone is pulled by T e, the load by -T e, so momentum and angular momentum are conserved.
"""

from collections.abc import Sequence
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxdrones import rotation, vector
from jaxdrones.arguments import Count, Switch, checked, number, shape
from jaxdrones.checks import is_concrete
from jaxdrones.dynamics.model import Model, PointMass, constants
from jaxdrones.dynamics.needs import Needs, declare
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State
from jaxdrones.wrench import Wrench

LARGEST_STEP = 1 / 100
"""Longest physics step with which the cables of `with_payload` are stable, s."""
_GRAVITY = 9.8  # m/s^2, of the stretch at rest
_EXAMPLE = "..., from params = jaxdrones.with_payload(params, mass=0.008)"
_FROM_CENTER = "x, y, z from the center of mass, m, body"
_ANCHOR = shape(3, meaning=_FROM_CENTER, name="anchor of the cable", finite=True)


class Payload(PyTreeNode):
    """Constants of a load and of the cable of one drone, `Params.aux["payload"]`; `with_payload` makes them."""

    mass: Array
    """() mass of the load, kg; of a shared load the same in the row of every drone."""
    length: Array
    """() length of the slack cable, m."""
    stiffness: Array
    """() N/m; zero for a drone without a cable to a shared load."""
    damping: Array
    """() N s/m, at a stretch of `onset` and above."""
    onset: Array
    """() stretch below which the damping falls to zero, m."""
    anchor: Array
    """(3,) point of the drone where its cable is attached, from the center of mass, m, body."""


@checked
def with_payload(
    params: Params,
    mass: Annotated[ArrayLike, number("kg", "mass of the load", above=0)],
    length: Annotated[ArrayLike, number("m", "length of the cable", above=0)] = 0.5,
    *,
    stretch: Annotated[float, number("of its length", "stretch of the cable", above=0, at_most=0.5)] = 0.01,
    damping_ratio: Annotated[float, number("of the critical damping", "damping of the cable", at_least=0)] = 0.3,
    anchor: Annotated[Array | Sequence[float], _ANCHOR] = (0.0, 0.0, 0.0),
    cables: Count = 1,
) -> Params:
    """Parameters of a drone or a team with the constants of a load in `aux["payload"]`.

    The stiffness is that of a vertical cable with the given stretch under its share of the load at 9.8 m/s^2, the
    damping a fraction of the critical damping of drone and load on that cable.

    Args:
        params: of one drone or of a team.
        mass: mass of the load, kg. For values that a learner or an optimizer changes, it may be traced.
        length: length of the slack cable, m.
        stretch: stretch of the cable at rest over its length.
        damping_ratio: damping over the critical damping.
        anchor: (3,) point of the drone where the cable is attached, from the center of mass, m, body.
        cables: number of cables that share the load.

    Raises:
        ValueError: a number out of range, or a cable so stiff that a physics step of 1/100 s would be unstable.
    """
    dtype = jnp.result_type(params.mass)
    mass, length, anchor = (jnp.asarray(x, dtype) for x in (mass, length, anchor))
    share = mass / cables
    onset = stretch * length
    stiffness = share * _GRAVITY / onset
    lever = jnp.sum(anchor**2) / jnp.min(params.inertia, axis=-1)
    reduced_mass = 1 / (1 / share + 1 / params.mass + lever)  # of the stretching of the cable, per drone
    rate = jnp.sqrt(stiffness / reduced_mass)
    _check_stable(rate, damping_ratio)
    damping = 2 * damping_ratio * rate * reduced_mass

    drones = params.mass.shape
    mass, length, stiffness, damping, onset = (
        jnp.broadcast_to(x, drones) for x in (mass, length, stiffness, damping, onset)
    )
    load = Payload(mass, length, stiffness, damping, onset, jnp.broadcast_to(anchor, (*drones, 3)))
    return params.replace(aux=params.aux | {"payload": load})


@checked
def payload(shared: Switch = False) -> Model:
    """Model of loads on cables; `state.aux["payload"]` is their `PointMass`, the effect `cable` pulls the drones.

    A load is not stopped by the ground, by obstacles or by drones, and has no drag. It starts at rest below its drone;
    a shared load starts below the middle of its team, about as far as the cables reach.

    Args:
        shared: whether one load hangs from all drones of a team. Its position and velocity are then the same in the row
            of every drone. By default every drone has a load of its own.
    """
    if shared:
        return Model("payload", _hanging_from_team, _shared_rate, of_team=True)
    return Model("payload", _hanging, _rate)


@declare(Needs(largest_step=LARGEST_STEP))
def cable(params: Params, state: State) -> Wrench:
    """Pull of its cable on a drone; needs the model `payload()` and the constants of `with_payload`."""
    force = rotation.rotate_inverse(state.quat, _pull(params, state))
    return Wrench(force, vector.cross(_constants(params).anchor, force))


def cable_tension(params: Params, state: State) -> Float[Array, ""]:
    """Tension of the cable of a drone, N; arguments and errors as for `cable`."""
    return _tension(params, state)[0]


def _pull(params: Params, state: State) -> Float[Array, "3"]:
    """Force of its cable on a drone, N, world."""
    tension, along = _tension(params, state)
    return tension * along


def _tension(params: Params, state: State) -> tuple[Float[Array, ""], Float[Array, "3"]]:
    """Tension of the cable, N, and unit vector from its anchor to the load, world."""
    if "payload" not in state.aux:
        raise UserError(
            "the effect cable needs a load and state.aux lacks 'payload'; give models=(jaxdrones.payload(),), and "
            "start from step.init(params, state)"
        )
    own, load = _constants(params), state.aux["payload"]
    away = load.pos - _anchor(params, state)
    turning = rotation.rotate(state.quat, vector.cross(state.omega, own.anchor))
    length = vector.safe_sqrt(vector.dot(away, away))
    along = vector.unit(away)
    stretch = jnp.maximum(length - own.length, 0)
    growth = vector.dot(load.vel - state.vel - turning, along)
    damping = own.damping * jnp.minimum(stretch / own.onset, 1)
    return jnp.maximum(own.stiffness * stretch + damping * growth, 0), along


def _rate(params: Params, state: State, command: Float[Array, "4"]) -> PointMass:
    return _falling(params, state.aux["payload"], -_pull(params, state))


def _shared_rate(params: Params, state: State, command: Float[Array, "n 4"]) -> PointMass:
    total = jnp.sum(jax.vmap(_pull)(params, state), axis=0)
    return jax.vmap(lambda params, load: _falling(params, load, -total))(params, state.aux["payload"])


def _falling(params: Params, load: PointMass, force: Float[Array, "3"]) -> PointMass:
    """Velocity and acceleration of a load on which cables exert a force (N, world)."""
    return PointMass(load.vel, force / _constants(params).mass - vector.along_z(params.gravity))


def _hanging(params: Params, state: State) -> PointMass:
    """Load at rest below its drone."""
    own = _constants(params)
    stretched = own.length + own.mass * params.gravity / own.stiffness
    return PointMass(_anchor(params, state) - vector.along_z(stretched), state.vel)


def _hanging_from_team(params: Params, state: State) -> PointMass:
    """Load below the middle of the team, at rest relative to it.

    Its distance is that of equal cables from a circle of drones: the mean length, stretched by the tension.
    """
    own, anchors = _constants(params), jax.vmap(_anchor)(params, state)
    middle, mean_vel = jnp.mean(anchors, axis=0), jnp.mean(state.vel, axis=0)
    beside = jnp.mean(jnp.sum((anchors - middle[None])[:, :2] ** 2, axis=1))
    length = jnp.mean(own.length)
    weight = own.mass[0] * params.gravity[0]
    height = jnp.sqrt(jnp.maximum(length**2 - beside, (0.1 * length) ** 2))
    length += weight * length / (height * jnp.sum(own.stiffness))
    height = jnp.sqrt(jnp.maximum(length**2 - beside, (0.1 * length) ** 2))
    rows = anchors.shape
    return PointMass(jnp.broadcast_to(middle - vector.along_z(height), rows), jnp.broadcast_to(mean_vel, rows))


def _anchor(params: Params, state: State) -> Float[Array, "3"]:
    """Point of the drone where its cable is attached, m, world."""
    return state.pos + rotation.rotate(state.quat, _constants(params).anchor)


def _constants(params: Params) -> Payload:
    own: Payload = constants(params, "payload", _EXAMPLE)
    return own


def _check_stable(rate: Array, damping_ratio: float) -> None:
    """Raise unless semi-implicit Euler is stable at the largest step for a stretching cable.

    The oscillation x'' + 2 z w x' + w^2 x = 0 is stable for (w dt)^2 + 4 z w dt < 4.
    """
    if not is_concrete(rate):
        return
    fastest = float(np.max(rate))
    longest = 2 * (np.sqrt(1 + damping_ratio**2) - damping_ratio) / fastest
    if longest < LARGEST_STEP:
        raise UserError(
            f"a cable that stretches at {fastest:.3g} rad/s with a damping of {damping_ratio:g} of the critical one is "
            f"stable up to physics steps of {longest:.2g} s, below 1/100 s; give a longer cable, a larger stretch or "
            "less damping"
        )
