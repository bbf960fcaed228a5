"""The cascaded PID that flies a Crazyflie, as its firmware does (Bitcraze, release 2025.12).

The loops of position and velocity run at 100 Hz, those of attitude and rates at every call, which is 500 Hz on the
vehicle. A position is flown to at `pos_p` times its distance, without the velocity of the set-point: the vehicle trails
a moving one by 0.5 s. 16-bit numbers are limited as in the firmware, but not rounded, so that there is a derivative.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.checks import check_positive, check_shape
from jaxdrones.control import firmware_motors as motors
from jaxdrones.control.allocation import mixer
from jaxdrones.control.firmware_loops import (
    Gains,
    Memory,
    attitude_loop,
    degrees,
    in_heading_frame,
    position_loop,
    rate_loop,
    rpy,
    settled,
    velocity_loop,
)
from jaxdrones.control.setpoint import Setpoint
from jaxdrones.control.single import check_memory, check_single, check_state
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State
from jaxdrones.urdf import load_params
from jaxdrones.vector import safe_sqrt

_SLOW = 0.01  # s, period of the loops of position and velocity
_BATTERY_FILTER = 0.99  # share of the last voltage that the filter of the battery keeps in 1 ms


class Velocity(PyTreeNode):
    """A set-point of velocity."""

    vel: Array
    """(3,) m/s, world."""
    yaw: Array
    """() heading, rad."""


class Attitude(PyTreeNode):
    """A set-point of attitude and thrust."""

    rpy: Array
    """(3,) roll, pitch, yaw about fixed axes, rad, right-handed."""
    thrust: Array
    """() of each motor, 16 bit; at 0 the motors stop and the loops forget."""


class Rates(PyTreeNode):
    """A set-point of body rates and thrust."""

    omega: Array
    """(3,) rad/s, body, right-handed."""
    thrust: Array
    """() of each motor, 16 bit; at 0 the motors stop and the loops forget."""


AnySetpoint = Setpoint | Velocity | Attitude | Rates


class Command(PyTreeNode):
    """What the firmware commands, and logs."""

    attitude: Array
    """(3,) desired roll, pitch, yaw, degrees; pitch is positive nose up. Of set-points of rates the present ones."""
    thrust: Array
    """() of each motor, 16 bit."""
    torque: Array
    """(3,) roll, pitch, yaw, 16 bit, right-handed body axes."""
    pwm: Array
    """(4,) duty cycles of the motors, 0 to 65535: front right, back right, back left, front left."""


def gains(params: Params | None = None, propellers: str = "2.1+") -> Gains:
    """The gains of the firmware for a Crazyflie 2.1, or scaled to another vehicle.

    Scaled ones give every command the share of weight and the angular acceleration that it gives to `cf2x`. What the
    firmware believes of the voltage of its motors is not scaled.

    Args:
        params: of the drone to scale to; a Crazyflie when left out.
        propellers: of the Crazyflie, a name of `firmware_motors.PROPELLERS`.

    Raises:
        ValueError: unknown propellers.
    """
    torque, motor = jnp.ones(3), motors.motor(propellers)
    if params is not None:
        crazyflie = load_params("cf2x")
        torque = _acceleration(crazyflie) / _acceleration(params)
        motor = motor.replace(max_thrust=motor.max_thrust * params.weight / crazyflie.weight)
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


def _acceleration(params: Params) -> Float[Array, "3"]:
    """Angular acceleration of a torque of the size of the thrust that carries the vehicle, 1/s^2."""
    x, y, _ = params.rotor_pos.T
    levers = jnp.stack([y, -x, params.rotor_spin * params.km / params.kf])
    return params.weight * jnp.sum(levers * mixer(params).T, axis=1) / params.inertia


def init() -> Memory:
    """The memory of a drone before the first call."""
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
    """The memory with empty integrators.

    The firmware resets where the kind of the set-point changes, as at the start of a landing, and while motors rest.
    """
    names = ("pos_integral", "vel_integral", "attitude_integral", "rate_integral")
    return memory.replace(**{name: jnp.zeros_like(getattr(memory, name)) for name in names})


def control(
    gains: Gains, params: Params, memory: Memory, state: State, setpoint: AnySetpoint, *, dt: float
) -> tuple[Memory, Float[Array, "4"]]:
    """Rotor speeds of one drone, RPM, up to `max_rpm`: those that make the thrusts that the firmware commands.

    A command is a share of `gains.motor.max_thrust`, which battery compensation makes true, and the rotor turns as fast
    as it must for that by the vehicle's `kf`. The mixing follows from the geometry of the rotors.

    Args:
        gains: of the four loops.
        params: of the drone.
        memory: of the last call.
        state: of the drone, as it is estimated.
        setpoint: of position (pos and yaw of a `Setpoint`; the rest is not used), `Velocity`, `Attitude` or `Rates`.
        dt: time between calls, s; 0.002 on the vehicle.

    Raises:
        ValueError: arrays of a team (use `jax.vmap`), or `dt` not positive.
    """
    check_single(params, state)
    memory, _, thrust, torque = _fly(gains, memory, state, setpoint, dt)
    commands = motors.within_range(motors.mix(thrust, torque, mixer(params)))
    rpm = safe_sqrt(commands * (gains.motor.max_thrust / motors.FULL) / params.kf)
    return memory, jnp.minimum(rpm, params.max_rpm)


def pwm(
    gains: Gains,
    memory: Memory,
    state: State,
    setpoint: AnySetpoint,
    battery: Float[Array, ""] | float | None = None,
    *,
    dt: float = 0.002,
) -> tuple[Memory, Command]:
    """What the firmware of one Crazyflie commands: desired attitude, thrust, and the duty cycles of its motors.

    Args:
        gains: of the four loops.
        memory: of the last call.
        state: of the drone, as it is estimated.
        setpoint: of position (pos and yaw of a `Setpoint`; the rest is not used), `Velocity`, `Attitude` or `Rates`.
        battery: voltage, V, for which duty cycles are compensated, behind a filter of 0.1 s; without it, and with the
            compensation switched off, a duty cycle is the command itself.
        dt: time between calls, s.

    Raises:
        ValueError: arrays of a team (use `jax.vmap`), or `dt` not positive.
    """
    first = jnp.isinf(memory.age)
    memory, attitude, thrust, torque = _fly(gains, memory, state, setpoint, dt)
    duty = motors.mix(thrust, torque)
    if battery is not None:
        check_shape("battery", battery, (), "one voltage for one drone; use jax.vmap for a team")
        kept = jnp.where(first, 0, _BATTERY_FILTER ** (dt / 0.001))
        voltage = battery + kept * (memory.battery - battery)
        memory = memory.replace(battery=voltage)
        duty = motors.duty_cycle(gains.motor, duty, voltage)
    return memory, Command(attitude, thrust, torque, motors.within_range(duty))


def _fly(
    gains: Gains, memory: Memory, state: State, setpoint: AnySetpoint, dt: float
) -> tuple[Memory, Float[Array, "3"], Float[Array, ""], Float[Array, "3"]]:
    """Memory, desired attitude (degrees), thrust and torque (16 bit)."""
    check_positive("dt", dt, "s")
    check_state(state)
    check_memory(memory, init())
    memory = _first_measured(gains, memory, state, dt)
    if isinstance(setpoint, Setpoint | Velocity):
        memory = _slow_loops(gains, memory, state, setpoint, dt)
        attitude, thrust = jnp.append(memory.tilt, jnp.rad2deg(setpoint.yaw)), memory.thrust
    elif isinstance(setpoint, Attitude | Rates):
        memory = memory.replace(age=jnp.minimum(memory.age, _SLOW))  # after them the slow loops run at once
        attitude, thrust = rpy(state.quat), jnp.clip(setpoint.thrust, 0, motors.FULL)
    else:
        raise ValueError(f"setpoint is a {type(setpoint).__name__}; give a Setpoint, Velocity, Attitude or Rates")
    if isinstance(setpoint, Attitude):
        check_shape("setpoint.rpy", setpoint.rpy, (3,), "one target for one drone")
        attitude = degrees(setpoint.rpy)
    if isinstance(setpoint, Rates):
        check_shape("setpoint.omega", setpoint.omega, (3,), "one target for one drone")
        memory, asked = memory.replace(rpy=attitude), degrees(setpoint.omega)
    else:
        memory, asked = attitude_loop(gains, memory, state, attitude, dt)
    memory, torque = rate_loop(gains, memory, state, asked, dt)
    memory = jax.tree.map(lambda kept, empty: jnp.where(thrust > 0, kept, empty), memory, reset(memory))
    return memory, attitude, thrust, jnp.where(thrust > 0, torque, 0)


def _first_measured(gains: Gains, memory: Memory, state: State, dt: float) -> Memory:
    """The memory, which at the first call is that of a drone whose attitude and rates have always been the present."""
    measured = degrees(state.omega)
    start = dict(rpy=rpy(state.quat), rates=measured, gyro=settled(measured, gains.gyro_cutoff, dt))
    first = jnp.isinf(memory.age)
    return memory.replace(**{name: jnp.where(first, value, getattr(memory, name)) for name, value in start.items()})


def _slow_loops(gains: Gains, memory: Memory, state: State, setpoint: Setpoint | Velocity, dt: float) -> Memory:
    """The memory with the tilt and the thrust of the loops of position and velocity, if it is their turn."""
    check_shape("setpoint.yaw", setpoint.yaw, (), "one target for one drone")
    check_shape("setpoint.vel", setpoint.vel, (3,), "one target for one drone")
    period = jnp.maximum(_SLOW, dt)
    if isinstance(setpoint, Setpoint):
        check_shape("setpoint.pos", setpoint.pos, (3,), "one target for one drone")
        ran, vel = position_loop(gains, memory, state, setpoint.pos, period)
    else:
        ran, vel = memory, in_heading_frame(state.quat, setpoint.vel)
    ran, tilt, thrust = velocity_loop(gains, ran, state, vel, period)
    age = jnp.where(jnp.isinf(memory.age), 0, memory.age - period)
    ran = ran.replace(tilt=tilt, thrust=thrust, age=age)
    due = memory.age > period - dt / 2
    memory = jax.tree.map(lambda new, old: jnp.where(due, new, old), ran, memory)
    return memory.replace(age=memory.age + dt)
