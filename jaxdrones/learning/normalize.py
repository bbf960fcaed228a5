"""Running mean and variance of observations."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.envs.env import Obs
from jaxdrones.learning.settings import Scalar
from jaxdrones.pytree import PyTreeNode

_CLIP = 10.0  # standard deviations
_MIN_STD = 1e-2  # so that an entry that hardly changes is not amplified


class RunningStatistics(PyTreeNode):
    """Mean and variance of all observation vectors seen so far."""

    mean: Array
    """(d,)"""
    var: Array
    """(d,)"""
    count: Array
    """() number of vectors."""

    @classmethod
    def empty(cls, size: int) -> RunningStatistics:
        """Statistics before the first vector: mean 0 and variance 1, which the first vectors replace."""
        return cls(jnp.zeros(size), jnp.ones(size), jnp.zeros(()))

    @classmethod
    def of(cls, obs: Float[Array, "*batch d"]) -> RunningStatistics:
        """Statistics of the vectors along the last axis."""
        batch_axes = tuple(range(obs.ndim - 1))
        mean = jnp.mean(obs, axis=batch_axes, keepdims=True)
        var = jnp.mean((obs - mean) ** 2, axis=batch_axes)
        return cls(mean.reshape(-1), var, jnp.asarray(obs.size // obs.shape[-1], obs.dtype))

    def update(self, obs: Float[Array, "*batch d"], window: Scalar = jnp.inf) -> RunningStatistics:
        """Statistics of the old and the new vectors together (Chan et al. 1983).

        Args:
            obs: new vectors along the last axis.
            window: the old vectors weigh at most as much as this number of vectors, so that early ones are forgotten.
        """
        new = RunningStatistics.of(obs)
        old_count = jnp.minimum(self.count, window)
        count = old_count + new.count
        shift = new.mean - self.mean
        var = (old_count * self.var + new.count * new.var) / count + shift**2 * (old_count * new.count / count**2)
        return RunningStatistics(self.mean + shift * (new.count / count), var, count)

    def normalize(self, obs: Float[Array, "*batch d"]) -> Array:
        """Observations in standard deviations from the mean, clipped at ten."""
        scale = 1 / jnp.maximum(jnp.sqrt(self.var), _MIN_STD)
        shape = (1,) * (obs.ndim - 1) + self.mean.shape
        return jnp.clip((obs - self.mean.reshape(shape)) * scale.reshape(shape), -_CLIP, _CLIP)


def state_vector(obs: Obs) -> Float[Array, "*batch d"]:
    """The observation without its images."""
    return obs["state"] if isinstance(obs, dict) else obs


def map_state_vector(function: Callable[[Array], Array], obs: Obs) -> Obs:
    """The observation with a function applied to its vector; images stay as they are."""
    return obs | {"state": function(obs["state"])} if isinstance(obs, dict) else function(obs)
