"""Closed loop: a flight on set-points flown again by the firmware's PID, and how far apart the two paths are."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.control import Setpoint, firmware_pid
from jaxdrones.dynamics import FULL_PWM, Motors, midpoint
from jaxdrones.identification.log import PERIOD, FlightLog
from jaxdrones.identification.open_loop import lagging, motion
from jaxdrones.identification.vehicle import Vehicle
from jaxdrones.state import State
from jaxdrones.thrust_curves import thrust_at

_SUBSTEPS = 5  # per row: the loops of attitude and rates run at 500 Hz
_THRUST_PER_OUTPUT = 1000.0  # of the firmware's loop of the vertical velocity
_BLOCK = 500  # rows, to a multiple of which a course is filled, so that flights share a program
_NEAR = 0.15  # m, from the height of the set-point: the climb is over
_LOW = 0.3  # m, below which a flight has not begun or is over
_SATURATED = 0.01  # share of the rows with a motor at its limit


@dataclasses.dataclass(frozen=True)
class Twin:
    """A flight and its repetition, without the take-off and the landing."""

    flight: str
    t: np.ndarray
    """(K,) s."""
    pos: np.ndarray
    """(K, 3) of the flight, m, world."""
    twin_pos: np.ndarray
    """(K, 3) of the repetition, m, world."""
    ref_pos: np.ndarray
    """(K, 3) set-points, m, world."""
    pwm: np.ndarray
    """(K, 4)."""
    twin_pwm: np.ndarray
    """(K, 4)."""

    def as_dict(self) -> dict[str, float | str | bool]:
        """Distances of the paths, tracking errors (rms) and mean PWM, for JSON."""

        def rms(a: np.ndarray, b: np.ndarray, axes: int = 3) -> float:
            return float(np.sqrt(np.mean(np.sum((a - b)[:, :axes] ** 2, axis=1))))

        limits = max(np.mean(np.max(pwm, axis=1) >= FULL_PWM) for pwm in (self.pwm, self.twin_pwm))
        return {
            "flight": self.flight,
            "xy_rms_m": rms(self.twin_pos, self.pos, 2),
            "xyz_rms_m": rms(self.twin_pos, self.pos),
            "tracking_real_m": rms(self.pos, self.ref_pos),
            "tracking_sim_m": rms(self.twin_pos, self.ref_pos),
            "pwm_real": float(np.mean(self.pwm)),
            "pwm_sim": float(np.mean(self.twin_pwm)),
            "saturated": bool(limits > _SATURATED),
        }


class Course(NamedTuple):
    """What a repetition takes from a log, K rows from the take-off on: nothing of the flight but where it starts."""

    start: State
    """Upright and at rest on the ground, or in flight where the log begins there."""
    ground: Float[Array, ""]
    """Height at which the drone stands, m; minus infinity where the log begins in flight."""
    setpoint: Setpoint
    """(K,) on every array."""
    battery: Float[Array, " K"]
    """V."""
    sag: Float[Array, ""]
    """Of the battery at take-off, V."""


def rows_in_the_air(log: FlightLog) -> slice:
    """From the end of the climb to the landing.

    Raises:
        ValueError: the log has no set-points and battery, or the drone is never near the height of its set-point.
    """
    ref_pos, *_ = log.orders
    height = log.pos[:, 2]
    up = log.in_flight & (height > _LOW) & (np.abs(height - ref_pos[:, 2]) < _NEAR)
    if not up.any():
        raise ValueError(f"{log.name}: is never within {_NEAR:g} m of the height of its set-point; give another flight")
    return slice(int(np.argmax(up)), int(np.flatnonzero(log.in_flight & (height > _LOW))[-1]) + 1)


def course(log: FlightLog) -> Course:
    """Start, set-points and battery of a log, from the row on in which the motors start."""
    stop = rows_in_the_air(log).stop
    begin = first_row(log)
    ref_pos, ref_yaw, _, vbat = log.orders
    pos, quat, vel, omega = (jnp.asarray(x[begin], float) for x in (log.pos, log.quat, log.vel, log.omega))
    start, ground = State(pos, quat, vel, omega, jnp.zeros(4)), jnp.array(-jnp.inf)
    if begin > 0:
        upright = rotation.from_rpy(rotation.to_rpy(quat) * jnp.array([0.0, 0, 1]))
        start, ground = State(pos, upright, jnp.zeros(3), jnp.zeros(3), jnp.zeros(4)), pos[2]
    length = -(-(stop - begin) // _BLOCK) * _BLOCK
    rows = np.minimum(np.arange(begin, begin + length), stop - 1)
    setpoint = Setpoint.at(jnp.asarray(ref_pos[rows], float), yaw=jnp.asarray(ref_yaw[rows], float))
    return Course(start, ground, setpoint, jnp.asarray(vbat[rows], float), jnp.asarray(log.sag, float))


def first_row(log: FlightLog) -> int:
    """The first row in which the motors run."""
    return int(np.argmax(log.in_flight))


def fly_again(log: FlightLog, vehicle: Vehicle, motors: Motors, gains: firmware_pid.Gains) -> Twin:
    """Fly a vehicle on the set-points of a log.

    The firmware's PID starts on the ground with empty integrators when the motors of the log start, and is given the
    logged set-points and the logged voltage of the battery until the landing, and nothing else. Where a log begins in
    flight, it starts in that state, with the integrator that carries the weight in hover. Compared are the rows after
    the climb.

    Args:
        log: with set-points, PWM and battery.
        vehicle: that is flown.
        motors: of the vehicle.
        gains: of the firmware.

    Raises:
        ValueError: see `rows_in_the_air`.
    """
    rows, begin = rows_in_the_air(log), first_row(log)
    ref_pos, _, recorded, _ = log.orders
    flown = _fly(vehicle, motors, gains, course(log))
    pos, pwm = (np.asarray(x)[rows.start - begin : rows.stop - begin] for x in flown)
    return Twin(log.name, log.t[rows], log.pos[rows], pos, ref_pos[rows], recorded[rows], pwm)


def fly(
    vehicle: Vehicle, motors: Motors, gains: firmware_pid.Gains, given: Course
) -> tuple[Float[Array, "K 3"], Float[Array, "K 4"]]:
    """Positions (m) and PWM of a repetition."""
    params, instruments = vehicle.params, vehicle.instruments
    team = jax.tree.map(lambda x: x[None], params)
    dt, derivative = PERIOD / _SUBSTEPS, motion(jnp.zeros(4))

    def substep(carry, setpoint, battery):
        memory, state = carry
        memory, command = firmware_pid.pwm(gains, memory, instruments.estimate(state), setpoint, battery, dt=dt)
        thrust = motors.thrust(command.pwm / FULL_PWM * instruments.motor_supply(battery, given.sag))
        rpm = lagging(params, state.rpm, thrust, dt)
        world = jax.tree.map(lambda x: x[None], state.replace(rpm=rpm))
        after = midpoint(lambda s: derivative(team, s, rpm[None]), world, dt)
        return (memory, _above_ground(given, jax.tree.map(lambda x: x[0], after))), command.pwm

    def row(carry, given):
        after, pwm = jax.lax.scan(lambda carry, _: substep(carry, *given), carry, length=_SUBSTEPS)
        return after, (carry[1].pos, jnp.mean(pwm, axis=0))

    flying = jnp.isinf(given.ground)
    lift = jnp.where(flying, _hovering(vehicle, motors, gains, given), 0)
    memory = firmware_pid.init().replace(vel_integral=lift * jnp.array([0.0, 0, 1]))
    start = given.start.replace(rpm=jnp.where(flying, params.hover_rpm, 0) * jnp.ones(4))
    _, (pos, pwm) = jax.lax.scan(row, (memory, start), (given.setpoint, given.battery))
    return pos, pwm


def _above_ground(given: Course, state: State) -> State:
    """The state, or that of the start where the drone would be in the ground."""
    standing = given.start.replace(rpm=state.rpm)
    return jax.tree.map(lambda a, b: jnp.where(state.pos[2] < given.ground, a, b), standing, state)


def _hovering(vehicle: Vehicle, motors: Motors, gains: firmware_pid.Gains, given: Course) -> Float[Array, ""]:
    """Integrated error of the upward velocity with which the firmware's command carries the weight, m."""
    battery = given.battery[0]
    duty = motors.voltage(vehicle.params.weight / 4) / vehicle.instruments.motor_supply(battery, given.sag)
    command = thrust_at(gains.motor.thrust, duty * battery) / gains.motor.max_thrust * FULL_PWM
    return (command - gains.base_thrust) / (_THRUST_PER_OUTPUT * gains.vel_i[2])


_fly = jax.jit(fly)
