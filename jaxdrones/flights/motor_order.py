"""Check of the order of the motors in a log by roll and pitch accelerations."""

import itertools

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from jaxdrones.flights.log import PERIOD

_MIN_LIKENESS, _MIN_LEAD = 0.75, 0.15  # of an order of the motors; over the documented order
_PATTERNS = {
    "X": np.array([[-1, -1, 1, 1], [-1, 1, 1, -1]]) / 2,  # roll and pitch by each motor
    "+": np.array([[0, -1, 0, 1], [-1, 0, 1, 0]]) / np.sqrt(2),
}
_NAMES = ("front right", "back right", "back left", "front left")
_MAX_MOTOR_ROWS = 6000  # a minute of flight suffices
_RIDGE = 1e-9  # of the trace of the moment matrix, where motors or velocities are constant
_LAGS = range(-1, 7)  # rows of delay between the log and the effect of motors
_MOTOR_ROWS, _TREND_ROWS = 4, 101  # of the angular acceleration; of the removed slow part
_MIN_EXPLAINED = 0.15  # fraction of the angular acceleration explained by the motors


def check_motors(squares: np.ndarray, attitude: Rotation, vel: np.ndarray, omega: np.ndarray) -> list[str]:
    """Check roll and pitch accelerations against the documented order of the motors."""
    effect = motor_effects(squares, attitude, vel, omega)
    if effect is None:
        return []
    orders = [list(order) for order in itertools.permutations(range(4))]
    likeness = np.max([[np.vdot(effect, p[:, order]) / 2 for order in orders] for p in _PATTERNS.values()], axis=0)
    best = int(np.argmax(likeness))
    documented = likeness[0]
    if likeness[best] < _MIN_LIKENESS or likeness[best] - documented < _MIN_LEAD:
        return []
    order = ", ".join(_NAMES[motor] for motor in orders[best])
    return [f"the motors turn the drone as if their columns were {order}: give {', '.join(_NAMES)}"]


def motor_effects(squares: np.ndarray, attitude: Rotation, vel: np.ndarray, omega: np.ndarray) -> np.ndarray | None:
    """(2, 4) relative effect of each motor on roll and pitch, unit rows; `None` if not observable."""
    n = _MOTOR_ROWS
    squares, vel, omega = (x[:_MAX_MOTOR_ROWS] for x in (squares, vel, omega))
    if len(squares) < 2 * _TREND_ROWS:
        return None
    acc = (omega[n:, :2] - omega[:-n, :2]) / (n * PERIOD)
    body_vel = attitude[: len(vel)].inv().apply(vel)
    others = [(x[n:] + x[:-n]) / 2 for x in (body_vel, omega)]
    summed = np.cumsum((squares[1:] + squares[:-1]) / 2 / np.mean(squares), axis=0)
    mean = np.concatenate([summed[n - 1 : n], summed[n:] - summed[:-n]]) / n
    best: tuple[float, np.ndarray | None] = (_MIN_EXPLAINED, None)
    for lag in _LAGS:
        # acceleration of row k beside the motors of row k - lag
        later, earlier = slice(max(lag, 0), len(acc) + min(lag, 0)), slice(max(-lag, 0), len(acc) - max(lag, 0))
        known = np.concatenate([mean[earlier], *(x[later] for x in others)], axis=1)
        known, target = _without_trend(known), _without_trend(acc[later])
        moment = known.T @ known
        coefficients = np.linalg.solve(moment + _RIDGE * np.trace(moment) * np.eye(len(moment)), known.T @ target)
        explained = 1 - np.sum((target - known @ coefficients) ** 2) / max(np.sum(target**2), 1e-12)
        if explained > best[0]:
            best = (float(explained), coefficients[:4].T)
    if best[1] is None:
        return None
    effect = best[1] - np.mean(best[1], axis=1, keepdims=True)
    length = np.linalg.norm(effect, axis=1, keepdims=True)
    return effect / length if (length > 0).all() else None


def _without_trend(x: np.ndarray) -> np.ndarray:
    """Columns (K, n) without their moving mean."""
    return x - ndimage.uniform_filter1d(x, _TREND_ROWS, axis=0, mode="nearest")
