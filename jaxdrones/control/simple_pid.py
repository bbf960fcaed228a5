"""Simple PID of gym-pybullet-drones for the Hummingbird.

The desired force gives the angles; thrust and torque give the rotor speeds by least squares.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation, vector
from jaxdrones.arguments import TimeStep, checked
from jaxdrones.control.allocation import rpm_from_wrench
from jaxdrones.control.single import Finite, OneParams, OneSetpoint, OneState
from jaxdrones.pytree import PyTreeNode
from jaxdrones.vector import atan2, safe_sqrt

_MAX_TILT = jnp.pi / 6  # rad, of the roll and pitch targets


class Gains(PyTreeNode):
    """Gains of the two loops."""

    pos_p: Array
    """(3,) N/m."""
    pos_i: Array
    """(3,) N/(m s)."""
    pos_d: Array
    """(3,) N s/m."""
    rpy_p: Array
    """(3,) N m/rad."""
    rpy_i: Array
    """(3,) N m/(rad s)."""
    rpy_d: Array
    """(3,) N m s/rad."""


class Memory(PyTreeNode):
    """State of the controller of one drone between calls; zero before the first call."""

    pos_integral: Array
    """(3,) integrated position error, m s; not limited."""
    rpy_integral: Array
    """(3,) integrated angle error, rad s; not limited."""
    pos_error: Array
    """(3,) position error at the last call, m."""
    rpy_error: Array
    """(3,) angle error at the last call, rad."""


def gains() -> Gains:
    """Gains of gym-pybullet-drones for the Hummingbird (`hb`)."""
    return Gains(
        pos_p=jnp.array([0.1, 0.1, 0.2]),
        pos_i=jnp.array([1e-4, 1e-4, 1e-4]),
        pos_d=jnp.array([0.3, 0.3, 0.4]),
        rpy_p=jnp.array([0.3, 0.3, 0.05]),
        rpy_i=jnp.array([1e-4, 1e-4, 1e-4]),
        rpy_d=jnp.array([0.3, 0.3, 0.5]),
    )


def init() -> Memory:
    """Memory of a drone before the first call."""
    return Memory(jnp.zeros(3), jnp.zeros(3), jnp.zeros(3), jnp.zeros(3))


@checked
def control(
    gains: Finite[Gains], params: OneParams, memory: Memory, state: OneState, setpoint: OneSetpoint, *, dt: TimeStep
) -> tuple[Memory, Float[Array, "4"]]:
    """Rotor speeds of one drone, RPM, up to `max_rpm` (unlimited in gym-pybullet-drones).

    The controller keeps yaw at zero: it uses only `pos` of the setpoint. Derivatives are differences of errors, so the
    first call has a spike. With the inertia of the Hummingbird it needs 60 calls per second
    (gym-pybullet-drones has 48 calls and five times this inertia).

    See `jaxdrones.control`.
    """
    pos_error = setpoint.pos - state.pos
    pos_integral = memory.pos_integral + pos_error * dt
    pos_rate = (pos_error - memory.pos_error) / dt
    force = gains.pos_p * pos_error + gains.pos_i * pos_integral + gains.pos_d * pos_rate
    force = force + vector.along_z(params.weight)

    rpy_error = _angles_of(force) - rotation.to_rpy(state.quat)
    rpy_integral = memory.rpy_integral + rpy_error * dt
    rpy_rate = (rpy_error - memory.rpy_error) / dt
    torque = gains.rpy_p * rpy_error + gains.rpy_i * rpy_integral + gains.rpy_d * rpy_rate

    thrust = rotation.rotate(state.quat, force)[2]  # as in gym-pybullet-drones; the force along body z would be R^T f
    return Memory(pos_integral, rpy_integral, pos_error, rpy_error), rpm_from_wrench(params, thrust, torque)


def _angles_of(force: Float[Array, "3"]) -> Float[Array, "3"]:
    """Limited roll and pitch for body z (or -z) along the force, and zero yaw; rad."""
    x, y, z = jnp.where(force[2] < 0, -force, force)
    roll = atan2(-y, safe_sqrt(x**2 + z**2))
    pitch = atan2(x, z)
    return jnp.clip(jnp.stack([roll, pitch, jnp.zeros_like(roll)]), -_MAX_TILT, _MAX_TILT)
