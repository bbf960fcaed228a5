"""Policies with a memory, and how to fly these, policies without one and plain functions alike."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Float

from jaxdrones.envs.env import Obs


@runtime_checkable
class RecurrentPolicy(Protocol):
    """What a policy with a memory defines; a memory is an array or a pytree, and `None` where there is none."""

    def initial_memory(self, batch: tuple[int, ...]) -> Any:
        """The memory at the start of an episode; `batch` is (drones,) for one team."""

    def act(self, memory: Any, obs: Obs) -> tuple[Any, Float[Array, "*batch n a"]]:
        """The memory after the observations, and actions."""


AnyPolicy = RecurrentPolicy | Callable[[Obs], Array]
"""A policy with a memory, or any function from observations (n, d), or a dictionary with images, to actions (n, a)."""


def initial_memory(policy: AnyPolicy, drones: int) -> Any:
    """The memory of a team's policy at the start of an episode; `None` for a plain function."""
    return policy.initial_memory((drones,)) if isinstance(policy, RecurrentPolicy) else None


def act(policy: AnyPolicy, memory: Any, obs: Obs) -> tuple[Any, Float[Array, "n a"]]:
    """The memory after the observations, and actions."""
    return policy.act(memory, obs) if isinstance(policy, RecurrentPolicy) else (memory, policy(obs))
