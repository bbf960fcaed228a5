"""Running mean and variance of what is observed."""

from __future__ import annotations

from collections.abc import Callable

import flax.struct
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.envs.env import Obs

_LARGEST = 10.0  # standard deviations
_SMALLEST = 1e-2  # standard deviation; an entry that hardly moves is not blown up


class Statistics(flax.struct.PyTreeNode):
    """Of all vectors seen so far."""

    mean: Array
    """(d,)"""
    var: Array
    """(d,)"""
    count: Array
    """() vectors seen."""

    @classmethod
    def none(cls, size: int) -> Statistics:
        """Before anything was seen: mean 0, variance 1, which the first vectors replace."""
        return cls(jnp.zeros(size), jnp.ones(size), jnp.zeros(()))

    @classmethod
    def of(cls, obs: Float[Array, "*batch d"]) -> Statistics:
        """Of the vectors along the last axis."""
        vectors = tuple(range(obs.ndim - 1))
        mean = jnp.mean(obs, axis=vectors, keepdims=True)
        var = jnp.mean((obs - mean) ** 2, axis=vectors)
        return cls(mean.reshape(-1), var, jnp.asarray(obs.size // obs.shape[-1], obs.dtype))

    def update(self, obs: Float[Array, "*batch d"], memory: float = jnp.inf) -> Statistics:
        """With more vectors, joined as by Chan et al. (1983).

        Args:
            obs: new vectors along the last axis.
            memory: largest weight of the old ones, in vectors; so that early ones are forgotten.
        """
        new = Statistics.of(obs)
        old = jnp.minimum(self.count, memory)
        count = old + new.count
        step = new.mean - self.mean
        var = (old * self.var + new.count * new.var) / count + step**2 * (old * new.count / count**2)
        return Statistics(self.mean + step * (new.count / count), var, count)

    def normalize(self, obs: Float[Array, "*batch d"]) -> Array:
        """In standard deviations from the mean, cut at ten."""
        scale = 1 / jnp.maximum(jnp.sqrt(self.var), _SMALLEST)
        shape = (1,) * (obs.ndim - 1) + self.mean.shape
        return jnp.clip((obs - self.mean.reshape(shape)) * scale.reshape(shape), -_LARGEST, _LARGEST)


def vector(obs: Obs) -> Float[Array, "*batch d"]:
    """What of an observation is not an image."""
    return obs["state"] if isinstance(obs, dict) else obs


def on_vector(function: Callable[[Array], Array], obs: Obs) -> Obs:
    """The observation with a function of its vector in place of it; images stay as they are."""
    return obs | {"state": function(obs["state"])} if isinstance(obs, dict) else function(obs)
