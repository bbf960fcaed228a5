"""Geometric tracking on SE(3) (Lee, Leok, McClamroch 2010; the attitude target after Mellinger and Kumar 2011)."""

from typing import Any, cast

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation, vector
from jaxdrones.arguments import TimeStep, checked
from jaxdrones.control import attitude
from jaxdrones.control.allocation import rpm_from_wrench
from jaxdrones.control.single import Finite, OneParams, OneSetpoint, OneState
from jaxdrones.pytree import PyTreeNode


class Gains(PyTreeNode):
    """Gains per unit of mass and inertia, independent of the vehicle."""

    pos: Array
    """(3,) 1/s^2."""
    vel: Array
    """(3,) 1/s."""
    attitude: Array
    """(3,) 1/s^2."""
    rate: Array
    """(3,) 1/s."""


def gains() -> Gains:
    """Gains for instant rotors: bandwidth 2.5 rad/s in position, 20 in tilt, 10 in yaw, damping ratio 0.7 to 0.8."""
    return Gains(
        pos=jnp.array([6.25, 6.25, 6.25]),
        vel=jnp.array([4.0, 4.0, 4.0]),
        attitude=jnp.array([400.0, 400.0, 100.0]),
        rate=jnp.array([28.0, 28.0, 14.0]),
    )


def init() -> None:
    """Empty memory."""


@checked
def control(
    gains: Finite[Gains], params: OneParams, memory: Any, state: OneState, setpoint: OneSetpoint, *, dt: TimeStep
) -> tuple[Any, Float[Array, "4"]]:
    """Rotor speeds of one drone, RPM, between 0 and `max_rpm`.

    f = m (a_d - k_x e_x - k_v e_v + g e_z), thrust f . R e_z, and
    tau = -J (k_R e_R + k_w e_w) + w x J w - J (w x R^T R_d w_d), with e_w = w - R^T R_d w_d.

    All of pos, vel, acc, yaw and omega of the setpoint are used. See `jaxdrones.control`.
    """
    acc = setpoint.acc + gains.pos * (setpoint.pos - state.pos) + gains.vel * (setpoint.vel - state.vel)
    acc = acc + vector.along_z(params.gravity)
    axes = rotation.axes(state.quat)
    target = attitude.from_thrust(acc, setpoint.yaw)

    thrust = params.mass * vector.dot(acc, axes[2])
    rates = zip(vector.components(setpoint.omega), target, strict=True)
    target_omega = cast(Array, sum(rate * axis for rate, axis in rates))  # world
    omega_target = jnp.stack([vector.dot(axis, target_omega) for axis in axes])
    omega_rate = (
        -gains.attitude * attitude.error(axes, target)
        - gains.rate * (state.omega - omega_target)
        - vector.cross(state.omega, omega_target)
    )
    torque = params.inertia * omega_rate + vector.cross(state.omega, params.inertia * state.omega)
    return memory, rpm_from_wrench(params, jnp.maximum(thrust, 0), torque)
