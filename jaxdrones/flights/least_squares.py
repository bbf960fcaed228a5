"""Levenberg-Marquardt, and normal equations of a robust sum of squares over windows of a flight."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.dynamics.propulsion import Motors
from jaxdrones.flights.open_loop import HORIZONS, Windows, predict, residuals
from jaxdrones.flights.parameters import with_parameters
from jaxdrones.flights.vehicle import Vehicle

_CAUCHY_SCALE_SQUARED = 1.0  # c^2 of the Cauchy loss n c^2 log(1 + s / c^2); s is the mean of a window's n squares
_INITIAL_DAMPING = 1e-3  # fraction of the diagonal
_MEDIAN_SQUARE = 0.455  # median of the square of a standard normal variable
_CORRELATED_WINDOWS = 4  # following windows with correlated residuals: one second


class Normal(NamedTuple):
    """Normal equations of one flight, or of all flights."""

    matrix: Any
    """(n, n) Gauss-Newton matrix J'WJ."""
    gradient: Any
    """(n,) J'Wr, half of the gradient of the loss."""
    loss: Any
    """() robust sum of squares."""
    scale: Any = np.ones(())
    """(horizons, 4) robust standard deviation of the unweighted residuals, by horizon and quantity."""
    spread: Any = 0.0
    """(n, n) covariance of the gradient."""


def levenberg_marquardt(
    normal: Callable[[Any], Normal], x: np.ndarray, steps: int, min_decrease: float = 0.0
) -> tuple[np.ndarray, Normal]:
    """Minimize a sum of squares from x (n,); return the best coordinates and their normal equations, in float64.

    It takes `steps`, rejected ones included, or stops at a relative decrease of the loss below `min_decrease`.
    """

    def evaluated(x: np.ndarray) -> Normal:
        return jax.tree.map(lambda x: np.asarray(x, float), normal(x))

    best, damping = evaluated(x), _INITIAL_DAMPING
    for _ in range(steps):
        candidate = x - np.linalg.solve(best.matrix + damping * np.diag(np.diag(best.matrix)), best.gradient)
        tried = evaluated(candidate)
        decrease = best.loss - tried.loss
        if decrease > 0:
            x, best, damping = candidate, tried, damping / 10
        else:
            damping *= 10
        if 0 < decrease < min_decrease * best.loss:
            break
    return x, best


@functools.partial(jax.jit, static_argnums=1)
def normal_equations(
    vehicle: Vehicle,
    names: tuple[str, ...],
    x: Array,
    scale: Array,
    windows: Windows,
    mask: Array,
    motors: Motors | None,
) -> Normal:
    """Normal equations of one flight at the coordinates x of the parameters; at x = 0 they are the vehicle's.

    Residuals are scaled by `scale` (horizons, 4); `mask` (windows,) is 1 for a window, 0 for padding.
    """

    def scaled(x: Array, window: Windows) -> Float[Array, "horizons 4 3"]:
        predicted = predict(with_parameters(vehicle, names, list(x)), window.start, window.command, motors)
        return jax.vmap(residuals)(predicted, window.logged) / scale[:, :, None]

    def of_window(window: Windows, mask: Array):
        r = scaled(x, window)
        jacobian = jax.vmap(lambda e: jax.jvp(lambda x: scaled(x, window), (x,), (e,))[1])(jnp.eye(len(x)))
        square = jnp.mean(r * r)
        weight = mask / (1 + square / _CAUCHY_SCALE_SQUARED)
        flat, r = jacobian.reshape(len(x), -1), r.reshape(-1)
        return flat, weight, r, mask * len(r) * _CAUCHY_SCALE_SQUARED * jnp.log1p(square / _CAUCHY_SCALE_SQUARED)

    jacobian, weight, r, loss = jax.vmap(of_window)(windows, mask)
    matrix = jnp.einsum("pik,pjk,p->ij", jacobian, jacobian, weight)
    gradients = jnp.einsum("pik,pk,p->pi", jacobian, r, weight)
    squares = jnp.where(mask[:, None] > 0, r * r, jnp.nan)
    median = jnp.nanmedian(squares, axis=0).reshape(len(HORIZONS), 4, 3)
    robust = scale * jnp.sqrt(jnp.mean(median, axis=-1) / _MEDIAN_SQUARE)
    return Normal(matrix, jnp.sum(gradients, axis=0), jnp.sum(loss), robust, spread(gradients, _CORRELATED_WINDOWS))


def spread(gradients: Float[Array, "k n"], lags: int) -> Float[Array, "n n"]:
    """Covariance of the sum of k successive gradients that are correlated over some lags (Newey and West 1987)."""
    k = len(gradients)
    lagged = [(1 - i / (lags + 1)) * gradients[i:].T @ gradients[: k - i] for i in range(min(lags + 1, k))]
    return lagged[0] + sum(x + x.T for x in lagged[1:])


def standard_errors(information: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Standard errors of parameters from their information matrix (n, n) and the covariance of their gradient (n, n).

    They are the larger ones of those for independent and for correlated residuals, and infinite where rounding leaves
    no positive variance, as the matrix is nearly singular.
    """
    inverse = np.linalg.inv(information)
    variance = np.diag(inverse)
    return np.sqrt(np.where(variance > 0, np.maximum(variance, np.diag(inverse @ spread @ inverse)), np.inf))
