"""What training gives back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
from jaxtyping import Array

from jaxdrones.envs import Env
from jaxdrones.learning.networks import Policy


class Result(flax.struct.PyTreeNode):
    """A trained policy, and how it came about."""

    policy: Policy
    train_state: Any
    """To go on from."""
    history: dict[str, Array]
    """(updates,) of every metric of `update`."""


def scan_updates(update: Callable, env: Env, config, state) -> Result:
    """Make all updates of a learner, in one program."""
    state, history = jax.lax.scan(lambda state, _: update(env, config, state), state, length=config.updates)
    return Result(state.policy, state, history)
