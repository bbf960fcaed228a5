"""Open-loop prediction from logged states with recorded inputs, and its errors."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.dynamics.aero import drag, flapping_moment, rate_damping, trim_torque
from jaxdrones.dynamics.integrators import midpoint
from jaxdrones.dynamics.propulsion import FULL_PWM, Motors
from jaxdrones.engine.explicit import make_derivative
from jaxdrones.errors import UserError
from jaxdrones.flights.log import PERIOD, FlightLog
from jaxdrones.flights.vehicle import Vehicle
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.vector import atan2, dot, safe_sqrt

HORIZONS = (10, 25, 50)
"""Prediction horizons, in rows of 0.01 s after the start."""
QUANTITIES = ("pos", "vel", "rot", "omega")
"""Names of the errors: position (m), velocity (m/s), attitude (rad) and angular velocity (rad/s)."""
EFFECTS = (drag, flapping_moment, rate_damping, trim_torque)
"""Effects that act on a vehicle in addition to its rotors and its weight."""

_LENGTH = HORIZONS[-1]
_WARM_UP = 30  # rows before the start, for the spin-up of lagging rotors
_MAX_DELAY = 6  # rows, largest delay of the inputs
_HALF_ROW = 0.5
_BLOCK = 1000  # windows; padded to a multiple of it, to share compiled programs between flights


class Windows(NamedTuple):
    """Windows of a flight from start to last horizon; every array has a leading axis over n windows."""

    start: State
    """(n,) logged states of one drone at the start."""
    command: Float[Array, "n rows 4"] | Float[Array, "n rows 6"]
    """Recorded inputs, from `_WARM_UP + _MAX_DELAY` rows before the start to `_MAX_DELAY` rows after the end: rotor
    speeds, RPM; or duty cycles, 0 to 1, the voltage of the battery and its sag at take-off, V."""
    logged: State
    """(n, horizons) logged states at the horizons."""


def cut_windows(log: FlightLog, starts: np.ndarray) -> Windows:
    """Cut windows of a log at the given rows, from `window_starts`."""
    command = log.rpm[:, 0]
    if not log.has("rpm"):
        command = np.column_stack([log.pwm[:, 0] / FULL_PWM, log.vbat, np.full(len(log.vbat), log.sag)])
    padded = np.pad(command, ((_WARM_UP + _MAX_DELAY, _MAX_DELAY + 1), (0, 0)), mode="edge")
    rows = starts[:, None] + np.arange(_WARM_UP + _LENGTH + 2 * _MAX_DELAY + 1)

    def state(rows: np.ndarray) -> State:
        pos, quat, vel, omega = (jnp.asarray(x[rows, 0], float) for x in (log.pos, log.quat, log.vel, log.omega))
        return State(pos, quat, vel, omega, jnp.zeros((*rows.shape, 4)))

    return Windows(state(starts), jnp.asarray(padded[rows], float), state(starts[:, None] + np.array(HORIZONS)))


def window_starts(log: FlightLog, stride: int = 1) -> np.ndarray:
    """Every `stride`-th row with the drone in flight up to the last horizon."""
    flying = np.convolve(~log.in_flight, np.ones(_LENGTH + 1), mode="valid") == 0
    starts = np.flatnonzero(flying)[::stride]
    if not len(starts):
        raise UserError(
            f"{log.name}: the motors never run for {_LENGTH * PERIOD:g} s without interruption; give a log of a flight"
        )
    return starts


def predict(vehicle: Vehicle, start: State, command: Float[Array, "rows columns"], motors: Motors | None) -> State:
    """Predicted states of one drone at the horizons, in terms of its log, from a logged state.

    The command are the recorded inputs of one window, see `Windows.command`. The motors map a duty cycle to thrust,
    which is followed with the vehicle's rotor lag; `None` for measured rotor speeds.
    """
    params, instruments = vehicle.params, vehicle.instruments
    speed, rate = _rotor_speed(vehicle, command, motors)
    state = start.replace(quat=instruments.true_attitude(start.quat), rpm=speed[0])

    def advance(state: State, rotors: tuple[Array, Array]) -> tuple[State, State]:
        after = moved(params, state, *rotors, PERIOD)
        return after, after

    _, states = jax.lax.scan(advance, state, (speed, rate))
    predicted = jax.tree.map(lambda x: x[np.array(HORIZONS) - 1], states)
    return predicted.replace(
        pos=jax.vmap(instruments.logged_position, (0, None))(predicted.pos, start.pos),
        quat=jax.vmap(instruments.logged_attitude)(predicted.quat),
    )


def residuals(predicted: State, logged: State) -> Float[Array, "4 3"]:
    """Errors of one state: position (m) and velocity (m/s), world; rotation (rad) and angular velocity (rad/s), body.

    The rotation error is along the axis, with twice the sine of half the angle as its length.
    """
    error = rotation.multiply(rotation.conjugate(logged.quat), predicted.quat)
    rotation_error = 2 * jnp.where(error[3] < 0, -1, 1) * error[:3]
    return jnp.stack(
        [predicted.pos - logged.pos, predicted.vel - logged.vel, rotation_error, predicted.omega - logged.omega],
    )


def open_loop_errors(log: FlightLog, vehicle: Vehicle, motors: Motors) -> np.ndarray:
    """Mean prediction errors of a vehicle over all windows of a log; the motors are for a log of PWM.

    Returns:
        (horizons, 4) mean norms of the errors of position (m), velocity (m/s), attitude (angle, rad) and angular
        velocity (rad/s).
    """
    return np.asarray(_errors(vehicle, *_all_windows(log), None if log.has("rpm") else motors))


def hold_errors(log: FlightLog) -> np.ndarray:
    """`open_loop_errors` of *hold*, the persistence model with a constant state."""
    windows, weights = _all_windows(log)
    held = jax.tree.map(lambda x, y: jnp.broadcast_to(x[:, None], y.shape), windows.start, windows.logged)
    return np.asarray(mean_errors(held, windows.logged, weights))


def _all_windows(log: FlightLog) -> tuple[Windows, Float[Array, " n"]]:
    """All windows of a log with padding, and their weights, zero for the padding."""
    starts = window_starts(log)
    indices = np.arange(-(-len(starts) // _BLOCK) * _BLOCK)
    weights = jnp.asarray(indices < len(starts), float) / len(starts)
    return cut_windows(log, starts[np.minimum(indices, len(starts) - 1)]), weights


@jax.jit
def mean_errors(
    predicted: State, logged: State, weights: Float[Array, " n"] | None = None
) -> Float[Array, "horizons 4"]:
    """Mean norms of the errors over n windows: position (m), velocity (m/s), angle (rad), angular velocity (rad/s).

    States are (n, horizons, ...); the weights of windows sum to one, and are equal by default.
    """
    errors = jax.vmap(jax.vmap(_error))(predicted, logged)
    return jnp.mean(errors, axis=0) if weights is None else jnp.tensordot(weights, errors, 1)


@jax.jit
def _errors(vehicle: Vehicle, windows: Windows, weights: Array, motors: Motors | None) -> Array:
    predicted = jax.vmap(predict, (None, 0, 0, None))(vehicle, windows.start, windows.command, motors)
    return mean_errors(predicted, windows.logged, weights)


def _error(predicted: State, logged: State) -> Float[Array, "4"]:
    x, y, z, w = rotation.multiply(rotation.conjugate(logged.quat), predicted.quat)
    angle = 2 * atan2(safe_sqrt(x * x + y * y + z * z), jnp.abs(w))
    pos, vel, _, omega = residuals(predicted, logged)
    return jnp.stack([safe_sqrt(dot(pos, pos)), safe_sqrt(dot(vel, vel)), angle, safe_sqrt(dot(omega, omega))])


def _rotor_speed(
    vehicle: Vehicle, command: Array, motors: Motors | None
) -> tuple[Float[Array, "rows 4"], Float[Array, "rows 4"]]:
    """Mean rotor speeds (RPM) and their rates (RPM/s) from each row of a window to the next, from start to end."""
    delay = vehicle.instruments.delay / PERIOD
    if motors is None:
        measured = command[_WARM_UP:]
        middle, early, late = (_shifted(measured, delay - later)[:_LENGTH] for later in (_HALF_ROW, 0, 1))
        return middle, (late - early) / PERIOD
    delayed = _shifted(command, delay - _HALF_ROW)
    duty, battery, sag = delayed[:, :4], delayed[:, 4:5], delayed[:, 5:]
    thrust = motors.thrust(duty * vehicle.instruments.motor_supply(battery, sag))

    def follow(speed: Array, thrust: Array) -> tuple[Array, tuple[Array, Array]]:
        after = lagged_rpm(vehicle.params, speed, thrust, PERIOD)
        return after, ((speed + after) / 2, (after - speed) / PERIOD)

    _, followed = jax.lax.scan(follow, safe_sqrt(thrust[0] / vehicle.params.kf), thrust)
    speed, rate = (x[_WARM_UP : _WARM_UP + _LENGTH] for x in followed)
    return speed, rate


def _shifted(x: Float[Array, "rows n"], delay: Array) -> Float[Array, "inner n"]:
    """Rows of x with a delay in rows, linearly interpolated, without its first and last `_MAX_DELAY` rows.

    The delay is limited to `_MAX_DELAY` rows.
    """
    delay = jnp.clip(delay, -_MAX_DELAY, _MAX_DELAY)
    n = len(x) - 2 * _MAX_DELAY
    shifts = range(-_MAX_DELAY, _MAX_DELAY + 1)
    weights = [jnp.maximum(1 - jnp.abs(delay - shift), 0) for shift in shifts]
    terms = [weight * x[_MAX_DELAY - shift :][:n] for weight, shift in zip(weights, shifts, strict=True)]
    return jnp.sum(jnp.stack(terms), axis=0)


def moved(params: Params, state: State, rpm: Float[Array, "4"], rpm_rate: Float[Array, "4"], dt: float) -> State:
    """State of one drone after a step (s) of the midpoint method with given rotor speeds (RPM) and rates (RPM/s)."""
    derivative = make_derivative(effects=EFFECTS, rotors=lambda params, state, command: (command, rpm_rate))
    team, world = jax.tree.map(lambda x: x[None], (params, state))
    after = midpoint(lambda s: derivative(team, s, rpm[None]), world, dt)
    return jax.tree.map(lambda x: x[0], after)


def lagged_rpm(params: Params, rpm: Float[Array, "4"], thrust: Float[Array, "4"], dt: float) -> Float[Array, "4"]:
    """Rotor speeds (RPM) after a time dt (s) of a first-order lag toward those of the commanded thrusts (N)."""
    commanded = safe_sqrt(thrust / params.kf)
    time_constant = jnp.where(commanded > rpm, params.rotor_rise_time, params.rotor_fall_time)
    return commanded + (rpm - commanded) * jnp.exp(-dt / time_constant)
