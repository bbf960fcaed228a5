"""What all learners share: the descent, the loop, and what training gives back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from jaxdrones.envs import Env
from jaxdrones.learning.networks import Policy

COMPILER_OPTIONS: dict[str, str | bool] = {"xla_cpu_use_fusion_emitters": False}
"""For `jax.jit(train).lower(key).compile(...)`: a third less time to compile on a CPU, and the same speed after."""


class Result(flax.struct.PyTreeNode):
    """A trained policy, and how it came about."""

    policy: Policy
    train_state: Any
    """To go on from."""
    history: dict[str, Array]
    """(updates,) of every metric of `update`."""


def scan_updates(update: Callable, env: Env, config: Any, state: Any) -> Result:
    """Make all updates of a learner, in one program."""
    state, history = jax.lax.scan(lambda state, _: update(env, config, state), state, length=config.updates)
    return Result(state.policy, state, history)


def descent(rate: float, steps: int, clip: float, last: float = 0.0, b2: float = 0.999) -> optax.GradientTransformation:
    """Adam on gradients of bounded norm, with a rate that falls along a cosine.

    All parameters are one vector, which compiles faster.

    Args:
        rate: at the start.
        steps: until the end.
        clip: largest norm of a gradient.
        last: rate in the end, as a share of that at the start.
        b2: how long Adam remembers the squares of gradients.
    """

    def falling(step):  # optax.cosine_decay_schedule, for a number of steps that may be traced
        return rate * (last + (1 - last) * 0.5 * (1 + jnp.cos(jnp.pi * jnp.minimum(step, steps) / steps)))

    return optax.flatten(optax.chain(bounded(clip), optax.adam(falling, b2=b2)))


def bounded(clip: float) -> optax.GradientTransformation:
    """Norm at most `clip`; a gradient that is not finite counts as zero, so that one wild flight ruins nothing."""

    def update(gradient, state, params=None):
        norm = optax.tree.norm(gradient)
        finite = jnp.isfinite(norm)
        scale = jnp.where(finite, jnp.minimum(1, clip / jnp.where(norm > 0, norm, 1)), 0)
        return jax.tree.map(lambda g: jnp.where(finite, g, 0) * scale.astype(g.dtype), gradient), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), update)
