"""Gauss-Newton steps of Levenberg and Marquardt on a robust sum of squares over many pieces of many flights."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.dynamics import Motors
from jaxdrones.identification.open_loop import HORIZONS, Windows, predict, residuals
from jaxdrones.identification.parameters import with_parameters
from jaxdrones.identification.vehicle import Vehicle

_OUTLIER = 1.0  # mean square of the weighted residuals of a piece, beyond which it counts ever less (Cauchy)
_MEDIAN_SQUARE = 0.455  # of a standard normal number


class Normal(NamedTuple):
    """Normal equations of one flight, or of all."""

    matrix: np.ndarray
    """(n, n) Gauss-Newton matrix J'WJ."""
    gradient: np.ndarray
    """(n,) J'Wr."""
    loss: float
    spread: np.ndarray
    """(horizons, 4) robust standard deviation of the unweighted residuals, by horizon and quantity."""


@functools.partial(jax.jit, static_argnums=1)
def _normal(
    vehicle: Vehicle,
    names: tuple[str, ...],
    x: Array,
    spread: Array,
    pieces: Windows,
    counts: Array,
    motors: Motors | None,
):
    def weighted(x: Array, piece: Windows) -> Float[Array, "horizons 4 3"]:
        flown = predict(with_parameters(vehicle, names, list(x)), piece.start, piece.command, motors)
        return jax.vmap(residuals)(flown, piece.truth) / spread[:, :, None]

    def of_piece(piece: Windows, counts: Array):
        r = weighted(x, piece)
        jacobian = jax.vmap(lambda e: jax.jvp(lambda x: weighted(x, piece), (x,), (e,))[1])(jnp.eye(len(x)))
        square = jnp.mean(r * r)
        weight = counts / (1 + square / _OUTLIER)
        flat, r = jacobian.reshape(len(x), -1), r.reshape(-1)
        return flat, weight, r, counts * _OUTLIER * jnp.log1p(square / _OUTLIER)

    jacobian, weight, r, loss = jax.vmap(of_piece)(pieces, counts)
    matrix = jnp.einsum("pik,pjk,p->ij", jacobian, jacobian, weight)
    gradient = jnp.einsum("pik,pk,p->i", jacobian, r, weight)
    squares = jnp.where(counts[:, None] > 0, r * r, jnp.nan)
    median = jnp.nanmedian(squares, axis=0).reshape(len(HORIZONS), 4, 3)
    return matrix, gradient, jnp.sum(loss), spread * jnp.sqrt(jnp.mean(median, axis=-1) / _MEDIAN_SQUARE)


def normal_equations(
    vehicle: Vehicle,
    names: tuple[str, ...],
    x: np.ndarray,
    spread: np.ndarray,
    pieces: Windows,
    counts: Array,
    motors: Motors | None,
) -> Normal:
    """Normal equations of one flight.

    Args:
        vehicle: at x = 0.
        names: n parameters.
        x: (n,) where they are.
        spread: (horizons, 4) by which residuals are divided.
        pieces: of the flight.
        counts: (pieces,) 1 for a piece, 0 for one that only fills the array.
        motors: see `predict`.
    """
    matrix, gradient, loss, found = _normal(
        vehicle, names, jnp.asarray(x, float), jnp.asarray(spread, float), pieces, counts, motors
    )
    return Normal(np.asarray(matrix, float), np.asarray(gradient, float), float(loss), np.asarray(found, float))
