"""Steps that run on the host, outside of compiled programs."""

import abc
from typing import Any

import jax

from jaxdrones.params import Params
from jaxdrones.state import State


class HostStep(abc.ABC):
    """A `step(params, state, rpm) -> state` that leaves JAX.

    Compiled code reaches it through a callback; a rollout that is not itself compiled loops over it in Python.
    """

    @abc.abstractmethod
    def __call__(self, params: Params, state: State, rpm: jax.Array) -> State:
        """Advance a team."""

    @abc.abstractmethod
    def close(self) -> None:
        """Give back what the step holds; it cannot be called any more."""


def is_traced(tree: Any) -> bool:
    """Whether some array of a pytree is being traced, so that it has no value yet."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))
