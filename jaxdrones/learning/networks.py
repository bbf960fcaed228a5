"""Policies and value functions: networks of normalized observations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.checks import check_choice, is_known
from jaxdrones.envs import Env
from jaxdrones.envs.env import Obs
from jaxdrones.errors import UserError
from jaxdrones.learning.layers import CNN, GRU, IMAGE_CHANNELS, MLP, convolutions, image_channels
from jaxdrones.learning.normalize import RunningStatistics, map_state_vector, state_vector
from jaxdrones.pytree import PyTreeNode


class Network(nn.Module):
    """An MLP of the vector of an observation, of features that a CNN extracts from its images, and of a GRU's memory.

    An observation without images needs no CNN; `recurrent_size` 0 means no GRU. What the GRU sees, the MLP sees too.
    """

    hidden_sizes: Sequence[int]
    output_size: int
    output_scale: float = 1.0
    activation: str = "tanh"
    channels: Sequence[int] = ()
    strides: Sequence[int] = ()
    features: int = 64
    depth_scale: float = 3.0
    """Depth that the network takes for a nearness of 1/2, m; of 0.3, 5 and 10 m it makes 0.91, 0.38 and 0.23."""
    recurrent_size: int = 0

    @nn.compact
    def __call__(
        self, obs: Obs, memory: Array | None = None, starts: Array | None = None
    ) -> tuple[Array | None, Array]:
        """The memory after the observations, and outputs (*batch, output_size); see `GRU` for the arguments."""
        x = obs
        if isinstance(obs, dict):
            images = image_channels({name: x for name, x in obs.items() if name != "state"}, self.depth_scale)
            features = CNN(self.channels, self.strides, self.features)(images)
            x = jnp.concatenate([obs["state"], features], axis=-1)
        if self.recurrent_size:
            memory = GRU(self.recurrent_size)(x, memory, starts)
            x = jnp.concatenate([x, memory], axis=-1)
        return memory, MLP(self.hidden_sizes, self.output_size, self.output_scale, self.activation)(x)


def make_network(
    obs: Obs, hidden_sizes: Sequence[int], output_size: int, output_scale: float, recurrent_size: int = 0
) -> MLP | Network:
    """A network of the kind that such observations need, with a CNN that suits the resolution of images.

    Args:
        obs: observations (*batch, d), or a dictionary of such an array and of images.
        hidden_sizes: sizes of the hidden layers.
        output_size: number of outputs.
        output_scale: scale of the initial outputs.
        recurrent_size: size of the GRU's memory; 0 for a network without one.

    Raises:
        ValueError: the observations have images that no network takes.
    """
    if isinstance(obs, dict):
        names = sorted(obs.keys() - {"state"})
        for name in names:
            check_choice("image for a policy", name, IMAGE_CHANNELS)
        batch = obs["state"].ndim - 1
        channels, strides = convolutions(*obs[names[0]].shape[batch : batch + 2])
    elif recurrent_size:
        channels, strides = (), ()
    else:
        return MLP(tuple(hidden_sizes), output_size, output_scale)
    return Network(
        tuple(hidden_sizes),
        output_size,
        output_scale,
        channels=channels,
        strides=strides,
        recurrent_size=recurrent_size,
    )


class Policy(PyTreeNode):
    """A function from a team's observations to its actions; a pytree, which can be saved, mapped and differentiated.

    A recurrent policy also has a memory, see `learning.recurrence`; a policy without one can be called.
    """

    params: Any
    """Parameters of the network; with `per_agent` one set for each drone, along a leading axis."""
    obs_stats: RunningStatistics
    """Statistics that normalize the observations."""
    network: MLP | Network = flax.struct.field(pytree_node=False)
    per_agent: bool = flax.struct.field(pytree_node=False, default=False)

    @classmethod
    def init(
        cls,
        key: jax.Array,
        env: Env,
        hidden_sizes: Sequence[int],
        per_agent: bool = False,
        recurrent_size: int = 0,
    ) -> Policy:
        """A policy whose actions are nearly zero, with which drones hover in most action types.

        Args:
            key: random key.
            env: environment that the policy is for.
            hidden_sizes: sizes of the hidden layers.
            per_agent: whether every drone has a network of its own; otherwise all drones share one.
            recurrent_size: size of the memory of each drone; 0 for a policy without one.
        """
        obs = example_observation(env)
        network = make_network(obs, hidden_sizes, env.action_size, 0.01, recurrent_size)
        params = init_params(key, network, obs, env.drones if per_agent else None)
        return cls(params, RunningStatistics.empty(env.observation_size), network, per_agent)

    def __repr__(self) -> str:
        layers = (*np.shape(self.obs_stats.mean)[-1:], *self.network.hidden_sizes, self.network.output_size)
        numbers = sum(math.prod(np.shape(x)) for x in jax.tree.leaves(self.params))
        count = self.obs_stats.count
        known = isinstance(count, jax.Array | np.ndarray) and is_known(count) and count.ndim == 0
        counted = f", statistics of {float(count):,.0f} observations" if known else ""
        channels = self.network.channels if isinstance(self.network, Network) else ()
        images = f" and images by {channels}" if channels else ""
        memory = f", a memory of {self.recurrent_size}" if self.recurrent_size else ""
        whose = ", one network per drone" if self.per_agent else ""
        return (
            f"<Policy {' -> '.join(map(str, layers))}{images}{memory}, {self.network.activation}, "
            f"{numbers:,} parameters{whose}{counted}>"
        )

    @property
    def recurrent_size(self) -> int:
        """Size of the memory of each drone; 0 for a policy without one."""
        return self.network.recurrent_size if isinstance(self.network, Network) else 0

    def initial_memory(self, batch: tuple[int, ...]) -> Array | None:
        """The memory (*batch, recurrent_size) at the start of an episode, zero; `None` for a policy without one.

        Args:
            batch: (drones,) for one team; the number of teams before it for many.
        """
        return jnp.zeros((*batch, self.recurrent_size)) if self.recurrent_size else None

    def act(self, memory: Array | None, obs: Obs) -> tuple[Array | None, Float[Array, "*batch n a"]]:
        """The memory (*batch, n, m) after the observations, and actions in (-1, 1).

        Args:
            memory: (*batch, n, m) memory before them.
            obs: observations (*batch, n, d), or a dictionary of such an array and of images.
        """
        x = map_state_vector(self.obs_stats.normalize, obs)
        memory, output = apply(self.network, self.params, x, self.per_agent, memory)
        return memory, jnp.tanh(output)

    def replay(self, memory: Array | None, obs: Obs, starts: Array | None) -> Float[Array, "t *batch n a"]:
        """The actions of a sequence of observations.

        Args:
            memory: (*batch, n, m) memory before the first of them.
            obs: (t, *batch, n, d) observations, or a dictionary.
            starts: (t, *batch) whether an episode starts with the observation; a policy without memory needs none.
        """
        x = map_state_vector(self.obs_stats.normalize, obs)
        starts = starts if self.recurrent_size else None
        return jnp.tanh(apply(self.network, self.params, x, self.per_agent, memory, starts)[1])

    def __call__(self, obs: Obs) -> Float[Array, "*batch n a"]:
        """Actions of a policy without memory, as of `act`.

        Raises:
            ValueError: the policy has a memory.
        """
        if self.recurrent_size:
            raise UserError(
                f"this policy has a memory of {self.recurrent_size} numbers per drone; call policy.act(memory, obs), "
                "at the start of an episode with policy.initial_memory((drones,))"
            )
        return self.act(None, obs)[1]


def example_observation(env: Env) -> Obs:
    """An observation of one drone, all zero."""
    obs, _ = jax.eval_shape(env.reset, jax.random.key(0))
    return jax.tree.map(lambda x: jnp.zeros(x.shape[1:], x.dtype), obs)


def init_params(key: jax.Array, network: MLP | Network, example: Obs, agents: int | None = None) -> Any:
    """Parameters of a network for inputs like the example; with `agents` one set for each, along a leading axis."""
    if agents is None:
        return network.init(key, example)
    return jax.vmap(network.init, in_axes=(0, None))(jax.random.split(key, agents), example)


def apply(
    network: MLP | Network,
    params: Any,
    x: Obs,
    per_agent: bool,
    memory: Array | None = None,
    starts: Array | None = None,
) -> tuple[Array | None, Array]:
    """Memory and outputs of the network that all drones share, or of the network of each drone; see `GRU`."""

    def of_network(params: Any, x: Obs, memory: Array | None) -> tuple[Array | None, Array]:
        if isinstance(network, MLP):
            return None, cast(Array, network.apply(params, x))
        return cast(tuple[Array | None, Array], network.apply(params, x, memory, starts))

    if not per_agent:
        return of_network(params, x, memory)
    axis = state_vector(x).ndim - 2
    memory_axis = axis if starts is None else axis - 1
    return jax.vmap(of_network, in_axes=(0, axis, memory_axis), out_axes=axis)(params, x, memory)
