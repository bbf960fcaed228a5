"""Backpropagation through time against past policies: self-play in a league (as in AlphaStar, Vinyals et al. 2019).

The first drone of every team learns; the others are flown by past policies of the same training, whose parameters are
part of the training state. So a whole training is one compiled program.
"""

import dataclasses
import functools
from typing import Any, Self

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones.arguments import Count, checked
from jaxdrones.envs import Env
from jaxdrones.errors import UserError
from jaxdrones.learning import bptt, collect, result
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.normalize import state_vector


@checked
@dataclasses.dataclass(frozen=True)
class Config(bptt.Config):
    """Settings; numbers that are not shapes may be traced, so that `vmap` trains with many values at once."""

    past_policies: Count = 4
    """Number of past policies; each flies the opponents in an equal share of the worlds."""
    snapshot_interval: Count = 50
    """Updates after which the oldest past policy is replaced by the present one."""

    def __post_init__(self):
        if self.worlds % self.past_policies:
            raise UserError(f"worlds is {self.worlds}; give a multiple of past_policies, {self.past_policies}")
        if self.per_agent or self.recurrent_size:
            raise UserError("a league has one policy for all drones, without a hidden state; remove per_agent and GRU")


class TrainState(result.TrainState):
    """Complete state of a training."""

    past: Policy
    """Past policies, (k, ...)."""

    def with_policy(self, policy: Policy) -> Self:
        """State before the first update of a training that starts from a policy, which is also all past policies."""
        past = jax.tree.map(lambda old, x: jnp.broadcast_to(x, old.shape), self.past, policy)
        return self.replace(policy=policy, past=past)


def init(key: jax.Array, env: Env, config: Config, network: Any = None) -> TrainState:
    """State before the first update; all past policies are the initial one."""
    state = bptt.init(key, env, config, network)
    if state.policy.is_recurrent:
        raise UserError("network is recurrent; give a league one without a hidden state")
    past = jax.tree.map(lambda x: jnp.broadcast_to(x, (config.past_policies, *jnp.shape(x))), state.policy)
    return TrainState(past=past, **vars(state))


def update(env: Env, config: Config, state: TrainState) -> tuple[TrainState, dict[str, Array]]:
    """Take a gradient step on the rewards of the first drones, and possibly keep the policy."""
    act = functools.partial(against, state.past)
    state, metrics = bptt.gradient_step(env, config, state, act=act, learning=slice(1))
    taken = state.step % config.snapshot_interval == 0
    slot = jnp.arange(config.past_policies) == state.step // config.snapshot_interval % config.past_policies

    def kept(past: Array, new: Array) -> Array:
        return jnp.where((taken & slot).reshape(-1, *[1] * new.ndim), new[None], past)

    return state.replace(past=jax.tree.map(kept, state.past, state.policy)), metrics


def against(past: Policy, policy: Policy) -> collect.Act:
    """Actions of the first drones by a policy, of the others by past ones, each in equally many worlds."""

    def act(policy: Policy, past: Policy, noise: Any, hidden_state: Any, obs: collect.Obs) -> tuple[Any, Array, Any]:
        count, worlds = len(jax.tree.leaves(past)[0]), len(state_vector(obs))
        if worlds % count:
            raise UserError(
                f"each device has {worlds} worlds; give a number of worlds that is a multiple of past_policies, "
                f"{count}, on every device"
            )

        def of_others(x: Array) -> Array:  # equally spaced worlds, so that a world has one policy on any device
            return x[:, 1:].reshape(len(x) // count, count, *x[:, 1:].shape[1:])

        own = policy(jax.tree.map(lambda x: x[:, :1], obs))
        if state_vector(obs).shape[1] == 1:
            return hidden_state, own, None
        of_past = jax.vmap(lambda policy, obs: policy(obs), in_axes=(0, 1), out_axes=1)
        others = of_past(past, jax.tree.map(of_others, obs))
        return hidden_state, jnp.concatenate([own, others.reshape(worlds, *others.shape[2:])], axis=1), None

    return jax.tree_util.Partial(act, policy, past)


train = result.make_train(Config, init, update)
