"""Tracking controller of Mellinger and Kumar (2011) in the version of the Crazyflie's firmware.

The control law is that of Hoenig and Preiss in Bitcraze's firmware: position control with an integral, the attitude
error on SO(3), and a derivative of the roll and pitch rates. It runs at 500 Hz and also follows velocity, acceleration
and rates of the set-point. Thrust and torque are 16-bit numbers, limited as in the firmware but not rounded. It needs
rotors with a lag of less than 0.1 s: with the fall time of 0.25 s of `cf2x` it oscillates.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation, vector
from jaxdrones.arguments import TimeStep, checked
from jaxdrones.control import attitude
from jaxdrones.control import firmware_motors as motors
from jaxdrones.control.firmware_loops import degrees, low_pass, settled
from jaxdrones.control.setpoint import Setpoint
from jaxdrones.control.single import Finite, OneParams, OneSetpoint, OneState
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State

_GRAVITY = 9.81  # m/s^2
_MAX_TORQUE = 32000.0  # 16 bit
_MASSES = {"2.1": 0.029, "2.1+": 0.029, "thrust upgrade": 0.0325}  # kg, in the firmware


class Gains(PyTreeNode):
    """Gains and limits of position and attitude, and the vehicle parameters in the firmware."""

    pos_p: Array
    """(3,) N/m, world."""
    pos_i: Array
    """(3,) N/(m s)."""
    pos_d: Array
    """(3,) N s/m."""
    max_pos_integral: Array
    """(3,) m s."""
    attitude_p: Array
    """(3,) 16 bit per half radian, body."""
    attitude_i: Array
    """(3,) 16 bit per half radian and second."""
    max_attitude_integral: Array
    """(3,) half radians s."""
    rate_p: Array
    """(3,) 16 bit per rad/s."""
    rate_d: Array
    """(3,) 16 bit per rad/s^2."""
    weight: Array
    """() weight of the vehicle, N."""
    mass: Array
    """() mass of the vehicle, kg."""
    thrust: Array
    """() thrust command of each motor per total thrust, 16 bit per N."""
    gyro_cutoff: Array
    """() cutoff frequency of the low-pass filter of the gyroscope (Butterworth, second order), Hz."""
    motor: motors.Motor
    """Motor whose maximum thrust is the full command."""


class Memory(PyTreeNode):
    """State of the controller of one drone between calls; zero before the first call."""

    pos_integral: Array
    """(3,) integrated position error, m s."""
    attitude_integral: Array
    """(3,) integrated attitude error, half radians s."""
    rate_error: Array
    """(3,) error of the body rates at the last call, rad/s."""
    gyro: Array
    """(2, 3) state of the low-pass filter of the body rates, rad/s."""
    battery: Array
    """() filtered voltage of the battery, V."""
    running: Array
    """() 1 after the first call."""


def gains(params: Params | None = None, propellers: str = "2.1+") -> Gains:
    """Gains of the firmware for a Crazyflie 2.1, or scaled to the drone with these parameters.

    With scaled gains, an error causes the same linear and angular acceleration as on a Crazyflie. The propellers are a
    name of `firmware_motors.PROPELLERS`.
    """
    motor = motors.motor(propellers)
    force, torque = jnp.ones(()), jnp.ones(3)
    mass = jnp.array(_MASSES[propellers])
    weight = mass * _GRAVITY
    if params is not None:
        force, torque = motors.scale(params)
        mass, weight = params.mass, params.weight
        motor = motor.replace(max_thrust=motor.max_thrust * force)
    return Gains(
        pos_p=force * jnp.array([0.4, 0.4, 1.25]),
        pos_i=force * jnp.array([0.05, 0.05, 0.05]),
        pos_d=force * jnp.array([0.2, 0.2, 0.4]),
        max_pos_integral=jnp.array([2.0, 2.0, 0.4]),
        attitude_p=torque * jnp.array([70000.0, 70000.0, 60000.0]),
        attitude_i=torque * jnp.array([0.0, 0.0, 500.0]),
        max_attitude_integral=jnp.array([1.0, 1.0, 1500.0]),
        rate_p=torque * jnp.array([20000.0, 20000.0, 12000.0]),
        rate_d=torque * jnp.array([200.0, 200.0, 0.0]),
        weight=weight,
        mass=mass,
        thrust=132000 / force,
        gyro_cutoff=jnp.array(80.0),
        motor=motor,
    )


def init() -> Memory:
    """Memory of a drone before the first call."""
    zero = jnp.zeros(3)
    return Memory(zero, zero, zero, jnp.zeros((2, 3)), jnp.zeros(()), jnp.zeros(()))


@checked
def control(
    gains: Finite[Gains], params: OneParams, memory: Memory, state: OneState, setpoint: OneSetpoint, *, dt: TimeStep
) -> tuple[Memory, Float[Array, "4"]]:
    """Rotor speeds of one drone, RPM, up to `max_rpm`, for the thrusts of the firmware; see `jaxdrones.control`.

    All of pos, vel, acc, yaw and omega of the setpoint are used; `dt` is 0.002 s on the vehicle.
    """
    memory, _, thrust, torque = _fly(gains, memory, state, setpoint, dt)
    return memory, motors.rotor_speeds(gains.motor, params, thrust, torque)


@checked
def pwm(
    gains: Finite[Gains],
    memory: Memory,
    state: OneState,
    setpoint: OneSetpoint,
    battery: Float[Array, ""] | float | None = None,
    *,
    dt: TimeStep = 0.002,
) -> tuple[Memory, motors.Command]:
    """Firmware commands of one Crazyflie: desired attitude, thrust, and duty cycles of the motors.

    Arguments are those of `control`, and the battery voltage for its compensation, V; without it a duty cycle equals
    the command.
    """
    memory, axes, thrust, torque = _fly(gains, memory, state, setpoint, dt)
    voltage, duty = motors.duty_cycles(gains.motor, thrust, torque, battery, memory.battery, dt)
    target = degrees(rotation.to_rpy(rotation.from_matrix(jnp.stack(axes, axis=-1))))
    return memory.replace(battery=voltage), motors.Command(target, thrust, torque, duty)


def _fly(
    gains: Gains, memory: Memory, state: State, setpoint: Setpoint, dt: float
) -> tuple[Memory, attitude.Axes, Float[Array, ""], Float[Array, "3"]]:
    """Memory, desired body axes, thrust and torque (16 bit)."""
    first = memory.running == 0

    pos_error = setpoint.pos - state.pos
    limit = gains.max_pos_integral
    pos_integral = jnp.clip(memory.pos_integral + dt * pos_error, -limit, limit)
    force = gains.pos_p * pos_error + gains.pos_d * (setpoint.vel - state.vel) + gains.pos_i * pos_integral
    force = force + gains.mass * setpoint.acc + vector.along_z(gains.weight)
    axes, target = rotation.axes(state.quat), attitude.from_thrust(force, setpoint.yaw)
    thrust = jnp.clip(gains.thrust * vector.dot(force, axes[2]), 0, motors.FULL)

    gyro = jnp.where(first, settled(state.omega, gains.gyro_cutoff, dt), memory.gyro)
    gyro, omega = low_pass(gyro, state.omega, gains.gyro_cutoff, dt)
    error = 2 * attitude.error(axes, target)
    limit = gains.max_attitude_integral
    integral = jnp.clip(memory.attitude_integral - dt * error, -limit, limit)
    rate_error = setpoint.omega - omega
    change = (rate_error - jnp.where(first, rate_error, memory.rate_error)) / dt
    torque = -gains.attitude_p * error + gains.attitude_i * integral
    torque = torque + gains.rate_p * rate_error + gains.rate_d * change
    flying = thrust > 0  # otherwise the motors stop and the integrators are reset
    memory = Memory(
        pos_integral=jnp.where(flying, pos_integral, 0),
        attitude_integral=jnp.where(flying, integral, 0),
        rate_error=rate_error,
        gyro=gyro,
        battery=memory.battery,
        running=jnp.ones_like(memory.running),
    )
    return memory, target, thrust, jnp.where(flying, jnp.clip(torque, -_MAX_TORQUE, _MAX_TORQUE), 0)
