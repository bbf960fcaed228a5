"""The vehicle that repeats recorded flights best: output-error identification over many short pieces."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.checks import shown
from jaxdrones.dynamics import Motors, crazyflie_motors
from jaxdrones.identification.least_squares import Normal, normal_equations
from jaxdrones.identification.log import FlightLog
from jaxdrones.identification.open_loop import HORIZONS, Windows, held_errors, open_loop_errors, starts_of, windows
from jaxdrones.identification.parameters import (
    PARAMETERS,
    asked_parameters,
    default_parameters,
    step_of,
    value_of,
    with_parameters,
)
from jaxdrones.identification.path_fit import fit_path
from jaxdrones.identification.vehicle import Vehicle
from jaxdrones.params import Params

_STRIDE = 25  # rows between the starts of pieces
_FIRST_SPREAD = np.array([0.05, 0.25, 0.1, 0.4])  # at the last horizon: m, m/s, rad, rad/s
_UNSEEN = 1e3  # times the spread, of a horizon that does not count yet
_ROUNDS = 4  # in which the spreads are those that were found
_STEPS = 4  # of each round
_DAMPING = 1e-3  # of the first step
_PRIOR = 1e-2  # inverse variance of x, in pieces: holds what the flights do not tell
_PRIOR_OF_LOGARITHMS = 1.0
_LITTLE = 1e-3  # of the prior, which makes the errors of what flights do not tell finite
_UNTOLD = 0.5  # standard error over value, beyond which flights do not tell a parameter


@dataclasses.dataclass(frozen=True)
class Estimate:
    """What flights tell of a parameter; of one that differs from flight to flight, of its median."""

    value: float
    """SI units."""
    error: float
    """Standard error by the Gauss-Newton matrix, as if the residuals were independent of each other."""
    told: bool
    """Whether the flights tell it."""


@dataclasses.dataclass(frozen=True)
class Report:
    """What a fit found."""

    vehicle: Vehicle
    parameters: dict[str, Estimate]
    """By name."""
    of_flights: dict[str, dict[str, float]]
    """By flight and name: what differs from flight to flight."""
    losses: tuple[float, ...]
    """Of the validation flights, or without them of the flights that are fitted, after each step; the least is kept."""
    errors: dict[str, np.ndarray]
    """By flight: (horizons, 4) open-loop errors of the vehicle, those of validation flights too."""


def fit(
    logs: Sequence[FlightLog],
    params: Params,
    names: Sequence[str] = (),
    validate: Sequence[FlightLog] = (),
    motors: Motors | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> Report:
    """Fit parameters of a vehicle to recorded flights.

    Every piece of half a second is flown from its logged start, and the squares of the differences after 0.1, 0.25 and
    0.5 s are made small by Gauss-Newton steps: first for the nearest horizon, then for all of them. Each residual is
    divided by its spread in its flight, and a piece that fits badly counts less. Flights on set-points without rotor
    speeds are fitted as a whole, flown by the firmware's PID, unless parameters are named: see `fit_path`.

    Args:
        logs: flights to fit, all with rotor speeds or all without.
        params: of one drone, where the search starts.
        names: of `PARAMETERS`; all that such logs tell when left out.
        validate: flights that are not fitted, and on which the best step is chosen.
        motors: of logs of PWM; those of the Crazyflie 2.1+ when left out.
        progress: called with a line after each step.

    Raises:
        ValueError: no flights, flights with rotor speeds beside flights without them, or parameters that the flights do
            not tell.
    """
    asked = bool(names)
    if not logs:
        raise ValueError("there are no flights to fit; give at least one")
    kinds = {log.has_rotor_speeds for log in (*logs, *validate)}
    if len(kinds) > 1:
        raise ValueError("some logs have rotor speeds and others only PWM; fit them one after the other")
    motors = motors or crazyflie_motors()
    if not asked and all(log.has_set_points for log in logs):
        return _fit_paths(logs, params, validate, motors, progress)
    names = asked_parameters(names) if asked else default_parameters(kinds.pop())
    return _Problem(logs, params, names, motors).solve(validate, asked, progress)


def _fit_paths(
    logs: Sequence[FlightLog],
    params: Params,
    validate: Sequence[FlightLog],
    motors: Motors,
    progress: Callable[[str], None],
) -> Report:
    if validate:
        raise ValueError(
            "flights on set-points are fitted without validation; leave --validate out, or name --parameters"
        )
    vehicle, errors = fit_path(logs, Vehicle.of(params), motors, progress)
    found = {name: _estimate(vehicle, name, error) for name, error in errors.items()}
    return Report(vehicle, found, {}, (), {log.name: open_loop_errors(log, vehicle, motors) for log in logs})


def _estimate(vehicle: Vehicle, name: str, error: float) -> Estimate:
    """The estimate of a parameter by the standard error of its coordinate."""
    value, step = value_of(vehicle, name), step_of(vehicle, name)
    return Estimate(value, error * step, bool(error * step < max(step, _UNTOLD * abs(value))))


class _Problem:
    """The coordinates are those of the vehicle, then those of each flight."""

    def __init__(self, logs: Sequence[FlightLog], params: Params, names: tuple[str, ...], motors: Motors):
        self.logs, self.start = logs, Vehicle.of(params)
        self.given_motors = motors
        self.motors = None if logs[0].has_rotor_speeds else motors
        self.common = tuple(name for name in names if not PARAMETERS[name].of_flight)
        self.own = tuple(name for name in names if PARAMETERS[name].of_flight)
        self.names, self.flights = self.common + self.own, [log.name for log in logs]
        starts = [starts_of(log, _STRIDE) for log in logs]
        most = max(map(len, starts))
        self.pieces = [_filled(windows(log, s), most) for log, s in zip(logs, starts, strict=True)]
        self.counts = [jnp.asarray(np.arange(most) < len(s), float) for s in starts]
        self.size = len(self.common) + len(logs) * len(self.own)
        names = self.common + self.own * len(logs)
        self.prior = np.array([_PRIOR_OF_LOGARITHMS if PARAMETERS[n].unit is None else _PRIOR for n in names])

    def indices(self, flight: int) -> np.ndarray:
        """Of the coordinates that a flight depends on."""
        first = len(self.common) + flight * len(self.own)
        return np.concatenate([np.arange(len(self.common)), np.arange(first, first + len(self.own))])

    def normal(self, x: np.ndarray, spreads: list[np.ndarray]) -> tuple[Normal, list[np.ndarray]]:
        """Normal equations of all flights, with the prior, and the spreads that were found."""
        matrix, gradient, found = np.diag(self.prior), self.prior * x, []
        loss = float(self.prior @ x**2)
        coordinates = [self.indices(i) for i in range(len(self.flights))]
        with ThreadPoolExecutor(os.cpu_count()) as pool:  # a program of one flight keeps one core busy
            parts = pool.map(self._of_flight, (x[at] for at in coordinates), spreads, self.pieces, self.counts)
        for at, part in zip(coordinates, parts, strict=True):
            matrix[np.ix_(at, at)] += part.matrix
            gradient[at] += part.gradient
            loss += part.loss
            found.append(part.spread)
        return Normal(matrix, gradient, loss, np.stack(found)), found

    def _of_flight(self, x: np.ndarray, spread: np.ndarray, pieces: Windows, counts: jax.Array) -> Normal:
        return normal_equations(self.start, self.names, x, spread, pieces, counts, self.motors)

    def vehicle(self, x: np.ndarray) -> Vehicle:
        """The vehicle with the medians of what differs from flight to flight."""
        own = x[len(self.common) :].reshape(len(self.flights), len(self.own))
        return with_parameters(
            self.start, self.names, list(np.concatenate([x[: len(self.common)], np.median(own, axis=0)]))
        )

    def solve(self, validate: Sequence[FlightLog], asked: bool, progress: Callable[[str], None]) -> Report:
        """Near horizons first, then all of them with spreads that were found; the best round by the validation."""
        scale = np.array(HORIZONS)[:, None] / HORIZONS[-1] * _FIRST_SPREAD
        seen = [np.where(np.arange(len(HORIZONS)) <= k, 1, _UNSEEN)[:, None] for k in range(len(HORIZONS))]
        x = np.zeros(self.size)
        found: list[np.ndarray] = []
        history: list[float] = []
        best: tuple[float, np.ndarray, Normal | None] = (np.inf, x, None)
        for k in range(len(seen) + _ROUNDS):
            spreads = [scale * seen[k]] * len(self.flights) if k < len(seen) else found
            x, normal, found = self._descend(x, spreads)
            if k < len(seen) - 1:
                continue
            loss = self._validation_loss(x, validate) if validate else normal.loss
            progress(f"round {k + 1} of {len(seen) + _ROUNDS}: {'validation' if validate else 'loss'} {loss:.4g}")
            if not validate or loss < best[0]:
                best = (loss, x, normal)
            history.append(loss)
        _, x, last = best
        assert last is not None  # of at least one round
        return self._report(x, last, tuple(history), validate, asked)

    def _descend(self, x: np.ndarray, spreads: list[np.ndarray]) -> tuple[np.ndarray, Normal, list[np.ndarray]]:
        """Some steps of Levenberg and Marquardt."""
        damping = _DAMPING
        normal, found = self.normal(x, spreads)
        for _ in range(_STEPS):
            damped = normal.matrix + damping * np.diag(np.diag(normal.matrix))
            after = x - np.linalg.solve(damped, normal.gradient)
            normal_after, found_after = self.normal(after, spreads)
            if normal_after.loss < normal.loss:
                x, normal, found, damping = after, normal_after, found_after, damping / 10
            else:
                damping *= 10
        return x, normal, found

    def _validation_loss(self, x: np.ndarray, validate: Sequence[FlightLog]) -> float:
        """Mean of the errors at the last horizon over those of a model that stays where it starts."""
        vehicle = self.vehicle(x)
        return float(np.mean([self._errors(log, vehicle)[-1] / held_errors(log)[-1] for log in validate]))

    def _errors(self, log: FlightLog, vehicle: Vehicle) -> np.ndarray:
        return open_loop_errors(log, vehicle, self.given_motors)

    def _report(
        self, x: np.ndarray, normal: Normal, history: tuple[float, ...], validate: Sequence[FlightLog], asked: bool
    ) -> Report:
        told = normal.matrix - (1 - _LITTLE) * np.diag(self.prior)  # by the flights, not by the prior
        vehicle, errors = self.vehicle(x), np.sqrt(np.diag(np.linalg.inv(told)))
        common, own = errors[: len(self.common)], errors[len(self.common) :].reshape(len(self.flights), len(self.own))
        by_name = np.concatenate([common, np.sqrt(np.sum(own**2, axis=0)) / len(self.flights)])
        found = {name: _estimate(vehicle, name, error) for name, error in zip(self.names, by_name, strict=True)}
        untold = [f"{name} ({shown(e.value)} +- {e.error:.2g})" for name, e in found.items() if not e.told]
        if untold and asked:
            raise ValueError(
                f"the flights do not tell {', '.join(untold)}; leave out of --parameters what they do not tell"
            )
        of_flights = {}
        for i, flight in enumerate(self.flights):
            at_flight = with_parameters(self.start, self.names, list(x[self.indices(i)]))
            of_flights[flight] = {name: value_of(at_flight, name) for name in self.own}
        flown = {log.name: self._errors(log, vehicle) for log in (*self.logs, *validate)}
        return Report(vehicle, found, of_flights, history, flown)


def _filled(pieces: Windows, count: int) -> Windows:
    """The pieces, and the last one again and again, up to a number of pieces, so that flights share a program."""
    return jax.tree.map(lambda x: jnp.pad(x, [(0, count - len(x))] + [(0, 0)] * (x.ndim - 1), mode="edge"), pieces)
