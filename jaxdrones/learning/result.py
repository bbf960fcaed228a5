"""What all learners share: optimizers, the loop over updates, and the result of training."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Int

from jaxdrones.checks import is_known
from jaxdrones.envs import Env
from jaxdrones.learning import compilation
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.settings import Scalar
from jaxdrones.pytree import PyTreeNode

PATIENCE = 10
"""Training has diverged when gradients were not finite in so many updates in a row, or in all of fewer updates."""

_RATE_FACTOR = 1.2  # by which the learning rate is raised or lowered


class Diverged(RuntimeError):
    """Training has diverged: its numbers or its gradients are not finite."""


class Result(PyTreeNode):
    """A trained policy, and how the training went."""

    policy: Policy
    train_state: Any
    """State to continue the training from."""
    history: dict[str, Array]
    """(updates,) every metric of `update`. `nonfinite_gradients` counts the gradients of an update that were not finite
    and were replaced by zero."""

    def __repr__(self) -> str:
        return f"<Result: {self.policy!r}, history of {', '.join(self.history)}>"


def run_training(init: Callable, update: Callable, key: jax.Array, env: Env, config: Any) -> Result:
    """Make all updates of a learner in one compiled program.

    Inside a function that JAX traces, or with traced settings, the updates become part of that function. Otherwise the
    program is compiled here, and kept for further calls with equal settings and the same environment, as long as none
    of its attributes is set.

    Args:
        init: the learner's `init(key, env, config)`.
        update: the learner's `update(env, config, state)`.
        key: random key.
        env: environment.
        config: settings of the learner.

    Raises:
        Diverged: gradients were not finite in `PATIENCE` updates in a row. While JAX traces, nothing can be raised;
            then `history["nonfinite_gradients"]` alone tells.
    """
    if compilation.is_tracing() or not all(map(is_known, (key, *vars(config).values()))):
        return _all_updates(init, update, env, config, key)
    result = training_program(init, update, env, config)(key)
    counts = result.history["nonfinite_gradients"]
    if is_known(counts):  # not so when an environment with traced parameters is mapped
        check_gradients(np.asarray(counts), min(PATIENCE, len(counts)))
    return result


def training_program(init: Callable, update: Callable, env: Env, config: Any) -> Any:
    """The compiled function of a random key that makes all updates, with the compiler options that suit training."""
    static = compilation.Static(env)
    try:
        return _cached_program(init, update, static, config)
    except TypeError:  # settings that cannot be hashed, such as arrays
        return _program(init, update, static, config)


def _program(init: Callable, update: Callable, env: compilation.Static, config: Any) -> Any:
    return compilation.jit(functools.partial(_all_updates, init, update, env.value, config))


_cached_program = functools.lru_cache(maxsize=8)(_program)


def _all_updates(init: Callable, update: Callable, env: Env, config: Any, key: jax.Array) -> Result:
    state, history = jax.lax.scan(
        lambda state, _: update(env, config, state), init(key, env, config), length=config.updates
    )
    return Result(state.policy, state, history)


def check_gradients(nonfinite: Sequence[int] | np.ndarray, patience: int = PATIENCE, before: int = 0) -> int:
    """Raise if gradients were not finite in too many updates in a row.

    Args:
        nonfinite: (updates,) for each update, zero if all its gradients were finite.
        patience: number of updates in a row with gradients that were not finite at which to raise.
        before: number of such updates in a row just before these.

    Returns:
        The number of such updates in a row, up to the last of these updates.

    Raises:
        Diverged: says in how many updates in a row.
    """
    streak = before
    for count in nonfinite:
        streak = streak + 1 if count else 0
        if streak >= patience:
            raise Diverged(f"gradients were not finite in {streak} updates in a row; try a smaller learning rate")
    return streak


def cosine_adam(
    learning_rate: Scalar, steps: Scalar, max_grad_norm: Scalar, adam_b2: Scalar = 0.999
) -> optax.GradientTransformation:
    """Adam with clipped gradients and a learning rate that falls to zero along a cosine.

    All parameters are flattened to one vector, which compiles faster.

    Args:
        learning_rate: learning rate at the start.
        steps: number of steps until the learning rate is zero.
        max_grad_norm: largest norm of a gradient; see `clip_gradient`.
        adam_b2: decay rate of Adam's mean of squared gradients.
    """

    def schedule(step):  # optax.cosine_decay_schedule, for a number of steps that may be traced
        return learning_rate * (0.5 * (1 + jnp.cos(jnp.pi * jnp.minimum(step, steps) / steps)))

    return optax.flatten(optax.chain(clip_gradient(max_grad_norm), optax.adam(schedule, b2=adam_b2)))


def adapted_learning_rate(config: Any, updates: Scalar, learning_rate: Scalar, kl: Scalar) -> Array:
    """The learning rate after an update, with PPO's adaptation to the divergence from the policy that acted.

    Args:
        config: settings, of which `target_kl` and those of the learning rate count.
        updates: updates made, this one included.
        learning_rate: learning rate of this update.
        kl: divergence of the updated policy from the one that acted in this update.
    """
    raised = jnp.where(kl < config.target_kl / 2, _RATE_FACTOR, 1)
    factor = jnp.where(kl > 2 * config.target_kl, 1 / _RATE_FACTOR, raised)
    high = annealed(config, updates, config.max_learning_rate, config.min_learning_rate)
    return jnp.clip(learning_rate * factor, config.min_learning_rate, high)


def annealed(config: Any, updates: Scalar, high: Scalar, low: Scalar) -> Array:
    """`high` until the last updates, in which it falls to `low` by the same factor in each."""
    remaining = jnp.clip((1 - updates / config.updates) / jnp.maximum(config.anneal_fraction, 1e-6), 0, 1)
    return low * (high / low) ** remaining


def clip_gradient(max_grad_norm: Scalar) -> optax.GradientTransformation:
    """Scale gradients down to a norm of at most `max_grad_norm`.

    A gradient whose norm is not finite is replaced by zero, so that a single one does not ruin the parameters; learners
    count these with `count_nonfinite`.
    """

    def update(gradient, state, params=None):
        norm = optax.tree.norm(gradient)
        finite = jnp.isfinite(norm)
        scale = jnp.where(finite, jnp.minimum(1, max_grad_norm / jnp.where(norm > 0, norm, 1)), 0)
        return jax.tree.map(lambda g: jnp.where(finite, g, 0) * scale.astype(g.dtype), gradient), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), update)


def count_nonfinite(norm: Array) -> Int[Array, ""]:
    """The number of gradients whose norm is not finite."""
    return jnp.sum(~jnp.isfinite(norm))
