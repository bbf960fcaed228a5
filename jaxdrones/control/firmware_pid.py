"""Cascaded PID of the Crazyflie's firmware (Bitcraze, release 2025.12).

The loops of position and velocity run at 100 Hz, those of attitude and rates at every call, which is 500 Hz on the
vehicle. The position loop commands `pos_p` times the distance, without the velocity of the set-point, so the vehicle
lags a moving set-point by 0.5 s. 16-bit numbers are limited as in the firmware, but not rounded, to be differentiable.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.arguments import TimeStep, checked
from jaxdrones.control import firmware_loops as loops
from jaxdrones.control import firmware_motors as motors
from jaxdrones.control.firmware_loops import Gains, Memory
from jaxdrones.control.setpoint import Setpoint
from jaxdrones.control.single import Finite, OneParams, OneSetpoint, OneState
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State

_SLOW = 0.01  # s, period of the loops of position and velocity


class Velocity(PyTreeNode):
    """Set-point of velocity."""

    vel: Array
    """(3,) m/s, world."""
    yaw: Array
    """() heading, rad."""


class Attitude(PyTreeNode):
    """Set-point of attitude and thrust."""

    rpy: Array
    """(3,) roll, pitch, yaw about fixed axes, rad, right-handed."""
    thrust: Array
    """() thrust of each motor, 16 bit; at 0 the motors stop and the integrators are reset."""


class Rates(PyTreeNode):
    """Set-point of body rates and thrust."""

    omega: Array
    """(3,) rad/s, body, right-handed."""
    thrust: Array
    """() thrust of each motor, 16 bit; at 0 the motors stop and the integrators are reset."""


class PerAxis(PyTreeNode):
    """Set-point with a mode for each axis, as in the firmware's commander: the mode is a number, not a type."""

    pos: Array
    """(3,) m, world."""
    vel: Array
    """(3,) m/s, world."""
    by_pos: Array
    """(3,) whether an axis follows `pos`, not `vel`; x and y are equal."""
    rpy: Array
    """(3,) roll, pitch, yaw about fixed axes, rad, right-handed; the yaw is always followed."""
    omega: Array
    """(3,) body rates, rad/s, right-handed; roll and pitch are used."""
    tilt_given: Array
    """() whether roll and pitch follow `rpy` or `omega`, not x and y."""
    rates_given: Array
    """(2,) whether roll and whether pitch follows `omega`, not `rpy`."""
    thrust: Array
    """() thrust of each motor, 16 bit; at 0 the motors stop and the integrators are reset."""
    thrust_given: Array
    """() whether `thrust` is used, and z is not followed."""


AnySetpoint = OneSetpoint | Velocity | Attitude | Rates | PerAxis


def gains(params: Params | None = None, propellers: str = "2.1+") -> Gains:
    """Gains of the firmware for a Crazyflie 2.1, or scaled to the drone with these parameters.

    With scaled gains, a command gives the thrust over weight and the angular acceleration of a Crazyflie. The
    firmware's thrust curve of the motor voltage is not scaled. The propellers are a name of
    `firmware_motors.PROPELLERS`.
    """
    torque, motor = jnp.ones(3), motors.motor(propellers)
    if params is not None:
        weight, torque = motors.scale(params)
        motor = motor.replace(max_thrust=motor.max_thrust * weight)
    return Gains(
        pos_p=jnp.array([2.0, 2.0, 2.0]),
        pos_i=jnp.array([0.0, 0.0, 0.5]),
        max_vel=jnp.array([1.0, 1.0, 1.0]),
        vel_p=jnp.array([25.0, 25.0, 25.0]),
        vel_i=jnp.array([1.0, 1.0, 15.0]),
        max_tilt=jnp.array(20.0),
        base_thrust=jnp.array(36000.0),
        min_thrust=jnp.array(20000.0),
        attitude_p=jnp.array([6.0, 6.0, 6.0]),
        attitude_i=jnp.array([3.0, 3.0, 1.0]),
        attitude_d=jnp.array([0.0, 0.0, 0.35]),
        max_attitude_integral=jnp.array([20.0, 20.0, 360.0]),
        rate_p=torque * jnp.array([250.0, 250.0, 120.0]),
        rate_i=torque * jnp.array([500.0, 500.0, 16.7]),
        rate_d=torque * jnp.array([2.5, 2.5, 0.0]),
        max_rate_integral=jnp.array([33.3, 33.3, 166.7]),
        gyro_cutoff=jnp.array(80.0),
        motor=motor,
    )


def init() -> Memory:
    """Memory of a drone before the first call."""
    zero = jnp.zeros(3)
    return Memory(
        pos_integral=zero,
        vel_integral=zero,
        attitude_integral=zero,
        rate_integral=zero,
        rpy=zero,
        rates=zero,
        gyro=jnp.zeros((2, 3)),
        tilt=jnp.zeros(2),
        thrust=jnp.zeros(()),
        battery=jnp.zeros(()),
        age=jnp.array(jnp.inf),
    )


def reset(memory: Memory) -> Memory:
    """Memory with the integrators at zero.

    The firmware resets them when the kind of the set-point changes, as at the start of a landing, and while the motors
    are off.
    """
    names = ("pos_integral", "vel_integral", "attitude_integral", "rate_integral")
    return memory.replace(**{name: jnp.zeros_like(getattr(memory, name)) for name in names})


@checked
def control(
    gains: Finite[Gains], params: OneParams, memory: Memory, state: OneState, setpoint: AnySetpoint, *, dt: TimeStep
) -> tuple[Memory, Float[Array, "4"]]:
    """Rotor speeds of one drone, RPM, up to `max_rpm`, for the thrusts of the firmware; see `jaxdrones.control`.

    With battery compensation a command is a fraction of `gains.motor.max_thrust` at any battery voltage, and the
    vehicle's `kf` gives the rotor speed for this thrust. The mixing follows from the geometry of the rotors. The
    setpoint is a `Setpoint` (only pos and yaw are used), `Velocity`, `Attitude`, `Rates` or `PerAxis`; `dt` is 0.002 s
    on the vehicle.
    """
    memory, _, thrust, torque = _fly(gains, memory, state, setpoint, dt)
    return memory, motors.rotor_speeds(gains.motor, params, thrust, torque)


@checked
def pwm(
    gains: Finite[Gains],
    memory: Memory,
    state: OneState,
    setpoint: AnySetpoint,
    battery: Float[Array, ""] | float | None = None,
    *,
    dt: TimeStep = 0.002,
) -> tuple[Memory, motors.Command]:
    """Firmware commands of one Crazyflie: desired attitude, thrust, and duty cycles of the motors.

    Arguments are those of `control`, and the battery voltage for its compensation, V, filtered over 0.1 s; None
    disables the compensation, so that a duty cycle equals the command.
    """
    memory, attitude, thrust, torque = _fly(gains, memory, state, setpoint, dt)
    voltage, duty = motors.duty_cycles(gains.motor, thrust, torque, battery, memory.battery, dt)
    return memory.replace(battery=voltage), motors.Command(attitude, thrust, torque, duty)


def _fly(
    gains: Gains, memory: Memory, state: State, setpoint: AnySetpoint, dt: float
) -> tuple[Memory, Float[Array, "3"], Float[Array, ""], Float[Array, "3"]]:
    """Memory, desired attitude (degrees), thrust and torque (16 bit)."""
    memory = _first_measured(gains, memory, state, dt)
    if isinstance(setpoint, PerAxis):
        return _fly_per_axis(gains, memory, state, setpoint, dt)
    if isinstance(setpoint, Setpoint | Velocity):
        memory = _slow_loops(gains, memory, state, setpoint, dt)
        attitude, thrust = jnp.append(memory.tilt, jnp.rad2deg(setpoint.yaw)), memory.thrust
    elif isinstance(setpoint, Attitude | Rates):
        memory = memory.replace(age=jnp.minimum(memory.age + dt, jnp.maximum(_SLOW, dt)))  # the slow loops become due
        attitude, thrust = loops.rpy(state.quat), jnp.clip(setpoint.thrust, 0, motors.FULL)
    else:
        raise UserError(
            f"setpoint is a {type(setpoint).__name__}; give a Setpoint, Velocity, Attitude, Rates or PerAxis"
        )
    if isinstance(setpoint, Attitude):
        attitude = loops.degrees(setpoint.rpy)
    if isinstance(setpoint, Rates):
        memory = memory.replace(rpy=attitude, attitude_integral=jnp.zeros_like(memory.attitude_integral))
        target = loops.degrees(setpoint.omega)
    else:
        memory, target = loops.attitude_loop(gains, memory, state, attitude, dt)
    return _with_torque(gains, memory, state, attitude, thrust, target, dt)


def _with_torque(
    gains: Gains, memory: Memory, state: State, attitude: Array, thrust: Array, target: Array, dt: float
) -> tuple[Memory, Float[Array, "3"], Float[Array, ""], Float[Array, "3"]]:
    """Memory, desired attitude, thrust and the torque towards target rates; none while the motors are off."""
    memory, torque = loops.rate_loop(gains, memory, state, target, dt)
    memory = jax.tree.map(lambda kept, empty: jnp.where(thrust > 0, kept, empty), memory, reset(memory))
    return memory, attitude, thrust, jnp.where(thrust > 0, torque, 0)


def _fly_per_axis(
    gains: Gains, memory: Memory, state: State, setpoint: PerAxis, dt: float
) -> tuple[Memory, Float[Array, "3"], Float[Array, ""], Float[Array, "3"]]:
    """As `_fly`, with the modes of a `PerAxis`; the integrators of loops that are not used stay at zero."""
    unused = jnp.stack([setpoint.tilt_given, setpoint.tilt_given, setpoint.thrust_given])
    memory = _slow_loops(gains, memory, state, setpoint, dt)
    memory = memory.replace(
        pos_integral=jnp.where(unused | ~setpoint.by_pos, 0, memory.pos_integral),
        vel_integral=jnp.where(unused, 0, memory.vel_integral),
    )
    given = loops.degrees(setpoint.rpy)
    attitude = jnp.append(jnp.where(setpoint.tilt_given, given[:2], memory.tilt), given[2])
    by_rates = jnp.append(setpoint.tilt_given & setpoint.rates_given, False)
    attitude = jnp.where(by_rates, loops.rpy(state.quat), attitude)
    thrust = jnp.where(setpoint.thrust_given, jnp.clip(setpoint.thrust, 0, motors.FULL), memory.thrust)
    memory, target = loops.attitude_loop(gains, memory, state, attitude, dt)
    memory = memory.replace(attitude_integral=jnp.where(by_rates, 0, memory.attitude_integral))
    target = jnp.where(by_rates, loops.degrees(setpoint.omega), target)
    return _with_torque(gains, memory, state, attitude, thrust, target, dt)


def _first_measured(gains: Gains, memory: Memory, state: State, dt: float) -> Memory:
    """Memory with zero derivatives at the first call: past attitude and rates are the present ones."""
    measured = loops.degrees(state.omega)
    start = dict(rpy=loops.rpy(state.quat), rates=measured, gyro=loops.settled(measured, gains.gyro_cutoff, dt))
    first = jnp.isinf(memory.age)
    return memory.replace(**{name: jnp.where(first, value, getattr(memory, name)) for name, value in start.items()})


def _slow_loops(
    gains: Gains, memory: Memory, state: State, setpoint: Setpoint | Velocity | PerAxis, dt: float
) -> Memory:
    """Memory with new tilt and thrust where the loops of position and velocity are due."""
    period = jnp.maximum(_SLOW, dt)
    ran, vel = memory, jnp.zeros(3)
    if isinstance(setpoint, Setpoint | PerAxis):
        ran, vel = loops.position_loop(gains, memory, state, setpoint.pos, period)
    if isinstance(setpoint, Velocity | PerAxis):
        given = loops.in_heading_frame(state.quat, setpoint.vel)
        vel = jnp.where(setpoint.by_pos, vel, given) if isinstance(setpoint, PerAxis) else given
    ran, tilt, thrust = loops.velocity_loop(gains, ran, state, vel, period)
    age = jnp.where(jnp.isinf(memory.age), 0, memory.age - period)
    ran = ran.replace(tilt=tilt, thrust=thrust, age=age)
    due = memory.age > period - dt / 2
    memory = jax.tree.map(lambda new, old: jnp.where(due, new, old), ran, memory)
    return memory.replace(age=memory.age + dt)
