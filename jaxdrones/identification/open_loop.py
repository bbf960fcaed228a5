"""Open loop: from a state of a log, how far a model is from the flight after it was given the same rotor speeds."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.dynamics import Motors, drag, flapping_moment, midpoint, rate_damping, trim_torque
from jaxdrones.dynamics.propulsion import FULL_PWM
from jaxdrones.engine.explicit import Derivative, make_derivative
from jaxdrones.identification.log import PERIOD, FlightLog
from jaxdrones.identification.vehicle import Vehicle
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.vector import atan2, dot, safe_sqrt

HORIZONS = (10, 25, 50)
"""Rows after the start at which a prediction is compared, 0.01 s each."""
QUANTITIES = ("pos", "vel", "rot", "omega")
"""Whose errors are in m, m/s, rad and rad/s."""
EFFECTS = (drag, flapping_moment, rate_damping, trim_torque)
"""What acts on a vehicle beside its rotors and its weight."""

_LENGTH = HORIZONS[-1]
_BEFORE = 30  # rows, in which rotors with a lag come to their speed
_REACH = 6  # rows, by which inputs can be delayed
_HALF = 0.5  # rows
_BLOCK = 1000  # pieces, to a multiple of which those of a flight are filled, so that flights share a program


class Windows(NamedTuple):
    """Pieces of a flight, each from its start to the last horizon; a leading axis over n pieces on every array."""

    start: State
    """As logged, of one drone."""
    command: Float[Array, "n rows 4"] | Float[Array, "n rows 6"]
    """From some time before the start to some time after the end: measured speeds, RPM; or duty cycles, 0 to 1, the
    voltage of the battery and its sag at take-off, V."""
    truth: State
    """As logged at the horizons, a second axis."""


def windows(log: FlightLog, starts: np.ndarray) -> Windows:
    """The pieces of a log that begin in some rows.

    Args:
        log: of the flight.
        starts: (n,) rows, from `starts_of`.
    """
    command = log.rpm if log.rpm is not None else _duty_and_voltages(log)
    padded = np.pad(command, ((_BEFORE + _REACH, _REACH + 1), (0, 0)), mode="edge")
    rows = starts[:, None] + np.arange(_BEFORE + _LENGTH + 2 * _REACH + 1)
    at = starts[:, None] + np.array(HORIZONS)

    def state(rows: np.ndarray) -> State:
        pos, quat, vel, omega = (jnp.asarray(x[rows], float) for x in (log.pos, log.quat, log.vel, log.omega))
        return State(pos, quat, vel, omega, jnp.zeros((*rows.shape, 4)))

    return Windows(state(starts), jnp.asarray(padded[rows], float), state(at))


def starts_of(log: FlightLog, stride: int = 1) -> np.ndarray:
    """The rows from which the whole horizon is in flight, every `stride`-th one.

    Raises:
        ValueError: there are none.
    """
    flying = np.convolve(~log.in_flight, np.ones(_LENGTH + 1), mode="valid") == 0
    starts = np.flatnonzero(flying)[::stride]
    if not len(starts):
        raise ValueError(f"{log.name}: the motors never run for {_LENGTH * PERIOD:g} s on end; give a log of a flight")
    return starts


def predict(vehicle: Vehicle, start: State, command: Float[Array, "rows columns"], motors: Motors | None) -> State:
    """The states of one drone at the horizons, as they would be logged.

    Args:
        vehicle: with its instruments.
        start: as logged.
        command: a row of `Windows.command`.
        motors: that turn duty cycles into thrust, which rotors come to with the lag of the vehicle; `None` where the
            command is their speed.
    """
    params, instruments = vehicle.params, vehicle.instruments
    speed, rate = _rotor_speed(vehicle, command, motors)
    team = jax.tree.map(lambda x: x[None], params)
    state = start.replace(quat=instruments.true_attitude(start.quat), rpm=speed[0])

    def advance(state: State, given: tuple[Array, Array]) -> tuple[State, State]:
        speed, rate = given
        derivative = motion(rate)
        world = jax.tree.map(lambda x: x[None], state)
        after = midpoint(lambda s: derivative(team, s, speed[None]), world, PERIOD)
        after = jax.tree.map(lambda x: x[0], after)
        return after, after

    _, states = jax.lax.scan(advance, state, (speed, rate))
    at = jax.tree.map(lambda x: x[np.array(HORIZONS) - 1], states)
    return at.replace(
        pos=jax.vmap(instruments.logged_position, (0, None))(at.pos, start.pos),
        quat=jax.vmap(instruments.logged_attitude)(at.quat),
    )


def residuals(predicted: State, truth: State) -> Float[Array, "4 3"]:
    """Errors of one state: position, velocity, rotation vector (body), angular velocity."""
    between = rotation.multiply(rotation.conjugate(truth.quat), predicted.quat)
    turn = 2 * jnp.where(between[3] < 0, -1, 1) * between[:3]  # twice the sine of half the angle
    return jnp.stack(
        [predicted.pos - truth.pos, predicted.vel - truth.vel, turn, predicted.omega - truth.omega],
    )


def open_loop_errors(log: FlightLog, vehicle: Vehicle, motors: Motors) -> np.ndarray:
    """Mean errors of a vehicle over all starts of a log.

    Args:
        log: of the flight.
        vehicle: that is flown.
        motors: of a log of PWM.

    Returns:
        Euclidean norms of the errors of position (m), velocity (m/s), attitude (angle, rad) and angular velocity
        (rad/s), by horizon.
    """
    return np.asarray(_errors(vehicle, *_all_windows(log), None if log.has_rotor_speeds else motors))


def held_errors(log: FlightLog) -> np.ndarray:
    """`open_loop_errors` of a model that stays in the state of the start."""
    pieces, weights = _all_windows(log)
    held = jax.tree.map(lambda x, y: jnp.broadcast_to(x[:, None], y.shape), pieces.start, pieces.truth)
    return np.asarray(mean_errors(held, pieces.truth, weights))


def _all_windows(log: FlightLog) -> tuple[Windows, Float[Array, " n"]]:
    """The pieces from every start of a log, and the weight of each: zero of those that only fill the array."""
    starts = starts_of(log)
    places = np.arange(-(-len(starts) // _BLOCK) * _BLOCK)
    weights = jnp.asarray(places < len(starts), float) / len(starts)
    return windows(log, starts[np.minimum(places, len(starts) - 1)]), weights


@jax.jit
def mean_errors(
    predicted: State, truth: State, weights: Float[Array, " n"] | None = None
) -> Float[Array, "horizons 4"]:
    """Means over n pieces of the norms of `residuals`, the attitude's as an angle.

    Args:
        predicted: states (n, horizons, ...).
        truth: logged states at the same times.
        weights: of the pieces, which add up to one; equal when left out.
    """
    errors = jax.vmap(jax.vmap(_error))(predicted, truth)
    return jnp.mean(errors, axis=0) if weights is None else jnp.tensordot(weights, errors, 1)


@jax.jit
def _errors(vehicle: Vehicle, pieces: Windows, weights: Array, motors: Motors | None) -> Array:
    predicted = jax.vmap(predict, (None, 0, 0, None))(vehicle, pieces.start, pieces.command, motors)
    return mean_errors(predicted, pieces.truth, weights)


def _error(predicted: State, truth: State) -> Float[Array, "4"]:
    between = rotation.multiply(rotation.conjugate(truth.quat), predicted.quat)
    x, y, z, w = between
    angle = 2 * atan2(safe_sqrt(x * x + y * y + z * z), jnp.abs(w))
    pos, vel, _, omega = residuals(predicted, truth)
    return jnp.stack([safe_sqrt(dot(pos, pos)), safe_sqrt(dot(vel, vel)), angle, safe_sqrt(dot(omega, omega))])


def _rotor_speed(
    vehicle: Vehicle, command: Array, motors: Motors | None
) -> tuple[Float[Array, "rows 4"], Float[Array, "rows 4"]]:
    """Speed of the rotors in each row of a piece and its rate, RPM and RPM/s."""
    delay = vehicle.instruments.delay / PERIOD
    if motors is None:
        measured = command[_BEFORE:]
        middle, early, late = (_shifted(measured, delay + shift)[:_LENGTH] for shift in (0, _HALF, -_HALF))
        return middle, (late - early) / PERIOD
    given = _shifted(command, delay)
    duty, battery, sag = given[:, :4], given[:, 4:5], given[:, 5:]
    thrust = motors.thrust(duty * vehicle.instruments.motor_supply(battery, sag))

    def follow(speed: Array, thrust: Array) -> tuple[Array, tuple[Array, Array]]:
        after = lagging(vehicle.params, speed, thrust, PERIOD)
        return after, ((speed + after) / 2, (after - speed) / PERIOD)

    _, flown = jax.lax.scan(follow, safe_sqrt(thrust[0] / vehicle.params.kf), thrust)
    speed, rate = (x[_BEFORE : _BEFORE + _LENGTH] for x in flown)
    return speed, rate


def _shifted(x: Float[Array, "rows n"], delay: Array) -> Float[Array, "inner n"]:
    """The rows between the first and last few of x, some rows later; linear in between."""
    n = len(x) - 2 * _REACH
    shifts = range(-_REACH, _REACH + 1)
    weights = [jnp.maximum(1 - jnp.abs(delay - shift), 0) for shift in shifts]
    moved = [weight * x[_REACH - shift :][:n] for weight, shift in zip(weights, shifts, strict=True)]
    return jnp.sum(jnp.stack(moved), axis=0)


def motion(rpm_rate: Float[Array, "4"]) -> Derivative:
    """The law of motion of a team of one whose rotors have the commanded speed, which changes at a rate (RPM/s)."""

    def given(params: Params, state: State, command: Float[Array, "4"]) -> tuple[Array, Array]:
        return command, rpm_rate

    return make_derivative(effects=EFFECTS, rotors=given)


def lagging(params: Params, rpm: Float[Array, "4"], thrust: Float[Array, "4"], dt: float) -> Float[Array, "4"]:
    """Rotor speeds a time later, on the way to those that give a thrust (N)."""
    asked = safe_sqrt(thrust / params.kf)
    time_constant = jnp.where(asked > rpm, params.rotor_rise_time, params.rotor_fall_time)
    return asked + (rpm - asked) * jnp.exp(-dt / time_constant)


def _duty_and_voltages(log: FlightLog) -> np.ndarray:
    assert log.pwm is not None and log.vbat is not None  # a log has these or rotor speeds
    return np.column_stack([log.pwm / FULL_PWM, log.vbat, np.full(len(log.vbat), log.sag)])
