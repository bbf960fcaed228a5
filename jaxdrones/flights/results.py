"""Results of a flight: errors, settling times, divergence, and comparison of two flights."""

import numpy as np

from jaxdrones.flights.log import FlightLog

_BAND = 0.1  # settling band, relative to the steady error
_MIN_BAND = 5e-3  # m or m/s
_LOST = 1.0  # m or m/s above the initial error, at which a drone has diverged


def diverged(log: FlightLog) -> dict[str, str]:
    """Drones that diverged from their commands: label -> message.

    A drone diverged if its state is not finite at some time, or if at some time in the last quarter of the flight
    it is upside down, or its error (the distance to the target position or the difference to the target velocity)
    is 1 m or 1 m/s above its initial error. The four examples with their defaults stay below 0.6 m or m/s and
    within 30 degrees of level; an unstable drone is hundreds of meters off.
    """
    difference, unit = log.difference()
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.linalg.norm(difference.astype(np.float64), axis=-1)
        lost = error[log.last_quarter].max(axis=0) > error[0] + _LOST
        x, y = log.quat[log.last_quarter, :, 0], log.quat[log.last_quarter, :, 1]
        upside_down = (2 * (x**2 + y**2) > 1).any(axis=0)
    found = {}
    for i, label in enumerate(log.labels):
        if lost[i]:
            found[label] = f"{label} is {error[log.last_quarter, i].max():.3g} {unit} off its command"
        elif upside_down[i]:
            found[label] = f"{label} is upside down"
    return found | log.not_finite()


def results(log: FlightLog, after: float) -> list[dict[str, float | str | None]]:
    """Table with a row per drone, from time `after` (s) of the flight, or over the second half of a shorter flight.

    The error is the distance to the target position, or the difference to the target velocity. The steady error
    is its mean over the last quarter of the flight. The settling time is the first time after which the error stays
    within 10 % (or 5 mm, 5 mm/s) of that; `None` if not before the last quarter. Numbers that are not finite are
    `None`.
    """
    difference, unit = log.difference()
    unit = unit.replace("/", "_")
    counted, steady = log.t >= counted_from(log, after), log.last_quarter
    with np.errstate(over="ignore", invalid="ignore"):  # where the state is not finite
        error, speed = np.linalg.norm(difference, axis=-1), np.linalg.norm(log.vel, axis=-1)
        columns = {
            f"rms_error_{unit}": np.sqrt(np.mean(error[counted] ** 2, axis=0)),
            f"peak_error_{unit}": error[counted].max(axis=0),
            f"steady_error_{unit}": error[steady].mean(axis=0),
            "settled_after_s": [_settling(log.t - log.begin, e, steady) for e in error.T],
            "lowest_z_m": log.pos[counted, :, 2].min(axis=0),
            "highest_z_m": log.pos[counted, :, 2].max(axis=0),
            "peak_vz_m_s": log.vel[counted, :, 2].max(axis=0),
            "peak_speed_m_s": speed[counted].max(axis=0),
            "rpm_std": log.rpm[counted].std(axis=0).max(axis=-1),
        }
    return [
        {"drone": label} | {name: float(x[i]) if np.isfinite(x[i]) else None for name, x in columns.items()}
        for i, label in enumerate(log.labels)
    ]


def definitions(log: FlightLog, after: float) -> str:
    """Definitions of the columns of `results`, in three lines."""
    unit = "mm" if log.difference()[1] == "m" else "mm/s"
    band = f"{100 * _BAND:g} % or {1000 * _MIN_BAND:g} {unit}"
    return (
        f"steady: mean error from {log.t[log.last_quarter][0]:.2f} s on, the last quarter of the flight\n"
        f"settling: first time after which the error stays within {band} of steady (-: in the last quarter)\n"
        f"all other numbers count from {counted_from(log, after):.2f} s on"
    )


def divergence(log: FlightLog, other: FlightLog) -> list[dict[str, float]]:
    """Largest differences over the drones of two flights of the same conditions, at twelve times."""
    at = np.unique(np.linspace(0, len(log.t) - 1, 12).round().astype(int))

    def largest(difference: np.ndarray) -> list[float]:
        return np.linalg.norm(difference[at], axis=-1).max(axis=-1).tolist()

    # |q - p| of unit quaternions is 2 sin(angle / 4), up to their sign
    apart = np.minimum(*(np.linalg.norm(log.quat[at] - sign * other.quat[at], axis=-1) for sign in (1, -1)))
    columns = {
        "t_s": log.t[at].tolist(),
        "pos_m": largest(log.pos - other.pos),
        "vel_m_s": largest(log.vel - other.vel),
        "angle_rad": (4 * np.arcsin(np.minimum(apart / 2, 1))).max(axis=-1).tolist(),
        "omega_rad_s": largest(log.omega - other.omega),
        "rpm": largest(log.rpm - other.rpm),
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def counted_from(log: FlightLog, after: float) -> float:
    """Start of the evaluation, s."""
    duration = float(log.t[-1]) - log.begin
    return log.begin + (after if after < duration else duration / 2)


def _settling(t: np.ndarray, error: np.ndarray, steady: np.ndarray) -> float:
    mean = error[steady].mean()
    outside = np.flatnonzero(~(np.abs(error - mean) <= max(_BAND * mean, _MIN_BAND)))
    if len(outside) == 0:
        return 0.0
    return np.nan if steady[outside[-1]] else float(t[outside[-1] + 1])
