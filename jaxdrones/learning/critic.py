"""Critic inputs and networks.

A critic is an MLP, with a CNN for images. It has no hidden state of its own and takes that of a recurrent policy as an
input, so it learns from single control steps in any order.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.envs import Env
from jaxdrones.envs.env import Obs
from jaxdrones.envs.observations import PrivilegedObservation
from jaxdrones.learning.layers import make_network
from jaxdrones.learning.networks import Policy, apply, example_observation, init_params
from jaxdrones.learning.normalize import map_state_vector, state_vector


def init_critic(key: jax.Array, env: Env, policy: Policy, config: Any) -> Any:
    """Parameters of the critic of a policy."""
    centralized = getattr(config, "centralized_critic", False)
    n, size = env.drones, env.observation_size + (env.privileged_size if config.privileged_critic else 0)
    size = n * size + (n - 1) * env.action_size if centralized else size
    size += sum(x.size for x in jax.tree.leaves(policy.initial_hidden_state((1,))))
    example = map_state_vector(lambda _: jnp.zeros(size), example_observation(env))
    network = make_network(example, config.critic_hidden_sizes, 1, 0.01)
    return init_params(key, network, example, n if config.per_agent else None)


def discounted_value(config: Any, params: Any, critic_obs: Obs) -> Float[Array, "*batch n"]:
    """Discounted sum of future rewards; the network's output is that sum times one minus `gamma`."""
    network = make_network(critic_obs, config.critic_hidden_sizes, 1, 0.01)
    return apply(network, params, critic_obs, config.per_agent)[1][..., 0] / (1 - config.gamma)


def critic_observation(
    policy: Policy,
    obs: Obs,
    hidden_state: Any,
    privileged: PrivilegedObservation | None = None,
    action: Array | None = None,
) -> Obs:
    """Observations of the critic, normalized; deviations of parameters beyond 1 by their logarithm.

    The hidden state (*batch, n, ...) is that after the observations, (*batch, n, d) or a dictionary with images. A
    privileged observation replaces the vector of the observations. The actions (*batch, n, a) of all drones are inputs
    of a centralized critic, see `centralized_input`.
    """
    vector = state_vector(obs) if privileged is None else privileged.obs
    x = policy.obs_stats.normalize(vector)
    if privileged is not None:
        x = jnp.concatenate([x, _compressed(privileged.params)], axis=-1)
    if action is not None:
        x = centralized_input(x, action)
    states = [s.reshape(*x.shape[:-1], -1) for s in jax.tree.leaves(hidden_state)]
    x = jnp.concatenate([x, *states], axis=-1) if states else x
    return map_state_vector(lambda _: x, obs)


def _compressed(deviation: Array) -> Array:
    """Relative deviation up to 1, beyond it 1 plus its logarithm: the parameters of any vehicle reach 1,000."""
    size = jnp.abs(deviation)
    return jnp.where(size > 1, jnp.sign(deviation) * (1 + jnp.log(jnp.maximum(size, 1))), deviation)


def centralized_input(
    obs: Float[Array, "*batch n d"], action: Float[Array, "*batch n a"]
) -> Float[Array, "*batch n e"]:
    """Input of a centralized critic for each drone: all observations, its own first, then the others' actions.

    For two drones of the leader-follower task (2021) these are 12 + 12 + 1 = 25 numbers.
    """
    n = obs.shape[-2]
    own_first = [jnp.roll(obs, -i, axis=-2).reshape(*obs.shape[:-2], -1) for i in range(n)]
    others = [jnp.roll(action, -i, axis=-2)[..., 1:, :].reshape(*action.shape[:-2], -1) for i in range(n)]
    return jnp.concatenate([jnp.stack(own_first, axis=-2), jnp.stack(others, axis=-2)], axis=-1)
