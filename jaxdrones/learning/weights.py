"""Policies from the weights of a multilayer perceptron of another library."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import ArrayLike

from jaxdrones.learning.layers import OUTPUT_SCALE
from jaxdrones.learning.networks import MLP, Policy
from jaxdrones.learning.normalize import RunningStatistics

_UNIT = 2.0**20  # of observations without statistics, so that none is clipped; a power of two does not round
_COUNT = 2.0**40  # of observations in such statistics, more than any training adds


def mlp_policy(
    layers: Sequence[tuple[ArrayLike, ArrayLike]],
    *,
    activation: str = "tanh",
    obs_stats: RunningStatistics | None = None,
    per_agent: bool = False,
) -> Policy:
    """Policy with the weights of a multilayer perceptron and tanh outputs.

    `training.run.Run(folder).save_policy("best", policy, recipe=recipe.as_dict(), update=0)` saves it for
    `jaxdrones eval` and `jaxdrones fly --policy`.

    Args:
        layers: weight (out, in) and bias (out,) of each linear layer; with `per_agent` a leading axis over drones.
        activation: a name of `learning.layers.ACTIVATIONS`, between the layers.
        obs_stats: statistics for the normalization of observations, which are clipped at ten standard deviations. By
            default observations are not normalized, and not clipped: they are divided by 2^20 and the weights of the
            first layer multiplied by it, which does not round. To train such a policy further, give statistics: its
            first layer would hardly change.
        per_agent: whether every drone has its own network.
    """
    weights = [(jnp.asarray(weight), jnp.asarray(bias)) for weight, bias in layers]
    if obs_stats is None:
        (first, bias), size = weights[0], weights[0][0].shape[-1]
        weights[0] = first * _UNIT, bias
        obs_stats = RunningStatistics(jnp.zeros(size), jnp.full(size, _UNIT**2), jnp.full((), _COUNT))
    params = {
        f"Dense_{i}": {"kernel": jnp.swapaxes(weight, -1, -2), "bias": bias} for i, (weight, bias) in enumerate(weights)
    }
    *hidden, outputs = (bias.shape[-1] for _, bias in weights)
    network = MLP(tuple(hidden), outputs, OUTPUT_SCALE, activation)  # as that of settings, for `train --from`
    return Policy({"params": params}, obs_stats, network, per_agent)
