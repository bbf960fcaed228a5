"""Gaussian exploration."""

import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.envs.env import Obs
from jaxdrones.learning.networks import Policy

HALF_LOG_2_PI = math.log(2 * math.pi) / 2


def explore(policy: Policy, log_std: Array, noise: Array, hidden_state: Any, obs: Obs) -> tuple[Any, Array, Array]:
    """Actions around those of a policy in many worlds, for `collect.collect`.

    `log_std` (a,) or (n, a) is the logarithm of the standard deviation of actions, and the noise (w, n, a) is standard
    normal. The hidden state is the one before the observations; these are (w, n, d), or a
    dictionary with images.

    Returns:
        The hidden state after the observations, the actions (w, n, a), and their log probability density (w, n).
    """
    hidden_state, mean = policy.act(hidden_state, obs)
    action = sample(noise, mean, log_std)
    return hidden_state, action, log_prob(action, mean, log_std)


def sample(noise: Float[Array, "*batch n a"], mean: Float[Array, "*batch n a"], log_std: Array) -> Array:
    """Normally distributed actions (*batch, n, a) for standard normal noise."""
    return mean + jnp.broadcast_to(jnp.exp(log_std), mean.shape) * noise


def log_prob(action: Float[Array, "*batch n a"], mean: Array, log_std: Array) -> Float[Array, "*batch n"]:
    """Log probability density of normally distributed actions."""
    log_std = jnp.broadcast_to(log_std, mean.shape)
    terms = -(((action - mean) * jnp.exp(-log_std)) ** 2) / 2 - log_std - HALF_LOG_2_PI
    return jnp.sum(terms, axis=-1)
