"""Output-error identification of vehicle parameters from recorded flights."""

import dataclasses
import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np

from jaxdrones.checks import short_repr
from jaxdrones.control import firmware_pid
from jaxdrones.dynamics.propulsion import Motors, crazyflie_motors
from jaxdrones.errors import UserError
from jaxdrones.flights import parameters
from jaxdrones.flights.least_squares import Normal, levenberg_marquardt, normal_equations, standard_errors
from jaxdrones.flights.log import FlightLog
from jaxdrones.flights.open_loop import HORIZONS, cut_windows, hold_errors, open_loop_errors, window_starts
from jaxdrones.flights.path_fit import BALANCE_PARAMETERS, PATH_PARAMETERS, fit_path, padded
from jaxdrones.flights.preparation import named_apart
from jaxdrones.flights.vehicle import Vehicle
from jaxdrones.params import Params

_STRIDE = 25  # rows between the starts of windows
_INITIAL_SCALE = np.array([0.05, 0.25, 0.1, 0.4])  # of residuals at the last horizon: m, m/s, rad, rad/s
_INACTIVE = 1e3  # factor on the scale of a horizon with unused residuals
_ROUNDS = 4  # rounds with robust scales, re-estimated after each
_STEPS_PER_ROUND = 4
_PRIOR_PRECISION = 1e-2  # inverse variance of x, which keeps unidentifiable parameters finite
_LOG_PRIOR_PRECISION = 1.0  # inverse variance of x where x is a logarithm
_PRIOR_REMAINDER = 1e-3  # fraction of the prior in the information matrix, which keeps it invertible
_MAX_RELATIVE_ERROR = 0.5  # standard error over value of an identifiable parameter: two standard errors exclude zero
_RATIOS = ("position_scale", "estimate_tilt")  # parameters with an ideal value of 1, not 0
_MIN_SPEED = 0.01  # m/s rms, of a log in flight


@dataclasses.dataclass(frozen=True)
class Estimate:
    """Estimate of one parameter; of a per-flight parameter, the median over the flights."""

    value: float
    """Estimated value, SI units."""
    std_error: float
    """Standard error, SI units, with residuals that are correlated over a second; without errors of the model.

    That of a per-flight parameter is at least that of the mean of values with the scatter of those of the flights."""
    identifiable: bool
    """Whether the parameter is identified: zero is at least two standard errors away.

    Ratios with an ideal value of 1 need a standard error below the scale of their coordinate."""


@dataclasses.dataclass(frozen=True)
class Report:
    """Result of `fit`."""

    vehicle: Vehicle
    """Fitted vehicle."""
    parameters: dict[str, Estimate]
    """Estimates by name of the parameter."""
    per_flight: dict[str, dict[str, float]]
    """Values of the per-flight parameters, by flight and name, SI units."""
    losses: tuple[float, ...]
    """Loss after each round: of the validation flights, or without these of the fitted ones.

    The loss of fitted flights is relative to the residuals of the round before. That of the first round is relative to
    fixed scales, and not comparable with the others.
    """
    errors: dict[str, np.ndarray]
    """Open-loop errors (horizons, 4) of the fitted vehicle by flight, validation flights included."""


def fit(
    logs: Sequence[FlightLog],
    params: Params,
    names: Sequence[str] = (),
    validate: Sequence[FlightLog] = (),
    motors: Motors | None = None,
    progress: Callable[[str], None] = lambda line: None,
    gains: firmware_pid.Gains | None = None,
) -> Report:
    """Estimate parameters of a vehicle from recorded flights.

    The vehicle is simulated over windows of half a second from their logged starts, and Levenberg-Marquardt steps
    minimize the squared differences from the log after 0.1, 0.25 and 0.5 s: first at the nearest horizon, then at all
    of them. Each residual is divided by its robust scale in its flight, and a Cauchy loss reduces the weight of
    outlying windows. Without `names`, a drag, damping or rotor inertia that would be negative is zero, and the others
    are fitted again without it. Without `names`, flights on set-points without rotor speeds are simulated as a whole,
    in closed loop with the firmware's PID: see `fit_path`.

    Args:
        logs: flights to fit, all with rotor speeds or all without.
        params: initial parameters of one drone.
        names: names of `PARAMETERS` to fit; by default those identifiable from such logs.
        validate: held-out flights for the choice of the best round.
        motors: motors for logs of PWM; by default those of the Crazyflie 2.1+.
        progress: called with a line after each round.
        gains: gains of the recorded firmware; by default those for 2.1+ propellers.

    Raises:
        ValueError: no flights, a duplicate or resting flight, flights with and without rotor speeds, or a named
            parameter that is not identifiable.
    """
    named = bool(names)
    if not logs:
        raise UserError("there are no flights to fit; give at least one")
    named_logs = named_apart((*logs, *validate))
    logs, validate = named_logs[: len(logs)], named_logs[len(logs) :]
    for log in named_logs:
        if np.sqrt(np.mean(log.vel**2)) < _MIN_SPEED:
            raise UserError(f"{log.name}: the drone rests in the whole log; give a log of a flight")
    kinds = {log.has("rpm") for log in (*logs, *validate)}
    if len(kinds) > 1:
        raise UserError("some logs have rotor speeds and others only PWM; fit them one after the other")
    motors = motors or crazyflie_motors()
    if not named and all(log.has("target_pos", "target_yaw", "pwm") for log in logs):
        return _fit_paths(logs, params, validate, motors, gains or firmware_pid.gains(), progress)
    default = parameters.FROM_ROTOR_SPEEDS if kinds.pop() else parameters.FROM_PWM
    names = parameters.select_parameters(names) if named else default
    parameters.check_guess(Vehicle.of(params), names)
    report = _Problem(logs, params, names, motors).solve(validate, named, progress)
    while not named and (negative := parameters.negative(report.vehicle, names)):
        progress(f"{', '.join(negative)} would be negative; fitting again with zero in place of them")
        params, names = parameters.without(params, negative), tuple(name for name in names if name not in negative)
        report = _Problem(logs, params, names, motors).solve(validate, named, progress)
    return report


def _fit_paths(
    logs: Sequence[FlightLog],
    params: Params,
    validate: Sequence[FlightLog],
    motors: Motors,
    gains: firmware_pid.Gains,
    progress: Callable[[str], None],
) -> Report:
    if validate:
        raise UserError(
            "flights on set-points are fitted without validation; leave --validate out, or name --parameters"
        )
    parameters.check_guess(Vehicle.of(params), (*BALANCE_PARAMETERS, *PATH_PARAMETERS))
    vehicle, errors = fit_path(logs, Vehicle.of(params), motors, gains, progress)
    estimates = {name: _estimate(vehicle, name, error) for name, error in errors.items()}
    return Report(vehicle, estimates, {}, (), {log.name: open_loop_errors(log, vehicle, motors) for log in logs})


def _estimate(vehicle: Vehicle, name: str, error: float) -> Estimate:
    """Estimate of a parameter from the standard error of its coordinate x."""
    value, scale = parameters.value_of(vehicle, name), parameters.scale_of(vehicle, name)
    std_error = error * scale
    limit = scale if name in _RATIOS else _MAX_RELATIVE_ERROR * abs(value)
    return Estimate(value, std_error, bool(std_error < limit))


class _Problem:
    """Least-squares problem; x has the shared parameters, then the per-flight parameters of each flight."""

    def __init__(self, logs: Sequence[FlightLog], params: Params, names: tuple[str, ...], motors: Motors):
        self.logs, self.start = logs, Vehicle.of(params)
        self.motors = motors
        self.pwm_motors = None if logs[0].has("rpm") else motors
        self.shared = tuple(name for name in names if not parameters.PARAMETERS[name].per_flight)
        self.per_flight = tuple(name for name in names if parameters.PARAMETERS[name].per_flight)
        self.names, self.flights = self.shared + self.per_flight, [log.name for log in logs]
        starts = [window_starts(log, _STRIDE) for log in logs]
        longest = max(map(len, starts))
        self.windows = [padded(cut_windows(log, s), longest) for log, s in zip(logs, starts, strict=True)]
        self.masks = [jnp.asarray(np.arange(longest) < len(s), float) for s in starts]
        self.size = len(self.shared) + len(logs) * len(self.per_flight)
        names = self.shared + self.per_flight * len(logs)
        self.prior = np.array(
            [_LOG_PRIOR_PRECISION if parameters.PARAMETERS[n].scale is None else _PRIOR_PRECISION for n in names]
        )

    def indices(self, flight: int) -> np.ndarray:
        """Indices in x of the coordinates of a flight: shared, then per-flight."""
        first = len(self.shared) + flight * len(self.per_flight)
        return np.concatenate([np.arange(len(self.shared)), np.arange(first, first + len(self.per_flight))])

    def normal(self, x: np.ndarray, scales: list[np.ndarray]) -> Normal:
        """Normal equations of all flights with the prior, and robust scales of each flight's residuals."""
        matrix, gradient, robust = np.diag(self.prior), self.prior * x, []
        spread = np.zeros_like(matrix)
        loss = float(self.prior @ x**2)
        coordinates = [self.indices(i) for i in range(len(self.flights))]
        with ThreadPoolExecutor(os.cpu_count()) as pool:  # a program of one flight keeps one core busy
            own = functools.partial(normal_equations, self.start, self.names, motors=self.pwm_motors)
            parts = pool.map(own, (x[i] for i in coordinates), scales, self.windows, self.masks)
        for i, part in zip(coordinates, parts, strict=True):
            matrix[np.ix_(i, i)] += part.matrix
            spread[np.ix_(i, i)] += part.spread
            gradient[i] += part.gradient
            loss += float(part.loss)
            robust.append(part.scale)
        return Normal(matrix, gradient, loss, np.stack(robust), spread)

    def vehicle(self, x: np.ndarray) -> Vehicle:
        """Vehicle with the shared parameters and the medians of the per-flight parameters."""
        per_flight = x[len(self.shared) :].reshape(len(self.flights), len(self.per_flight))
        return parameters.with_parameters(
            self.start, self.names, list(np.concatenate([x[: len(self.shared)], np.median(per_flight, axis=0)]))
        )

    def solve(self, validate: Sequence[FlightLog], named: bool, progress: Callable[[str], None]) -> Report:
        """Fit the near horizons first, then all of them with robust scales, and return the best round.

        The best round has the least validation loss; without validation flights it is the last one.
        """
        initial = np.array(HORIZONS)[:, None] / HORIZONS[-1] * _INITIAL_SCALE
        active = [np.where(np.arange(len(HORIZONS)) <= k, 1, _INACTIVE)[:, None] for k in range(len(HORIZONS))]
        x = np.zeros(self.size)
        robust: list[np.ndarray] = []
        losses: list[float] = []
        best: tuple[float, np.ndarray, Normal | None] = (np.inf, x, None)
        for k in range(len(active) + _ROUNDS):
            scales = [initial * active[k]] * len(self.flights) if k < len(active) else robust
            x, normal = levenberg_marquardt(functools.partial(self.normal, scales=scales), x, _STEPS_PER_ROUND)
            robust = list(normal.scale)
            if k < len(active) - 1:
                continue
            loss = self._validation_loss(x, validate) if validate else float(normal.loss)
            relative = "" if validate or k < len(active) else f" (relative to the residuals of round {k})"
            kind = "validation" if validate else "loss"
            progress(f"round {k + 1} of {len(active) + _ROUNDS}: {kind} {loss:.4g}{relative}")
            if not validate or loss < best[0]:
                best = (loss, x, normal)
            losses.append(loss)
        _, x, last = best
        assert last is not None  # there is at least one round
        return self._report(x, last, tuple(losses), validate, named)

    def _validation_loss(self, x: np.ndarray, validate: Sequence[FlightLog]) -> float:
        """Mean ratio of the errors at the last horizon to those of the persistence model."""
        vehicle = self.vehicle(x)
        return float(
            np.mean([open_loop_errors(log, vehicle, self.motors)[-1] / hold_errors(log)[-1] for log in validate])
        )

    def _report(
        self, x: np.ndarray, normal: Normal, losses: tuple[float, ...], validate: Sequence[FlightLog], named: bool
    ) -> Report:
        information = normal.matrix - (1 - _PRIOR_REMAINDER) * np.diag(self.prior)  # of the flights, not of the prior
        vehicle, errors = self.vehicle(x), standard_errors(information, normal.spread)
        shared = errors[: len(self.shared)]
        per_flight = errors[len(self.shared) :].reshape(len(self.flights), len(self.per_flight))
        n = len(self.flights)
        scatter = np.std(x[len(self.shared) :].reshape(per_flight.shape), axis=0) / np.sqrt(max(n - 1, 1))
        by_name = np.concatenate([shared, np.maximum(np.sqrt(np.sum(per_flight**2, axis=0)) / n, scatter)])
        estimates = {name: _estimate(vehicle, name, error) for name, error in zip(self.names, by_name, strict=True)}
        unidentifiable = [
            f"{name} ({short_repr(e.value)} +- {e.std_error:.2g})"
            for name, e in estimates.items()
            if not e.identifiable and e.std_error >= parameters.scale_of(vehicle, name)
        ]
        if unidentifiable and named:
            raise UserError(
                f"the flights do not identify {', '.join(unidentifiable)}; leave such parameters out of --parameters"
            )
        values = {}
        for i, flight in enumerate(self.flights):
            flown = parameters.with_parameters(self.start, self.names, list(x[self.indices(i)]))
            values[flight] = {name: parameters.value_of(flown, name) for name in self.per_flight}
        open_loop = {log.name: open_loop_errors(log, vehicle, self.motors) for log in (*self.logs, *validate)}
        return Report(vehicle, estimates, values, losses, open_loop)
