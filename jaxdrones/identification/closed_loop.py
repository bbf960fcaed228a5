"""Closed loop: a flight on set-points flown again by the firmware's PID, and how far apart the two paths are."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.control import Setpoint, firmware_pid
from jaxdrones.dynamics import FULL_PWM, Motors, midpoint
from jaxdrones.identification.log import PERIOD, FlightLog
from jaxdrones.identification.open_loop import lagging, motion
from jaxdrones.identification.vehicle import Vehicle
from jaxdrones.state import State

_SUBSTEPS = 5  # per row: the loops of attitude and rates run at 500 Hz
_SETTLING = 500  # rows of hover at the first set-point, in which the integrators come to their values
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
    """What a repetition takes from a log, K rows in the air: nothing of the flight but where it starts."""

    start: State
    setpoint: Setpoint
    """(K,) on every array."""
    battery: Float[Array, " K"]
    """V."""


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
    """Start, set-points and battery of a log, from `rows_in_the_air` on."""
    air = rows_in_the_air(log)
    ref_pos, ref_yaw, _, vbat = log.orders
    pos, quat, vel, omega = (jnp.asarray(x[air.start], float) for x in (log.pos, log.quat, log.vel, log.omega))
    start = State(pos, quat, vel, omega, jnp.zeros(4))
    length = -(-(air.stop - air.start) // _BLOCK) * _BLOCK
    rows = np.minimum(np.arange(air.start, air.start + length), air.stop - 1)
    setpoint = Setpoint.at(jnp.asarray(ref_pos[rows], float), yaw=jnp.asarray(ref_yaw[rows], float))
    return Course(start, setpoint, jnp.asarray(vbat[rows], float))


def fly_again(log: FlightLog, vehicle: Vehicle, motors: Motors, gains: firmware_pid.Gains) -> Twin:
    """Fly a vehicle on the set-points of a log.

    The firmware's PID starts with the integrators of a drone that has hovered at the first set-point, in the state of
    the log near its height, and is given the logged set-points and the logged voltage of the battery until the landing,
    and nothing else.

    Args:
        log: with set-points, PWM and battery.
        vehicle: that is flown.
        motors: of the vehicle.
        gains: of the firmware.

    Raises:
        ValueError: see `rows_in_the_air`.
    """
    rows = rows_in_the_air(log)
    ref_pos, _, recorded, _ = log.orders
    pos, pwm = (np.asarray(x)[: rows.stop - rows.start] for x in _fly(vehicle, motors, gains, course(log)))
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
        thrust = motors.thrust(command.pwm / FULL_PWM * instruments.motor_supply(battery))
        rpm = lagging(params, state.rpm, thrust, dt)
        world = jax.tree.map(lambda x: x[None], state.replace(rpm=rpm))
        after = midpoint(lambda s: derivative(team, s, rpm[None]), world, dt)
        return (memory, jax.tree.map(lambda x: x[0], after)), command.pwm

    def row(carry, given):
        after, pwm = jax.lax.scan(lambda carry, _: substep(carry, *given), carry, length=_SUBSTEPS)
        return after, (carry[1].pos, jnp.mean(pwm, axis=0))

    first = jax.tree.map(lambda x: x[0], (given.setpoint, given.battery))
    hovering = State(
        first[0].pos, jnp.array([0.0, 0, 0, 1]), jnp.zeros(3), jnp.zeros(3), params.hover_rpm * jnp.ones(4)
    )
    (memory, settled), _ = jax.lax.scan(
        lambda carry, _: row(carry, first), (firmware_pid.init(), hovering), length=_SETTLING
    )
    start = given.start.replace(rpm=settled.rpm)
    _, (pos, pwm) = jax.lax.scan(row, (memory, start), (given.setpoint, given.battery))
    return pos, pwm


_fly = jax.jit(fly)
