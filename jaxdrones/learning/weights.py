"""Policies from the weights of a multilayer perceptron of another library."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import ArrayLike

from jaxdrones.learning.networks import MLP, Policy
from jaxdrones.learning.normalize import RunningStatistics


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
        obs_stats: statistics for the normalization of observations; by default none.
        per_agent: whether every drone has its own network.
    """
    weights = [(jnp.asarray(weight), jnp.asarray(bias)) for weight, bias in layers]
    params = {
        f"Dense_{i}": {"kernel": jnp.swapaxes(weight, -1, -2), "bias": bias} for i, (weight, bias) in enumerate(weights)
    }
    *hidden, outputs = (bias.shape[-1] for _, bias in weights)
    if obs_stats is None:
        obs_stats = RunningStatistics.empty(weights[0][0].shape[-1])
    return Policy({"params": params}, obs_stats, MLP(tuple(hidden), outputs, activation=activation), per_agent)
