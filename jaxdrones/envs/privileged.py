"""Privileged observations: what a critic may know in training, but no policy in flight."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode


class PrivilegedObservation(PyTreeNode):
    """Observation of a team that no sensor provides."""

    obs: Array
    """(n, d) the vector that would be observed without noise."""
    params: Array
    """(n, e) deviations of the drawn parameters from their nominal values, as shares of the largest nominal one."""


def deviations(params: Params, nominal: Params, drawn: Sequence[bool]) -> Float[Array, "n e"]:
    """Deviations of the drawn leaves of a team's parameters from their nominal values, side by side."""
    n = len(nominal.mass)
    leaves = zip(jax.tree.leaves(params), jax.tree.leaves(nominal), drawn, strict=True)
    columns = [jnp.reshape(_deviation(value, own), (n, -1)) for value, own, is_drawn in leaves if is_drawn]
    return jnp.concatenate([jnp.zeros((n, 0)), *columns], axis=-1)


def _deviation(value: Array, nominal: Array) -> Array:
    """As a share of the largest magnitude of the nominal value; where that is zero, the difference itself."""
    largest = jnp.max(jnp.abs(nominal))
    return (value - nominal) / jnp.where(largest > 0, largest, 1)
