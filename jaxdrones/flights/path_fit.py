"""Closed-loop identification of vehicle parameters from the paths of flights on set-points."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.control import firmware_pid
from jaxdrones.dynamics.propulsion import FULL_PWM, Motors
from jaxdrones.flights import closed_loop
from jaxdrones.flights.least_squares import Normal, levenberg_marquardt, spread, standard_errors
from jaxdrones.flights.log import PERIOD, FlightLog
from jaxdrones.flights.parameters import with_parameters
from jaxdrones.flights.vehicle import Vehicle

BALANCE_PARAMETERS = ("mass", "unfelt_sag")
"""Parameters estimated from the balance of vertical forces."""
PATH_PARAMETERS = ("drag_coeff_x", "drag_coeff_y", "flapping_coeff_x", "flapping_coeff_y", "rotor_lag", "estimate_tilt")
"""Parameters estimated from the horizontal path."""

_BALANCE_ROWS = 100  # rows of the averaged balance of vertical forces: one second
_FORCE_STD = 0.02  # standard deviation of the averaged vertical balance, fraction of the weight
_PATH_STD = 0.05  # m, standard deviation of the horizontal position along an axis
_STRIDE = 20  # rows between the compared points of a path
_CAUCHY_SCALE_SQUARED = 9.0  # c^2 of the Cauchy loss c^2 log(1 + r^2 / c^2)
_PRIOR_PRECISION = 1.0  # inverse variance of x
_PRIOR_REMAINDER = 1e-3  # fraction of the prior in the information matrix, which keeps it invertible
_CORRELATED = 20  # following residuals with correlated errors: 2 s of a path, 20 s of the balance
_MAX_STEPS = 8
_MIN_DECREASE = 1e-3  # relative decrease of the loss at which to stop

Residuals = Callable[[Array], Float[Array, " n"]]


def fit_path(
    logs: Sequence[FlightLog],
    start: Vehicle,
    motors: Motors,
    gains: firmware_pid.Gains,
    progress: Callable[[str], None],
) -> tuple[Vehicle, dict[str, float]]:
    """Estimate parameters of a vehicle from flights on set-points, with PWM and battery voltage.

    `mass` and `unfelt_sag` come first, from the balance of vertical forces in every second of the flights. The
    parameters of the horizontal motion come second: the path of the closed-loop simulation is fitted to the recorded
    one. `gains` are those of the recorded firmware.

    Returns:
        The fitted vehicle, and the standard error of each parameter's coordinate x.
    """
    data = zip(*(_balance_data(log) for log in logs), strict=True)
    duty, battery, sag, up, acc = (jnp.asarray(np.concatenate(parts), float) for parts in data)
    balance = functools.partial(_balance_residuals, start, motors, duty, battery, sag, up, acc)
    x, balance_errors = _least_squares(balance, len(BALANCE_PARAMETERS), np.inf)
    progress(f"balance of forces: {_rms(balance(x)) * _FORCE_STD:.1%} of the weight")
    vehicle = with_parameters(start, BALANCE_PARAMETERS, list(x))

    inputs, recorded, mask = _path_data(logs)
    path = functools.partial(_path_residuals, vehicle, motors, gains, inputs, recorded, mask)
    x, path_errors = _least_squares(path, len(PATH_PARAMETERS), _CAUCHY_SCALE_SQUARED)
    compared = np.repeat(np.asarray(mask).reshape(-1), 2) > 0
    progress(f"paths: {_rms(path(x)[compared]) * _PATH_STD:.3f} m rms along an axis")
    names = (*BALANCE_PARAMETERS, *PATH_PARAMETERS)
    errors = dict(zip(names, np.concatenate([balance_errors, path_errors]), strict=True))
    return with_parameters(vehicle, PATH_PARAMETERS, list(x)), errors


def _balance_data(log: FlightLog) -> tuple[np.ndarray, ...]:
    """Data of the n seconds of a flight.

    Duty cycles (n, rows, 4), 0 to 1; voltage (n, rows), V; sag at take-off (n, 1), V; vertical component of the thrust
    direction (n, rows); mean vertical acceleration (n,), m/s^2.
    """
    air = closed_loop.rows_after_climb(log)
    starts = np.arange(air.start, air.stop - _BALANCE_ROWS, _BALANCE_ROWS)
    rows = starts[:, None] + np.arange(_BALANCE_ROWS)
    up = np.asarray(jax.vmap(rotation.z_axis)(jnp.asarray(log.quat[:, 0], float)))[:, 2]
    acc = (log.vel[starts + _BALANCE_ROWS, 0, 2] - log.vel[starts, 0, 2]) / (_BALANCE_ROWS * PERIOD)
    _, _, pwm, vbat = closed_loop.closed_loop_columns(log)
    return pwm[rows] / FULL_PWM, vbat[rows], np.full((len(starts), 1), log.sag), up[rows], acc


def _balance_residuals(
    start: Vehicle, motors: Motors, duty: Array, battery: Array, sag: Array, up: Array, acc: Array, x: Array
) -> Array:
    vehicle = with_parameters(start, BALANCE_PARAMETERS, list(x))
    thrust = jnp.sum(motors.thrust(duty * vehicle.instruments.motor_supply(battery, sag)[..., None]), axis=-1)
    lift = jnp.mean(thrust * up, axis=1)
    return (lift / (vehicle.params.mass * (vehicle.params.gravity + acc)) - 1) / _FORCE_STD


def padded(tree: Any, count: int) -> Any:
    """Arrays (k, ...), padded with their last row to a common count, to share compiled programs between flights."""
    return jax.tree.map(lambda x: jnp.pad(x, [(0, count - len(x))] + [(0, 0)] * (x.ndim - 1), mode="edge"), tree)


def _path_data(logs: Sequence[FlightLog]) -> tuple[closed_loop.ClosedLoopInputs, Array, Array]:
    """Inputs of equal length, the recorded horizontal paths (flights, points, 2), m, and a mask (flights, points).

    The mask is 1 at compared points, 0 elsewhere.
    """
    inputs = [closed_loop.closed_loop_inputs(log) for log in logs]
    rows = max(len(each.battery) for each in inputs)
    recorded, mask = np.zeros((len(logs), rows, 2)), np.zeros((len(logs), rows))
    for i, log in enumerate(logs):
        air, begin = closed_loop.rows_after_climb(log), closed_loop.motor_start_row(log)
        recorded[i, air.start - begin : air.stop - begin] = log.pos[air, 0, :2]
        mask[i, air.start - begin : air.stop - begin] = 1

    equal = [each._replace(setpoint=padded(each.setpoint, rows), battery=padded(each.battery, rows)) for each in inputs]
    points = slice(None, None, _STRIDE)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *equal)
    return stacked, jnp.asarray(recorded[:, points], float), jnp.asarray(mask[:, points], float)


def _path_residuals(
    start: Vehicle,
    motors: Motors,
    gains: firmware_pid.Gains,
    inputs: closed_loop.ClosedLoopInputs,
    recorded: Array,
    mask: Array,
    x: Array,
) -> Array:
    vehicle = with_parameters(start, PATH_PARAMETERS, list(x))
    sim, _ = jax.vmap(lambda each: closed_loop.simulate(vehicle, motors, gains, each))(inputs)
    return ((sim.pos[:, ::_STRIDE, :2] - recorded) / _PATH_STD * mask[..., None]).reshape(-1)


def _least_squares(residuals: Residuals, count: int, cauchy_scale_squared: float) -> tuple[Array, np.ndarray]:
    """Levenberg-Marquardt from x = 0; return the coordinates of the least loss and their standard errors.

    The loss is the Cauchy loss; with an infinite scale it is the sum of squares.
    """

    @jax.jit
    def normal(x: Array) -> Normal:
        along = jax.vmap(lambda e: jax.jvp(residuals, (x,), (e,)), out_axes=(None, 0))
        r, jacobian = along(jnp.eye(count))
        relative = r * r / cauchy_scale_squared
        weighted = jacobian / (1 + relative)[None]
        robust = r * r if np.isinf(cauchy_scale_squared) else cauchy_scale_squared * jnp.log1p(relative)
        loss = jnp.sum(robust) + _PRIOR_PRECISION * x @ x
        matrix = weighted @ jacobian.T + _PRIOR_PRECISION * jnp.eye(count)
        gradients = spread((weighted * r[None]).T, _CORRELATED)
        return Normal(matrix, weighted @ r + _PRIOR_PRECISION * x, loss, spread=gradients)

    x, last = levenberg_marquardt(normal, np.zeros(count), _MAX_STEPS, _MIN_DECREASE)
    information = last.matrix - (1 - _PRIOR_REMAINDER) * _PRIOR_PRECISION * np.eye(count)
    return jnp.asarray(x, float), standard_errors(information, last.spread)


def _rms(x: Array) -> float:
    return float(jnp.sqrt(jnp.mean(x**2)))
