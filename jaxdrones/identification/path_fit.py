"""The vehicle whose repetitions of flights on set-points follow the recorded paths best."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.control import firmware_pid
from jaxdrones.dynamics import FULL_PWM, Motors
from jaxdrones.identification.closed_loop import Course, course, first_row, fly, rows_in_the_air
from jaxdrones.identification.log import PERIOD, FlightLog
from jaxdrones.identification.parameters import with_parameters
from jaxdrones.identification.vehicle import Vehicle

BALANCE = ("mass", "unfelt_sag")
"""What the balance of vertical forces tells."""
PATH = ("drag_coeff_x", "drag_coeff_y", "flapping_coeff_x", "flapping_coeff_y", "rotor_lag", "estimate_tilt")
"""What the path in the plane tells."""

_SECOND = 100  # rows
_FORCE = 0.02  # standard deviation of the vertical balance of a second, share of the weight
_DISTANCE = 0.05  # m, of a path
_STRIDE = 20  # rows between the points of a path that are compared, which lie on each other
_OUTLIER = 9.0  # square of a residual beyond which it counts ever less (Cauchy)
_PRIOR = 1.0  # inverse variance of x
_STEPS = 8
_LITTLE = 1e-3  # share of the loss; a step that gains less is the last one

Residuals = Callable[[Array], Float[Array, " n"]]


def fit_path(
    logs: Sequence[FlightLog], start: Vehicle, motors: Motors, progress: Callable[[str], None]
) -> tuple[Vehicle, dict[str, float]]:
    """Fit a vehicle to flights on set-points.

    First the mass and what the motors get of the battery's sag, by the balance of the vertical forces in every
    second of the flights; then what moves a drone sideways, by the horizontal path of its repetition.

    Args:
        logs: with set-points, PWM and battery.
        start: where the search starts.
        motors: of the vehicle.
        progress: called with a line after each part.

    Returns:
        The vehicle, and the standard error of each parameter's coordinate.
    """
    seconds = zip(*(_seconds(log) for log in logs), strict=True)
    duty, battery, sag, up, acc = (jnp.asarray(np.concatenate(parts), float) for parts in seconds)
    balance = functools.partial(_balance, start, motors, duty, battery, sag, up, acc)
    x, balance_errors = _least_squares(balance, len(BALANCE), np.inf)
    progress(f"balance of forces: {_rms(balance(x)) * _FORCE:.1%} of the weight")
    vehicle = with_parameters(start, BALANCE, list(x))

    courses, truth, counts = _paths(logs)
    path = functools.partial(_path, vehicle, motors, firmware_pid.gains(), courses, truth, counts)
    x, path_errors = _least_squares(path, len(PATH), _OUTLIER)
    progress(
        f"paths: {_rms(path(x)[np.repeat(np.asarray(counts).reshape(-1), 2) > 0]) * _DISTANCE:.3f} m rms along an axis"
    )
    errors = dict(zip((*BALANCE, *PATH), np.concatenate([balance_errors, path_errors]), strict=True))
    return with_parameters(vehicle, PATH, list(x)), errors


def _seconds(log: FlightLog) -> tuple[np.ndarray, ...]:
    """Duty cycles (n, rows, 4), voltage (n, rows), sag (n, 1), upward share of thrust (n, rows), acceleration (n,)."""
    air = rows_in_the_air(log)
    starts = np.arange(air.start, air.stop - _SECOND, _SECOND)
    rows = starts[:, None] + np.arange(_SECOND)
    up = np.asarray(jax.vmap(rotation.z_axis)(jnp.asarray(log.quat, float)))[:, 2]
    acc = (log.vel[starts + _SECOND, 2] - log.vel[starts, 2]) / (_SECOND * PERIOD)
    _, _, pwm, vbat = log.orders
    return pwm[rows] / FULL_PWM, vbat[rows], np.full((len(starts), 1), log.sag), up[rows], acc


def _balance(
    start: Vehicle, motors: Motors, duty: Array, battery: Array, sag: Array, up: Array, acc: Array, x: Array
) -> Array:
    vehicle = with_parameters(start, BALANCE, list(x))
    thrust = jnp.sum(motors.thrust(duty * vehicle.instruments.motor_supply(battery, sag)[..., None]), axis=-1)
    lift = jnp.mean(thrust * up, axis=1)
    return (lift / (vehicle.params.mass * (vehicle.params.gravity + acc)) - 1) / _FORCE


def _paths(logs: Sequence[FlightLog]) -> tuple[Course, Array, Array]:
    """Courses of equal length, the horizontal paths (flights, rows, 2), and which rows count."""
    courses = [course(log) for log in logs]
    rows = max(len(each.battery) for each in courses)
    truth, counts = np.zeros((len(logs), rows, 2)), np.zeros((len(logs), rows))
    for i, log in enumerate(logs):
        air, begin = rows_in_the_air(log), first_row(log)
        truth[i, air.start - begin : air.stop - begin] = log.pos[air, :2]
        counts[i, air.start - begin : air.stop - begin] = 1

    def filled(x: Array) -> Array:
        return jnp.pad(x, [(0, rows - len(x))] + [(0, 0)] * (x.ndim - 1), mode="edge")

    equal = [
        each._replace(setpoint=jax.tree.map(filled, each.setpoint), battery=filled(each.battery)) for each in courses
    ]
    at = slice(None, None, _STRIDE)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *equal)
    return stacked, jnp.asarray(truth[:, at], float), jnp.asarray(counts[:, at], float)


def _path(
    start: Vehicle, motors: Motors, gains: firmware_pid.Gains, courses: Course, truth: Array, counts: Array, x: Array
) -> Array:
    vehicle = with_parameters(start, PATH, list(x))
    pos, _ = jax.vmap(lambda each: fly(vehicle, motors, gains, each))(courses)
    return ((pos[:, ::_STRIDE, :2] - truth) / _DISTANCE * counts[..., None]).reshape(-1)


def _least_squares(residuals: Residuals, count: int, outlier: float) -> tuple[Array, np.ndarray]:
    """The coordinates of the least sum of squares by Levenberg and Marquardt, and their standard errors.

    Squares beyond `outlier` count ever less.
    """

    @jax.jit
    def normal(x: Array) -> tuple[Array, Array, Array]:
        along = jax.vmap(lambda e: jax.jvp(residuals, (x,), (e,)), out_axes=(None, 0))
        r, jacobian = along(jnp.eye(count))
        weighted = jacobian / (1 + r * r / outlier)[None]
        loss = jnp.sum(r * r if np.isinf(outlier) else outlier * jnp.log1p(r * r / outlier)) + _PRIOR * x @ x
        return weighted @ jacobian.T + _PRIOR * jnp.eye(count), weighted @ r + _PRIOR * x, loss

    x, damping = np.zeros(count), 1e-3
    matrix, gradient, loss = (np.asarray(part, float) for part in normal(jnp.asarray(x, float)))
    for _ in range(_STEPS):
        after = x - np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), gradient)
        found = [np.asarray(part, float) for part in normal(jnp.asarray(after, float))]
        gained = loss - found[2]
        if gained > 0:
            x, damping = after, damping / 10
            matrix, gradient, loss = found
        else:
            damping *= 10
        if 0 < gained < _LITTLE * loss:
            break
    return jnp.asarray(x, float), np.sqrt(np.diag(np.linalg.inv(matrix)))


def _rms(x: Array) -> float:
    return float(jnp.sqrt(jnp.mean(x**2)))
