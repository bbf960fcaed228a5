"""Running mean and variance of observations."""

from collections.abc import Callable
from typing import Self

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdrones.arguments import Scalar
from jaxdrones.envs.env import Obs
from jaxdrones.pytree import PyTreeNode

CLIP = 10.0  # standard deviations
_MIN_STD = 1e-2  # lower bound against amplification of constant entries


class RunningStatistics(PyTreeNode):
    """Running mean and variance of observation vectors."""

    mean: Array
    """(d,)"""
    var: Array
    """(d,)"""
    count: Array
    """() number of vectors."""

    @classmethod
    def empty(cls, size: int) -> Self:
        """Statistics before the first vector: mean 0 and variance 1, replaced by the first vectors."""
        return cls(jnp.zeros(size), jnp.ones(size), jnp.zeros(()))

    @classmethod
    def of(cls, obs: Float[Array, "*batch d"], where: Bool[Array, "*batch"] | None = None) -> Self:
        """Statistics of the vectors along the last axis, optionally with a mask."""
        batch_axes = tuple(range(obs.ndim - 1))
        counts = jnp.ones((1,) * obs.ndim, bool) if where is None else where[..., None]
        count = jnp.sum(jnp.broadcast_to(counts, (*obs.shape[:-1], 1)), dtype=obs.dtype)
        mean = jnp.sum(obs, axis=batch_axes, keepdims=True, where=counts) / jnp.maximum(count, 1)
        var = jnp.sum((obs - mean) ** 2, axis=batch_axes, where=counts) / jnp.maximum(count, 1)
        return cls(mean.reshape(-1), var, count)

    def update(
        self, obs: Float[Array, "*batch d"], window: Scalar = jnp.inf, where: Bool[Array, "*batch"] | None = None
    ) -> Self:
        """Update the statistics with the vectors `where` a mask holds, by default all (Chan et al. 1983).

        `window` limits the weight of the old vectors, as a number of vectors, so that early ones are forgotten.
        """
        new = self.of(obs, where)
        old_count = jnp.minimum(self.count, window)
        count = jnp.maximum(old_count + new.count, 1)
        shift = new.mean - self.mean
        var = (old_count * self.var + new.count * new.var) / count + shift**2 * (old_count * new.count / count**2)
        return type(self)(self.mean + shift * (new.count / count), var, old_count + new.count)

    @property
    def scale(self) -> Array:
        """(d,) reciprocal of the standard deviation."""
        return 1 / jnp.maximum(jnp.sqrt(self.var), _MIN_STD)

    def normalize(self, obs: Float[Array, "*batch d"]) -> Array:
        """Observations in standard deviations from the mean, clipped at ten."""
        shape = (1,) * (obs.ndim - 1) + self.mean.shape
        return jnp.clip((obs - self.mean.reshape(shape)) * self.scale.reshape(shape), -CLIP, CLIP)


def state_vector(obs: Obs) -> Float[Array, "*batch d"]:
    """Observation without its images."""
    return obs["state"] if isinstance(obs, dict) else obs


def map_state_vector(function: Callable[[Array], Array], obs: Obs) -> Obs:
    """Apply a function to the vector of an observation; images are unchanged."""
    return obs | {"state": function(obs["state"])} if isinstance(obs, dict) else function(obs)
