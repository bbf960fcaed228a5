"""Motion of a flight in one column of its log, compared with that implied by others."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxdrones.flights.log import PERIOD

_GRAVITY = 9.81  # m/s^2
_SHIFT_ROWS, _TURN_ROWS, _FORCE_ROWS = 50, 25, 25  # rows between compared positions, attitudes and velocities
_MAX_WINDOWS = 1500
MIN_WINDOWS = 10
_MIN_SHIFT, _MIN_TURN, _MIN_ACC = 0.02, 0.01, 0.25  # m, rad, m/s^2, rms; smallest motion for a test
_MAX_SHIFT_MISFIT, _MAX_SHIFT_ERROR = 0.05, 0.03  # misfit; m, rms
_MAX_TURN_MISFIT, _MAX_TURN_ERROR = 0.45, 0.04  # misfit; rad, median
_MAX_FORCE_MISFIT, _MAX_FORCE_ERROR = 0.45, 0.3  # misfit; m/s^2, median
_TAKE_OFF_WINDOWS = 20  # at either end of a flight, in which the ground carries a part of the weight


class Motion(NamedTuple):
    """Motion of one drone in T rows, see `FlightLog`."""

    pos: np.ndarray
    """(T, 3)"""
    attitude: Rotation
    vel: np.ndarray
    """(T, 3)"""
    omega: np.ndarray
    """(T, 3)"""


def starts_of(rows: int, length: int) -> np.ndarray:
    """First rows of at most `_MAX_WINDOWS` windows of a length."""
    last = rows - length
    return np.arange(0, last, max(5, last // _MAX_WINDOWS)) if last > 0 else np.zeros(0, int)


class MotionTest(NamedTuple):
    """Comparison of logged values (n, 3) with values implied by other columns (n, 3)."""

    has: np.ndarray
    implied: np.ndarray
    min_motion: float
    max_misfit: float
    max_error: float

    @property
    def observable(self) -> bool:
        """Whether there is enough motion for a comparison."""
        return len(self.has) >= MIN_WINDOWS and max(rms(self.has), rms(self.implied)) > self.min_motion

    @property
    def misfit(self) -> float:
        """Robust misfit: 0 for equal, 1 for unrelated, 2 for opposite values."""
        scale = typical(self.has) + typical(self.implied)
        return typical(self.has - self.implied) / max(scale, 1e-12)

    @property
    def passes(self) -> bool:
        """Whether the log is consistent, or the motion too small for the test. A constant column is inconsistent."""
        if not self.observable:
            return True
        both_vary = min(np.ptp(self.has, axis=0).max(), np.ptp(self.implied, axis=0).max()) > 0
        error = np.sqrt(typical(self.has - self.implied))
        return bool(both_vary and (self.misfit < self.max_misfit or error < self.max_error))


def rms(x: np.ndarray) -> float:
    """Root of the mean squared length of rows (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(x**2, axis=-1))))


def typical(x: np.ndarray) -> float:
    """Mean square without the largest tenth."""
    squares = np.sort(np.sum(x**2, axis=-1))
    return float(np.mean(squares[: max(1, int(0.9 * len(squares)))]))


def _path(pos: np.ndarray, vel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First rows of windows, and the integral of the velocity, m."""
    steps = (vel[1:] + vel[:-1]) / 2 * PERIOD
    return starts_of(len(pos), _SHIFT_ROWS), np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def shift_test(pos: np.ndarray, vel: np.ndarray) -> MotionTest:
    """Compare changes of the position with integrals of the velocity, m."""
    starts, path = _path(pos, vel)
    ends = starts + _SHIFT_ROWS
    return MotionTest(
        pos[ends] - pos[starts], path[ends] - path[starts], _MIN_SHIFT, _MAX_SHIFT_MISFIT, _MAX_SHIFT_ERROR
    )


def climb_correlation(pos: np.ndarray, vel: np.ndarray) -> float:
    """Correlation of changes of the height with integrals of the vertical velocity; 1 for too little motion.

    In `shift_test` heights hardly count beside large horizontal distances.
    """
    test = shift_test(pos, vel)
    has, implied = test.has[:, 2], test.implied[:, 2]
    squares = np.sum(has**2), np.sum(implied**2)
    if len(has) < MIN_WINDOWS or max(squares) < (2 * _MIN_SHIFT) ** 2 * len(has):
        return 1.0
    return float(np.sum(has * implied) / max(np.sqrt(np.prod(squares)), 1e-12))


def delay_of(pos: np.ndarray, vel: np.ndarray) -> tuple[float, float]:
    """Delay of the velocity against the position, s, and the share of the misfit of `shift_test` that it explains.

    It is a least-squares estimate to first order, which is too small for long delays.
    """
    test, (starts, _) = shift_test(pos, vel), _path(pos, vel)
    if not test.observable:
        return 0.0, 0.0
    misfit, change = test.has - test.implied, vel[starts + _SHIFT_ROWS] - vel[starts]
    misfit, change = misfit - np.mean(misfit, axis=0), change - np.mean(change, axis=0)
    delay = np.sum(misfit * change) / max(np.sum(change**2), 1e-12)
    return float(delay), float(1 - np.sum((misfit - delay * change) ** 2) / max(np.sum(misfit**2), 1e-12))


def turn_test(attitude: Rotation, omega: np.ndarray) -> MotionTest:
    """Compare rotation vectors of the attitude with those of the integrated rates, rad, body."""
    starts = starts_of(len(omega), _TURN_ROWS)
    turned = Rotation.identity(len(starts))
    for row in range(_TURN_ROWS):
        turned *= Rotation.from_rotvec((omega[starts + row] + omega[starts + row + 1]) / 2 * PERIOD)
    relative = attitude[starts].inv() * attitude[starts + _TURN_ROWS]
    return MotionTest(relative.as_rotvec(), turned.as_rotvec(), _MIN_TURN, _MAX_TURN_MISFIT, _MAX_TURN_ERROR)


def force_test(vel: np.ndarray, attitude: Rotation, drag: float = 0.0) -> MotionTest:
    """Compare horizontal accelerations with those of a thrust along body z that carries the weight, m/s^2, no means.

    The drag is a force per mass and velocity, 1/s.
    """
    starts = starts_of(len(vel), _FORCE_ROWS)
    ends = starts + _FORCE_ROWS
    acc = (vel[ends] - vel[starts]) / (_FORCE_ROWS * PERIOD) + drag * (vel[ends] + vel[starts]) / 2 * [1, 1, 0]
    up = attitude.apply([0, 0, 1.0])
    summed = np.concatenate([np.zeros((1, 3)), np.cumsum(up, axis=0)])
    mean_up = (summed[ends + 1] - summed[starts]) / (_FORCE_ROWS + 1)
    implied = mean_up[:, :2] * (acc[:, 2:] + _GRAVITY)
    has, implied = (x - np.median(x, axis=0) if len(x) else x for x in (acc[:, :2], implied))
    return MotionTest(has, implied, _MIN_ACC, _MAX_FORCE_MISFIT, _MAX_FORCE_ERROR)


def lift_correlation(thrust: np.ndarray, vel: np.ndarray, attitude: Rotation) -> float:
    """Correlation of vertical accelerations with the vertical part of the relative thrust (T,), without its trend.

    Zero for too little motion.
    """
    starts = starts_of(len(thrust), _FORCE_ROWS)
    edge = min(_TAKE_OFF_WINDOWS, len(starts) // 10)
    starts = starts[edge : len(starts) - edge]
    if len(starts) < MIN_WINDOWS:
        return 0.0
    ends = starts + _FORCE_ROWS
    acc = (vel[ends, 2] - vel[starts, 2]) / (_FORCE_ROWS * PERIOD)
    summed = np.concatenate([np.zeros(1), np.cumsum(thrust * attitude.apply([0, 0, 1.0])[:, 2])])
    lift = summed[ends + 1] - summed[starts]
    lift = lift - np.polyval(np.polyfit(ends, lift, 2), ends)  # the same command gives less thrust as a battery empties
    if np.std(acc) < _MIN_ACC / 2 or np.std(lift) == 0:
        return 0.0
    return float(np.corrcoef(acc, lift)[0, 1])
