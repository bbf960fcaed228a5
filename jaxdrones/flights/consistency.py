"""Consistency tests of flight logs: contradictions between columns, and likely causes.

The velocity is the derivative of the position, the angular velocity that of the attitude, the acceleration follows the
thrust along body z, and the angular acceleration follows the motors. A test needs sufficient motion in the log.
`docs/reality.md` has the margins on recorded flights.
"""

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxdrones.flights.motion_tests import (
    MIN_WINDOWS,
    Motion,
    MotionTest,
    climb_correlation,
    delay_of,
    force_test,
    lift_correlation,
    rms,
    shift_test,
    turn_test,
    typical,
)
from jaxdrones.flights.motor_order import check_motors

_MIN_UP = 0.5  # cosine of the mean tilt; the mean tilt of a flight is below 60 degrees
_HORIZONTAL_RATIO, _VERTICAL_RATIO = (0.87, 1.08), (0.94, 1.06)  # of distances in the positions and by the velocities
_TURN_RATIO = (0.88, 1.14)  # of turns of the attitudes and by the rates
_ACC_RATIO = (0.5, 1.5)  # of accelerations and those of the tilted thrust
_MAX_CLOCK_MISFIT = 0.1  # largest misfit for a meaningful ratio
_MAX_DRIFT = 1.15  # of horizontal distances over integrals of vel between the halves of a flight
_MIN_CORRELATION = 0.85  # of horizontal vectors for a meaningful angle between them
_MAX_HEADING = np.radians(15)  # the bundled flights have up to 3 degrees
_NED, _SWAPPED = np.array([1, -1, -1]), np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
_DRAGS = np.linspace(0, 0.5, 6)  # 1/s; circles of a Crazyflie have 0.45
_MAX_DELAY, _MIN_EXPLAINED = 0.05, 0.4  # s; of the misfit. Recorded flights have up to 0.02 s
_MIN_CLIMB_CORRELATION = 0.5  # of heights by pos and by vel; recorded flights have 0.98 or more
_OPPOSITE = -0.4  # correlation of vertical accelerations and thrust; recorded flights have 0.78 or more
_FAR_BETTER = 0.25  # of the squared errors of the turns; recorded flights have 1.0 or more
_MAX_RISE = 0.1  # V; largest rise of a battery when the motors start


Change = tuple[str, Callable[[Any], Any]]


def _flipped(x: np.ndarray) -> np.ndarray:
    return x * _NED


_HALF_TURN = Rotation.from_quat([1.0, 0, 0, 0])  # about x: between z-up and z-down axes


def _turned(attitude: Rotation) -> Rotation:
    """Convert attitudes from z-down to z-up axes in world and body."""
    return _HALF_TURN * attitude * _HALF_TURN


def _w_last(attitude: Rotation) -> Rotation:
    return Rotation.from_quat(attitude.as_quat()[:, [1, 2, 3, 0]])


_READINGS: dict[str, tuple[Change, ...]] = {
    "pos": (
        ("pos looks like x, -y, -z (NED axes)", _flipped),
        ("pos looks like NED axes", lambda x: x @ _SWAPPED),
        ("z of pos, or that of vel, has the opposite sign", lambda x: x * [1, 1, -1]),
    ),
    "vel": (("vel looks like x, -y, -z (NED axes)", _flipped), ("vel looks like NED axes", lambda x: x @ _SWAPPED)),
    "attitude": (
        ("the quaternions look like w, x, y, z", _w_last),
        ("the quaternions look conjugated (world to body)", Rotation.inv),
        ("the quaternions look like w, x, y, z and conjugated", lambda r: _w_last(r).inv()),
        ("the attitude looks like that of NED axes (z down in world and body)", _turned),
        ("the attitude looks like that of a z-down body", lambda r: r * _HALF_TURN),
        ("the attitude looks like that of a z-down world", lambda r: _HALF_TURN * r),
    ),
    "omega": (
        ("omega looks like p, -q, -r (z-down body axes)", _flipped),
        ("omega has the opposite sign", np.negative),
    ),
}
_WORLD_RATES = "omega looks like world axes"
_ALL_NED = "all columns look like NED axes (z down in world and body)"


def contradictions(motion: Motion, thrusts: np.ndarray, sag: float) -> list[str]:
    """Contradictions within a flight, a sentence each with the likely cause.

    Motion and relative thrusts (T, 4) are those of the rows with running motors; `sag` is the battery's at take-off, V.
    """
    found, read = _check_axes(motion)
    found = (
        found or _check_scales(motion) or _check_headings(motion) or _check_rate_axes(motion) or _check_delay(motion)
    )
    found = found + _check_lift(thrusts, read) + check_motors(thrusts, read.attitude, read.vel, read.omega)
    if sag < -_MAX_RISE:
        found.append(f"vbat rises by {-sag:.2f} V when the motors start: the load of the battery has the wrong sign")
    return found


def _failures(motion: Motion) -> Iterator[str]:
    """Contradictions of the axes, the one that is found fastest first."""
    pos, attitude, vel, omega = motion
    if not (test := shift_test(pos, vel)).passes:
        yield f"vel is not the derivative of pos (misfit {test.misfit:.2f} of 1)"
    elif (correlation := climb_correlation(pos, vel)) < _MIN_CLIMB_CORRELATION:
        yield f"z of vel is not the derivative of that of pos (correlation {correlation:.2f})"
    if not (test := turn_test(attitude, omega)).passes:
        yield f"omega is not the rate of quat (misfit {test.misfit:.2f} of 1)"
    force = force_test(vel, attitude)
    axes = [force._replace(has=force.has[:, i : i + 1], implied=force.implied[:, i : i + 1]) for i in range(2)]
    if not all(axis.passes for axis in axes):
        misfit = max(axis.misfit for axis in axes if not axis.passes)
        yield f"the acceleration does not follow the tilt of the thrust (misfit {misfit:.2f} of 1)"
    up = np.mean(attitude.apply([0, 0, 1.0])[:, 2]) if len(pos) else 1.0
    if up < _MIN_UP:
        yield f"body z points down or sideways (mean cosine of the tilt {up:.2f})"


def _check_axes(logged: Motion) -> tuple[list[str], Motion]:
    """Failures with the simplest explanation by other conventions of columns, and the columns in these."""
    failures = list(_failures(logged))
    if not failures:
        return [], logged
    for causes, motion in _readings(logged):
        if next(_failures(motion), None) is None:
            return [f"{'; '.join(failures)}: {' and '.join(causes)}"], motion
    hint = ": vel has another unit, or belongs to other positions, axes or times" if "vel" in failures[0] else ""
    return ["; ".join(failures) + hint], logged


def _readings(logged: Motion):
    """Other conventions of the columns, fewest changes first: causes, and converted columns."""
    every = [(name, cause, change) for name, changes in _READINGS.items() for cause, change in changes]
    yield ["vel looks like body axes"], logged._replace(vel=logged.attitude.apply(logged.vel))
    yield [_WORLD_RATES], _with_world_rates(logged)
    yield (
        [_ALL_NED],
        Motion(_flipped(logged.pos), _turned(logged.attitude), _flipped(logged.vel), _flipped(logged.omega)),
    )
    for count in (1, 2):
        for changes in itertools.combinations(every, count):
            if len({name for name, _, _ in changes}) == count:
                read = logged._replace(**{name: change(getattr(logged, name)) for name, _, change in changes})
                yield [cause for _, cause, _ in changes], read


def _ratio(test: MotionTest, axes: slice) -> float | None:
    """Ratio of logged to implied values along some axes; `None` for too little motion or agreement."""
    has, implied = test.has[:, axes], test.implied[:, axes]
    if len(has) < MIN_WINDOWS or max(rms(has), rms(implied)) < 2 * test.min_motion:
        return None
    has, implied = has - np.mean(has, axis=0), implied - np.mean(implied, axis=0)
    ratio = np.sqrt(np.sum(has**2) / max(np.sum(implied**2), 1e-12))
    unlike = np.sum((has - ratio * implied) ** 2) / max(np.sum(has**2), 1e-12)
    return float(ratio) if unlike < 2 * _MAX_CLOCK_MISFIT else None


def _check_scales(motion: Motion) -> list[str]:
    """Check the scales of distances and rotations against velocities and rates; a wrong clock scales both."""
    pos, attitude, vel, omega = motion
    shifts = shift_test(pos, vel)
    ratios = {
        "horizontal distances over integrals of vel": (_ratio(shifts, slice(0, 2)), _HORIZONTAL_RATIO),
        "vertical distances over integrals of vel": (_ratio(shifts, slice(2, 3)), _VERTICAL_RATIO),
        "turns of quat over integrals of omega": (_ratio(turn_test(attitude, omega), slice(0, 3)), _TURN_RATIO),
        "accelerations over those of the tilted thrust": (_ratio(force_test(vel, attitude), slice(0, 2)), _ACC_RATIO),
    }
    off = [
        f"{name}: {ratio:.2f}"
        for name, (ratio, (low, high)) in ratios.items()
        if ratio is not None and not low <= ratio <= high
    ]
    if not off:
        return _check_drift(shifts)
    turns = ratios["turns of quat over integrals of omega"][0]
    values = [ratio for name, (ratio, _) in ratios.items() if ratio is not None and any(name in each for each in off)]
    clock = turns is None or all((turns - 1) * (ratio - 1) > 0 for ratio in values)
    cause = (
        "t runs at another rate than the flight (a wrong clock)" if clock else "pos or vel has another unit or scale"
    )
    if values == [turns] and any(ratio is not None for name, (ratio, _) in ratios.items() if name.endswith("vel")):
        cause = "omega has another unit or scale"  # a wrong clock would scale distances, too
    return [f"{'; '.join(off)} instead of 1: {cause}"]


def _check_drift(shifts: MotionTest) -> list[str]:
    """Check that the first and the second half of a flight have the same scale of distances."""
    middle = len(shifts.has) // 2
    halves = (slice(middle), slice(middle, None))
    ratios = [_ratio(shifts._replace(has=shifts.has[i], implied=shifts.implied[i]), slice(0, 2)) for i in halves]
    first, second = ratios
    if first is None or second is None or max(first / second, second / first) < _MAX_DRIFT:
        return []
    name = "horizontal distances over integrals of vel"
    return [f"{name}: {first:.2f} and {second:.2f} in the halves of the flight: the rate of t changes (a wrong clock)"]


def _check_headings(motion: Motion) -> list[str]:
    """Check that horizontal accelerations and turns have the heading that the attitude implies.

    In a circle the thrust also tilts against the drag, at a right angle to the acceleration.
    """
    _, attitude, vel, omega = motion
    forces = [force_test(vel, attitude, drag) for drag in _DRAGS]
    tests = (
        ("the tilt of the thrust and the acceleration", forces, "world axes of quat and vel"),
        ("the turns of quat and the integrals of omega", [turn_test(attitude, omega)], "body axes of quat and omega"),
    )
    return [
        f"{name} are at least {abs(np.degrees(angle)):.0f} degrees apart about z: the {axes} differ"
        for name, alike, axes in tests
        if abs(angle := min(map(_heading, alike), key=abs)) > _MAX_HEADING
    ]


def _with_world_rates(motion: Motion) -> Motion:
    """Motion whose logged rates are in world axes."""
    return motion._replace(omega=motion.attitude.inv().apply(motion.omega))


def _check_rate_axes(motion: Motion) -> list[str]:
    """Check that the rates fit the attitude in body axes, not far better in world axes.

    Both have the same heading rate, which alone hides the others in a fast turn.
    """
    body, world = (turn_test(x.attitude, x.omega) for x in (motion, _with_world_rates(motion)))
    if not body.observable or rms(body.implied - world.implied) < body.min_motion:
        return []
    errors = [typical(test.has - test.implied) for test in (body, world)]
    return [_WORLD_RATES] if errors[1] < _FAR_BETTER * errors[0] else []


def _check_delay(motion: Motion) -> list[str]:
    """Check that velocities are those of the present positions."""
    delay, explained = delay_of(motion.pos, motion.vel)
    if abs(delay) < _MAX_DELAY or explained < _MIN_EXPLAINED:
        return []
    return [f"vel is about {abs(delay):.2g} s {'late' if delay > 0 else 'early'} against pos: the times differ"]


def _check_lift(thrusts: np.ndarray, motion: Motion) -> list[str]:
    """Check that the drone accelerates upwards where its thrust rises."""
    if not len(thrusts) or lift_correlation(np.sum(thrusts, axis=1), motion.vel, motion.attitude) > _OPPOSITE:
        return []
    return ["the vertical acceleration falls where the thrust rises: z of vel has the opposite sign"]


def _heading(test: MotionTest) -> float:
    """Angle about z from implied to logged horizontal vectors, rad; 0 where they are small or hardly correlated."""
    has, implied = (x[:, 0] + 1j * x[:, 1] for x in (test.has, test.implied))
    if not test.observable:
        return 0.0
    has, implied = has - np.mean(has), implied - np.mean(implied)
    product = np.vdot(implied, has)
    correlated = np.abs(product) > _MIN_CORRELATION * np.linalg.norm(has) * np.linalg.norm(implied)
    return float(np.angle(product)) if correlated else 0.0
