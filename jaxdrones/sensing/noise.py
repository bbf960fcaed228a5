"""Sensor errors in terms of the Allan deviation: white noise, bias instability, random walk."""

import dataclasses
import math
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxdrones.arguments import Count, Seconds, checked, number
from jaxdrones.checks import short_repr
from jaxdrones.errors import UserError
from jaxdrones.pytree import PyTreeNode

_FLICKER_FLOOR = math.sqrt(2 * math.log(2) / math.pi)  # Allan deviation of flicker noise over its bias instability
_PEAK = 0.61736  # the largest Allan deviation of a Gauss-Markov process over its standard deviation, at 1.89 times T
_SMALL_RATIO = 0.01  # of averaging and correlation time, below which a series is used
_NAME = "{argument} of {function}"
_AMOUNT, _POSITIVE = number(name=_NAME, at_least=0), number(name=_NAME, above=0, infinite=True)


class Errors(PyTreeNode):
    """Error state of a channel between measurements; arrays of the reading's shape."""

    turn_on: Array
    """The bias since power-on, in units of the reading."""
    drift: Array
    """The Gauss-Markov part of the bias, in units of the reading."""
    walk: Array
    """The random walk of the bias, in units of the reading."""
    scale: Array
    """Scale factor error: a reading of 1 becomes 1 + `scale`."""

    @property
    def bias(self) -> Array:
        """The sum of the three parts of the bias, in units of the reading."""
        return self.turn_on + self.drift + self.walk


@checked
@dataclasses.dataclass(frozen=True, kw_only=True)
class Noise:
    """Error model of the channels of a sensor with readings in a unit u; channels are independent.

    The names are those of IEEE 952 and of Kalibr's noise model. A data sheet's noise density is a one-sided spectral
    density, for which the Allan deviation of white noise is strictly smaller by a factor of sqrt(2). As is customary,
    the number is used as `density`, which overestimates the noise of a part.
    """

    density: Annotated[float, _AMOUNT] = 0.0
    """White noise, u/sqrt(Hz): its Allan deviation over t seconds is density / sqrt(t)."""
    instability: Annotated[float, _AMOUNT] = 0.0
    """Bias instability B, u: the Allan deviation of the bias is at most 0.664 B, at a time of 1.89 `correlation`."""
    correlation: Annotated[float, _POSITIVE] = 100.0
    """Correlation time of the Gauss-Markov process of the bias instability, s."""
    random_walk: Annotated[float, _AMOUNT] = 0.0
    """Random walk K of the bias, u/s/sqrt(Hz): its Allan deviation over t seconds is K sqrt(t / 3)."""
    turn_on: Annotated[float, _AMOUNT] = 0.0
    """Standard deviation of the bias at the start of an episode, u."""
    scale: Annotated[float, _AMOUNT] = 0.0
    """Standard deviation of the scale factor error at the start of an episode."""
    limit: Annotated[float, _POSITIVE] = math.inf
    """Largest reading, at which a channel saturates, u."""

    @property
    def drift(self) -> float:
        """Standard deviation of the Gauss-Markov part of the bias, u."""
        return _FLICKER_FLOOR / _PEAK * self.instability

    @property
    def bias_walk(self) -> float:
        """Density of the noise that drives the bias, u/s/sqrt(Hz): its random walk in a filter."""
        return math.hypot(self.random_walk, self.drift * math.sqrt(2 / self.correlation))

    @property
    def bias(self) -> float:
        """Standard deviation of the bias at the start of an episode, u."""
        return math.hypot(self.turn_on, self.drift)

    def init(self, key: jax.Array, shape: tuple[int, ...], dtype: DTypeLike) -> Errors:
        """Errors of a reading at the start of an episode."""
        turn_on, drift, scale = (jax.random.normal(k, shape, dtype) for k in jax.random.split(key, 3))
        return Errors(self.turn_on * turn_on, self.drift * drift, jnp.zeros(shape, dtype), self.scale * scale)

    def measure(
        self, key: jax.Array, errors: Errors, true: Float[Array, "*shape"], dt: float
    ) -> tuple[Errors, Float[Array, "*shape"]]:
        """Errors and reading, of the true value, at one measurement `dt` (s) after the previous one."""
        white, driven, step = (jax.random.normal(k, true.shape, true.dtype) for k in jax.random.split(key, 3))
        kept = math.exp(-dt / self.correlation)
        errors = errors.replace(
            drift=kept * errors.drift + self.drift * math.sqrt(1 - kept**2) * driven,
            walk=errors.walk + self.random_walk * math.sqrt(dt) * step,
        )
        reading = (1 + errors.scale) * true + errors.bias + self.density / math.sqrt(dt) * white
        return errors, jnp.clip(reading, -self.limit, self.limit)

    def allan_deviation(self, time: ArrayLike) -> np.ndarray:
        """Theoretical Allan deviation of the readings at rest over averaging times (...), s.

        White noise, Gauss-Markov process and random walk add in quadrature (IEEE 952, annex C). Times that are not
        positive raise `ValueError`.
        """
        t = np.asarray(time, float)
        if not (t > 0).all():
            raise UserError(f"time is {short_repr(t)}; give positive averaging times (s)")
        ratio = t / self.correlation
        series = ratio * (1 / 3 + ratio * (-1 / 4 + ratio * (7 / 60 + ratio * (-1 / 24 + ratio * 31 / 2520))))
        exact = np.maximum(ratio, _SMALL_RATIO)  # below it the difference is rounded
        decay = 3 - 4 * np.exp(-exact) + np.exp(-2 * exact)
        drift = 2 * self.drift**2 * np.where(ratio < _SMALL_RATIO, series, (1 - decay / (2 * exact)) / exact)
        return np.sqrt(self.density**2 / t + drift + self.random_walk**2 * t / 3)


@checked
def allan_deviation(readings: ArrayLike, dt: Seconds, samples: Count) -> np.ndarray:
    """Overlapping Allan deviation (...) of readings (n, ...) at rest, `dt` (s) apart, in units of a reading.

    Further axes are channels. The averaging time is the number of `samples` in an average times `dt`.

    Raises:
        ValueError: fewer than 2 `samples` + 1 readings, or readings that are not finite.
    """
    readings = np.asarray(readings, float)
    if readings.ndim < 1 or len(readings) <= 2 * samples:
        raise UserError(f"{readings.shape} readings are too few to average {samples}; give at least {2 * samples + 1}")
    if not np.isfinite(readings).all():
        raise UserError("some readings are not finite; remove or repair them")
    angle = np.concatenate([np.zeros_like(readings[:1]), np.cumsum(readings - readings.mean(axis=0), axis=0)]) * dt
    change = angle[2 * samples :] - 2 * angle[samples:-samples] + angle[: -2 * samples]
    return np.sqrt(np.mean(change**2, axis=0) / 2) / (samples * dt)
