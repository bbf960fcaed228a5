"""Many steps in one program."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.backends.explicit import Step
from jaxdrones.backends.host import HostStep, is_traced
from jaxdrones.checks import check_finite, check_whole
from jaxdrones.params import Params
from jaxdrones.state import State

Control = Callable[[Params, Any, State, jax.Array], tuple[Any, jax.Array]]


def rollout(
    step: Step, control: Control, params: Params, state: State, memory: Any, length: int
) -> tuple[State, State]:
    """Fly `length` control steps.

    Args:
        step: of either backend, `(params, state, rpm) -> state`.
        control: `(params, memory, state, k) -> (memory, rpm)`, rpm (n, 4); k counts control steps.
        params: of the team.
        state: of the team, at the start.
        memory: what the controller keeps between calls, any pytree; `None` if nothing.
        length: number of control steps.

    Returns:
        The final state, and the state after every control step: arrays (length, n, ...).

    Raises:
        ValueError: `length` < 1, wrong shapes, or numbers that are not finite (where they can be looked at).
    """
    check_whole("length", length)
    check_finite("state", state)
    check_finite("params", params)

    if isinstance(step, HostStep) and not is_traced((params, state, memory)):
        return _loop(step, control, params, state, memory, length)

    def advance(carry: tuple[Any, State], k: jax.Array) -> tuple[tuple[Any, State], State]:
        memory, state = carry
        memory, rpm = control(params, memory, state, k)
        state = step(params, state, rpm)
        return (memory, state), state

    (_, final), trajectory = jax.lax.scan(advance, (memory, state), jnp.arange(length))
    return final, trajectory


def _loop(
    step: HostStep, control: Control, params: Params, state: State, memory: Any, length: int
) -> tuple[State, State]:
    """The same in Python: a step on the host is faster called than called back."""
    control = jax.jit(control)
    states = []
    for k in range(length):
        memory, rpm = control(params, memory, state, k)
        state = step(params, state, rpm)
        states.append(state)
    return state, jax.tree.map(lambda *leaves: np.stack(leaves), *states)
