"""Policies from the weights of a multilayer perceptron of another library."""

import itertools
from collections.abc import Sequence
from typing import Annotated

import jax.numpy as jnp
from jaxtyping import ArrayLike

from jaxdrones.arguments import Switch, checked, choice
from jaxdrones.checks import check_shape
from jaxdrones.errors import UserError
from jaxdrones.learning.layers import ACTIVATIONS, OUTPUT_SCALE
from jaxdrones.learning.networks import MLP, Policy
from jaxdrones.learning.normalize import RunningStatistics

_UNIT = 2.0**20  # of observations without statistics, so that none is clipped; a power of two does not round
_COUNT = 2.0**40  # of observations in such statistics, more than any training adds


@checked
def mlp_policy(
    layers: Sequence[tuple[ArrayLike, ArrayLike]],
    *,
    activation: Annotated[str, choice("activation", ACTIVATIONS)] = "tanh",
    obs_stats: RunningStatistics | None = None,
    per_agent: Switch = False,
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

    Raises:
        ValueError: an unknown activation, or layers that do not follow each other.
    """
    weights = [(jnp.asarray(weight), jnp.asarray(bias)) for weight, bias in layers]
    if not weights:
        raise UserError("layers is empty; give the weight and the bias of each linear layer")
    sizes = [weights[0][0].shape[-1], *(bias.shape[-1] for _, bias in weights)]
    lead = ("drones",) if per_agent else ()
    for i, ((weight, _), (before, after)) in enumerate(zip(weights, itertools.pairwise(sizes), strict=True)):
        check_shape(f"weight {i} of layers", weight, (*lead, after, before), "outputs and inputs of the layer")
    if obs_stats is None:
        (first, bias), size = weights[0], sizes[0]
        weights[0] = first * _UNIT, bias
        obs_stats = RunningStatistics(jnp.zeros(size), jnp.full(size, _UNIT**2), jnp.full((), _COUNT))
    params = {
        f"Dense_{i}": {"kernel": jnp.swapaxes(weight, -1, -2), "bias": bias} for i, (weight, bias) in enumerate(weights)
    }
    _, *hidden, outputs = sizes
    network = MLP(tuple(hidden), outputs, OUTPUT_SCALE, activation)  # as that of settings, for `train --from`
    return Policy({"params": params}, obs_stats, network, per_agent)
