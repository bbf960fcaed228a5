"""What the value functions of the learners know.

A critic is an MLP, with a CNN of its own where there are images. It has no memory of its own, but takes that of a
recurrent policy: the memory sums up what was observed so far, and the critic learns from single control steps, in any
order.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.envs import Env
from jaxdrones.envs.env import Obs
from jaxdrones.envs.privileged import PrivilegedObservation
from jaxdrones.learning.networks import MLP, Network, Policy, apply, example_observation, make_network
from jaxdrones.learning.normalize import map_state_vector
from jaxdrones.learning.settings import Scalar


def critic_network(critic_obs: Obs, hidden_sizes: Sequence[int]) -> MLP | Network:
    """The network of a critic that takes such observations."""
    return make_network(critic_obs, hidden_sizes, 1, output_scale=0.01)


def discounted_value(
    params: Any, critic_obs: Obs, hidden_sizes: Sequence[int], gamma: Scalar, per_agent: bool = False
) -> Float[Array, "*batch n"]:
    """The discounted sum of future rewards; the network's output is that sum times one minus `gamma`."""
    return apply(critic_network(critic_obs, hidden_sizes), params, critic_obs, per_agent)[1][..., 0] / (1 - gamma)


def critic_example(env: Env, policy: Policy, privileged: bool = False, centralized: bool = False) -> Obs:
    """An observation of the critic of one drone, all zero.

    Args:
        env: environment.
        policy: policy that the critic judges.
        privileged: whether the critic takes privileged observations.
        centralized: whether it takes all drones' observations and the others' actions.
    """
    n, size = env.drones, env.observation_size + (env.privileged_size if privileged else 0)
    size = (n * size + (n - 1) * env.action_size if centralized else size) + policy.recurrent_size
    return map_state_vector(lambda _: jnp.zeros(size), example_observation(env))


def critic_observation(
    policy: Policy,
    obs: Obs,
    memory: Array | None,
    privileged: PrivilegedObservation | None = None,
    action: Array | None = None,
) -> Obs:
    """Observations of the critic, normalized.

    Args:
        policy: policy that the critic judges.
        obs: (*batch, n, d) what the policy observes, or a dictionary with images.
        memory: (*batch, n, m) memory of the policy after `obs`; `None` without one.
        privileged: privileged observation, which takes the place of the vector of `obs`.
        action: (*batch, n, a) actions of all drones for a centralized critic, which takes all drones' observations and
            the others' actions; `None` for one that takes a drone's own observation.
    """
    if privileged is not None:
        obs = map_state_vector(lambda _: privileged.obs, obs)
    obs = map_state_vector(policy.obs_stats.normalize, obs)
    if privileged is not None:
        obs = map_state_vector(lambda x: jnp.concatenate([x, privileged.params], axis=-1), obs)
    if action is not None:
        obs = map_state_vector(lambda x: centralized_input(x, action), obs)
    if memory is not None:
        obs = map_state_vector(lambda x: jnp.concatenate([x, memory], axis=-1), obs)
    return obs


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
