"""Policies: built-in and user-defined networks of normalized observations."""

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol, Self, cast, runtime_checkable

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.checks import is_concrete, short_repr
from jaxdrones.envs import Env
from jaxdrones.envs.env import Obs
from jaxdrones.errors import UserError
from jaxdrones.learning.layers import MLP, OUTPUT_SCALE, Network, make_network
from jaxdrones.learning.normalize import RunningStatistics, map_state_vector, state_vector
from jaxdrones.learning.own_network import OwnNetwork
from jaxdrones.pytree import PyTreeNode


@runtime_checkable
class RecurrentPolicy(Protocol):
    """Policy with a hidden state, an array or a pytree; `None` for a policy without one."""

    def initial_hidden_state(self, batch: tuple[int, ...]) -> Any:
        """Hidden state at the start of an episode; `batch` is (drones,) for one team."""

    def act(self, hidden_state: Any, obs: Obs) -> tuple[Any, Float[Array, "*batch n a"]]:
        """Hidden state after the observations, and actions."""


AnyPolicy = RecurrentPolicy | Callable[[Obs], Array]
"""Recurrent policy, or any function from observations (n, d), or a dictionary with images, to actions (n, a)."""


def check_callable(policy: Any) -> None:
    """Raise for what is neither a recurrent policy nor a function, such as the result of a training."""
    if not (isinstance(policy, RecurrentPolicy) or callable(policy)):
        raise UserError(f"policy is {short_repr(policy)}; give a policy, such as result.policy, or a function of obs")


def initial_hidden_state(policy: AnyPolicy, drones: int) -> Any:
    """Hidden state of a team's policy at the start of an episode; `None` for a plain function."""
    return policy.initial_hidden_state((drones,)) if isinstance(policy, RecurrentPolicy) else None


def act(policy: AnyPolicy, hidden_state: Any, obs: Obs) -> tuple[Any, Float[Array, "n a"]]:
    """Hidden state after the observations, and actions."""
    return policy.act(hidden_state, obs) if isinstance(policy, RecurrentPolicy) else (hidden_state, policy(obs))


class Policy(PyTreeNode):
    """Function from a team's observations to its actions; a pytree, which can be saved, mapped and differentiated.

    A recurrent policy has a hidden state, see `RecurrentPolicy`; other policies are callable.
    """

    params: Any
    """Parameters of the network; with `per_agent` one set per drone, along a leading axis."""
    obs_stats: RunningStatistics
    """Statistics for the normalization of observations."""
    network: MLP | Network | OwnNetwork = flax.struct.field(pytree_node=False)
    per_agent: bool = flax.struct.field(pytree_node=False, default=False)

    @classmethod
    def init(
        cls,
        key: jax.Array,
        env: Env,
        hidden_sizes: Sequence[int] = (32, 32),
        per_agent: bool = False,
        recurrent_size: int = 0,
        network: Any = None,
        set_sizes: Sequence[int] = (32, 32),
    ) -> Self:
        """Create a policy with actions near zero, which is hover in most action types.

        With `per_agent` every drone has its own network; otherwise all drones share one. `recurrent_size` is 0 without
        a GRU, and `set_sizes` are those of the layers that encode a row of a set in the observation. A user-defined
        network replaces these sizes, see `OwnNetwork`.

        Raises:
            ValueError: a network without parameters, or with the wrong output for the environment.
        """
        obs = example_observation(env)
        own = make_network(obs, hidden_sizes, env.action_size, OUTPUT_SCALE, recurrent_size, env.sets, set_sizes)
        network = own if network is None else OwnNetwork(network, env.action_size)
        params = init_params(key, network, obs, env.drones if per_agent else None)
        policy = cls(params, RunningStatistics.empty(env.observation_size), network, per_agent)
        if isinstance(network, OwnNetwork):
            team = jax.tree.map(lambda x: jnp.zeros((env.drones, *x.shape), x.dtype), obs)
            action = jax.eval_shape(policy.act, policy.initial_hidden_state((env.drones,)), team)[1]
            if action.shape != (env.drones, env.action_size):
                raise UserError(f"network has outputs {action.shape[1:]} for one drone; give ({env.action_size},)")
        return policy

    def __repr__(self) -> str:
        sizes = np.shape(self.obs_stats.mean)[-1:]
        if isinstance(self.network, OwnNetwork):
            layers = f"{sizes[0]} -> {type(self.network.module).__name__}"
        else:
            layers = " -> ".join(map(str, (*sizes, *self.network.hidden_sizes, self.network.output_size)))
            layers += f", {self.network.activation}"
        if isinstance(self.network, Network):
            layers += f", images by {self.network.channels}" if self.network.channels else ""
            layers += f", GRU of {self.network.recurrent_size}" if self.network.recurrent_size else ""
        numbers = sum(math.prod(np.shape(x)) for x in jax.tree.leaves(self.params))
        count = self.obs_stats.count
        known = isinstance(count, jax.Array | np.ndarray) and is_concrete(count) and count.ndim == 0
        counted = f", statistics of {float(count):,.0f} observations" if known else ""
        whose = ", one network per drone" if self.per_agent else ""
        return f"<Policy {layers}, {numbers:,} parameters{whose}{counted}>"

    def with_obs_stats(self, obs_stats: RunningStatistics) -> Self:
        """Policy with new statistics, except for the rows of sets, which are not normalized: their order is random."""
        for at, rows, size, _ in getattr(self.network, "sets", ()):
            columns = slice(at, at + rows * size)
            mean, var = obs_stats.mean.at[columns].set(0), obs_stats.var.at[columns].set(1)
            obs_stats = obs_stats.replace(mean=mean, var=var)
        return self.replace(obs_stats=obs_stats)

    @property
    def is_recurrent(self) -> bool:
        """Whether the policy has a hidden state."""
        own = isinstance(self.network, OwnNetwork)
        return self.network.recurrent if own else bool(getattr(self.network, "recurrent_size", 0))

    def initial_hidden_state(self, batch: tuple[int, ...]) -> Any:
        """Zero hidden state of (drones,) or (teams, drones) at the start of an episode; `None` without one."""
        if not self.is_recurrent:
            return None
        if isinstance(self.network, OwnNetwork):
            state = self.network.module.initial_hidden_state()
            return jax.tree.map(lambda x: jnp.zeros((*batch, *jnp.shape(x)), jnp.result_type(x)), state)
        return jnp.zeros((*batch, cast(Network, self.network).recurrent_size))

    def act(self, hidden_state: Any, obs: Obs) -> tuple[Any, Float[Array, "*batch n a"]]:
        """Hidden state (*batch, n, ...) after the observations, which may have images, and actions in (-1, 1)."""
        size, wanted = state_vector(obs).shape[-1], len(self.obs_stats.mean)
        if size != wanted:
            raise UserError(
                f"obs has {size} entries for each drone, and the policy takes {wanted}; give those of its task"
            )
        x = map_state_vector(self.obs_stats.normalize, obs)
        hidden_state, output = apply(self.network, self.params, x, self.per_agent, hidden_state)
        return hidden_state, jnp.tanh(output)

    def replay(self, hidden_state: Any, obs: Obs, starts: Array | None) -> Float[Array, "*batch a"]:
        """Actions of a sequence of normalized observations (t, *batch, n, d), or of a dictionary of them.

        The hidden state (*batch, n, ...) is that before the first observation; `starts` (t, *batch), whether an episode
        starts with an observation, is `None` without a hidden state. Without both, and without `per_agent`, any leading
        axes are possible.
        """
        return jnp.tanh(apply(self.network, self.params, obs, self.per_agent, hidden_state, starts)[1])

    def __call__(self, obs: Obs) -> Float[Array, "*batch n a"]:
        """Actions of a policy without a hidden state."""
        if self.is_recurrent:
            raise UserError(
                "the policy is recurrent; call policy.act(hidden_state, obs), at the start of an episode with "
                "policy.initial_hidden_state((drones,))"
            )
        return self.act(None, obs)[1]


def example_observation(env: Env) -> Obs:
    """Zero observation of one drone."""
    obs, _ = jax.eval_shape(env.reset, jax.random.key(0))
    return jax.tree.map(lambda x: jnp.zeros(x.shape[1:], x.dtype), obs)


def init_params(key: jax.Array, network: Any, example: Obs, agents: int | None = None) -> Any:
    """Initial parameters of a network; with `agents` one set each, along a leading axis."""
    if agents is None:
        return network.init(key, example)
    return jax.vmap(network.init, in_axes=(0, None), axis_size=agents)(jax.random.split(key, agents), example)


def apply(
    network: MLP | Network | OwnNetwork,
    params: Any,
    x: Obs,
    per_agent: bool,
    hidden_state: Any = None,
    starts: Array | None = None,
) -> tuple[Any, Array]:
    """Hidden states and outputs of the shared network, or of each drone's network."""

    def of_network(params: Any, x: Obs, hidden_state: Any) -> tuple[Any, Array]:
        if isinstance(network, MLP):
            return None, cast(Array, network.apply(params, x))
        return cast(tuple[Any, Array], network.apply(params, x, hidden_state, starts))

    if not per_agent:
        return of_network(params, x, hidden_state)
    axis = state_vector(x).ndim - 2
    state_axis = axis if starts is None else axis - 1
    in_axes, out_axes = (0, axis, state_axis), (axis, axis)
    return jax.vmap(of_network, in_axes=in_axes, out_axes=out_axes)(params, x, hidden_state)
