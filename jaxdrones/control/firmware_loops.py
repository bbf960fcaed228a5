"""Four loops of the Crazyflie's cascaded PID; each computes the set-point of the next one.

Gains and limits are those of Bitcraze's firmware, release 2025.12; the code is an independent implementation of its
description. Angles are in degrees and rates in degrees per second; pitch is positive nose up, as in the firmware. The
heading frame is the world frame, rotated by yaw. Thrust and torque are in units of the firmware's 16-bit commands.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation, vector
from jaxdrones.control.firmware_motors import FULL, Motor
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State

_MAX_INTEGRAL = 5000.0  # m s and m; limit of integrators without a limit in the firmware
_OVERHEAD = 1.1  # commanded velocity limit over `max_vel`
_THRUST_PER_OUTPUT = 1000.0
_MAX_TORQUE = 32767.0  # signed 16 bit
_MAX_CUTOFF = 0.4  # largest cutoff frequency of a low-pass over the sampling rate
_FIRMWARE_SIGN = (1.0, -1.0, 1.0)  # of roll, pitch, yaw: the firmware has the opposite sign of pitch and of its rate


class Gains(PyTreeNode):
    """Gains and limits of the four loops, and the firmware's model of the motor."""

    pos_p: Array
    """(3,) 1/s, heading frame."""
    pos_i: Array
    """(3,) 1/s^2."""
    max_vel: Array
    """(3,) m/s; the position loop commands at most 1.1 times this."""
    vel_p: Array
    """(3,) degrees per m/s forward and left, 1000 units of thrust per m/s up."""
    vel_i: Array
    """(3,) degrees per m forward and left, 1000 units of thrust per m up."""
    max_tilt: Array
    """() limit of roll and pitch, degrees."""
    base_thrust: Array
    """() thrust command near hover, 16 bit."""
    min_thrust: Array
    """() smallest thrust command in the air, 16 bit."""
    attitude_p: Array
    """(3,) roll, pitch, yaw, 1/s."""
    attitude_i: Array
    """(3,) 1/s^2."""
    attitude_d: Array
    """(3,) gain of the derivative of the measured angle, dimensionless."""
    max_attitude_integral: Array
    """(3,) degrees s."""
    rate_p: Array
    """(3,) 16 bit per degree/s."""
    rate_i: Array
    """(3,) 16 bit per degree."""
    rate_d: Array
    """(3,) gain of the derivative of the measured rate, 16 bit per degree/s^2."""
    max_rate_integral: Array
    """(3,) degrees."""
    gyro_cutoff: Array
    """() cutoff frequency of the low-pass filter of the gyroscope (Butterworth, second order), Hz."""
    motor: Motor
    """Motor whose maximum thrust is the full command."""


class Memory(PyTreeNode):
    """State of the controller of one drone between calls."""

    pos_integral: Array
    """(3,) integrated position error, m s, heading frame."""
    vel_integral: Array
    """(3,) integrated velocity error, m, heading frame."""
    attitude_integral: Array
    """(3,) integrated attitude error, degrees s."""
    rate_integral: Array
    """(3,) integrated error of the rates, degrees."""
    rpy: Array
    """(3,) roll, pitch, yaw at the last call, degrees."""
    rates: Array
    """(3,) low-pass filtered rates about the body axes at the last call, degrees/s."""
    gyro: Array
    """(2, 3) state of this low-pass filter, degrees/s."""
    tilt: Array
    """(2,) roll and pitch commanded by the loops of position and velocity, degrees."""
    thrust: Array
    """() thrust commanded by these loops, 16 bit."""
    battery: Array
    """() filtered voltage of the battery, V."""
    age: Array
    """() time since the loops of position and velocity ran, s; infinite before the first call."""


def degrees(angles: Float[Array, "3"]) -> Float[Array, "3"]:
    """Roll, pitch and yaw, or the rates about the body axes, in degrees and with the firmware's signs."""
    return jnp.rad2deg(angles) * jnp.array(_FIRMWARE_SIGN)


def rpy(quat: Float[Array, "4"]) -> Float[Array, "3"]:
    """Roll, pitch and yaw of an attitude, degrees, with the firmware's signs."""
    return degrees(rotation.to_rpy(quat))


def in_heading_frame(quat: Float[Array, "4"], v: Float[Array, "3"]) -> Float[Array, "3"]:
    """Forward, left and up components of a world vector; with a vertical nose the horizontal ones are zero."""
    nose_x, nose_y, _ = vector.components(rotation.axes(quat)[0])
    x, y, z = vector.components(v)
    cos, sin, _ = vector.components(vector.unit(jnp.stack([nose_x, nose_y, jnp.zeros_like(nose_x)])))
    return jnp.stack([cos * x + sin * y, cos * y - sin * x, z])


def position_loop(
    gains: Gains, memory: Memory, state: State, pos: Float[Array, "3"], dt: Array | float
) -> tuple[Memory, Float[Array, "3"]]:
    """Velocity (m/s, heading frame) towards a position (m, world)."""
    error = in_heading_frame(state.quat, pos - state.pos)
    integral = jnp.clip(memory.pos_integral + error * dt, -_MAX_INTEGRAL, _MAX_INTEGRAL)
    limit = _OVERHEAD * gains.max_vel
    vel = jnp.clip(gains.pos_p * error + gains.pos_i * integral, -limit, limit)
    return memory.replace(pos_integral=integral), vel


def velocity_loop(
    gains: Gains, memory: Memory, state: State, vel: Float[Array, "3"], dt: Array | float
) -> tuple[Memory, Float[Array, "2"], Float[Array, ""]]:
    """Roll and pitch (degrees) and thrust (16 bit) towards a velocity (m/s, heading frame)."""
    error = vel - in_heading_frame(state.quat, state.vel)
    integral = jnp.clip(memory.vel_integral + error * dt, -_MAX_INTEGRAL, _MAX_INTEGRAL)
    forward, left, up = vector.components(gains.vel_p * error + gains.vel_i * integral)
    tilt = jnp.clip(-jnp.stack([left, forward]), -gains.max_tilt, gains.max_tilt)
    limit = _MAX_TORQUE / _THRUST_PER_OUTPUT
    thrust = gains.base_thrust + _THRUST_PER_OUTPUT * jnp.clip(up, -limit, limit)
    return memory.replace(vel_integral=integral), tilt, jnp.clip(thrust, gains.min_thrust, FULL)


def attitude_loop(
    gains: Gains, memory: Memory, state: State, attitude: Float[Array, "3"], dt: Array | float
) -> tuple[Memory, Float[Array, "3"]]:
    """Rates (degrees/s) towards roll, pitch and yaw (degrees); yaw goes the shorter way."""
    measured = rpy(state.quat)
    error = _wrap_yaw(attitude - measured)
    limit = gains.max_attitude_integral
    integral = jnp.clip(memory.attitude_integral + error * dt, -limit, limit)
    change = _wrap_yaw(measured - memory.rpy) / dt
    target = gains.attitude_p * error + gains.attitude_i * integral - gains.attitude_d * change
    return memory.replace(attitude_integral=integral, rpy=measured), target


def rate_loop(
    gains: Gains, memory: Memory, state: State, target: Float[Array, "3"], dt: Array | float
) -> tuple[Memory, Float[Array, "3"]]:
    """Torque (16 bit, right-handed body axes) towards rates (degrees/s)."""
    gyro, measured = low_pass(memory.gyro, degrees(state.omega), gains.gyro_cutoff, dt)
    error = target - measured
    limit = gains.max_rate_integral
    integral = jnp.clip(memory.rate_integral + error * dt, -limit, limit)
    change = (measured - memory.rates) / dt
    output = gains.rate_p * error + gains.rate_i * integral - gains.rate_d * change
    torque = jnp.clip(output, -_MAX_TORQUE, _MAX_TORQUE) * jnp.array(_FIRMWARE_SIGN)
    return memory.replace(rate_integral=integral, rates=measured, gyro=gyro), torque


def low_pass(
    memory: Float[Array, "2 3"], x: Float[Array, "3"], cutoff: Float[Array, ""], dt: Array | float
) -> tuple[Float[Array, "2 3"], Float[Array, "3"]]:
    """Filter state and filtered x: Butterworth, second order, bilinear transform, cutoff (Hz) of at most 0.4/dt."""
    b, a1, a2 = _butterworth(cutoff, dt)
    y = b * x + memory[0]
    return jnp.stack([2 * b * x - a1 * y + memory[1], b * x - a2 * y]), y


def settled(x: Float[Array, "3"], cutoff: Float[Array, ""], dt: Array | float) -> Float[Array, "2 3"]:
    """The steady state of the low-pass filter for a constant input x."""
    b, _, a2 = _butterworth(cutoff, dt)
    return jnp.stack([(1 - b) * x, (b - a2) * x])


def _butterworth(cutoff: Array, dt: Array | float) -> tuple[Array, Array, Array]:
    w = jnp.tan(jnp.pi * jnp.minimum(cutoff * dt, _MAX_CUTOFF))
    scale = 1 / (1 + 2**0.5 * w + w * w)
    return w * w * scale, 2 * (w * w - 1) * scale, (1 - 2**0.5 * w + w * w) * scale


def _wrap_yaw(angles: Float[Array, "3"]) -> Float[Array, "3"]:
    """Angles (degrees) with yaw wrapped to -180 to 180."""
    turns = jnp.round(angles / 360) * jnp.array([0.0, 0.0, 1.0])
    return angles - 360 * turns
