"""Many steps in one program."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.backends.explicit import Step
from jaxdrones.backends.host import HostStep, is_traced
from jaxdrones.backends.team import check_constants
from jaxdrones.checks import check_finite, check_whole
from jaxdrones.params import Params
from jaxdrones.state import State

Control = Callable[[Params, Any, State, jax.Array], tuple[Any, jax.Array]]


def rollout(
    step: Step,
    control: Control,
    params: Params,
    state: State,
    memory: Any,
    length: int,
    checkpoint: int | None = None,
) -> tuple[State, State]:
    """Fly `length` control steps.

    Args:
        step: of either backend, `(params, state, rpm) -> state`.
        control: `(params, memory, state, k) -> (memory, rpm)`, rpm (n, 4); k counts control steps.
        params: of the team.
        state: of the team, at the start.
        memory: what the controller keeps between calls, any pytree; `None` if nothing.
        length: number of control steps.
        checkpoint: control steps between those that a backward pass keeps; it flies the others again, and needs memory
            for `length / checkpoint + checkpoint` steps instead of `length`.

    Returns:
        The final state, and the state after every control step: arrays (length, n, ...).

    Raises:
        ValueError: `length` < 1 or no multiple of `checkpoint`, wrong shapes, or numbers that are not finite (where
            they can be looked at).
    """
    check_whole("length", length)
    check_finite("state", state)
    check_constants(params)

    if isinstance(step, HostStep) and not is_traced((params, state, memory)):
        return _loop(step, control, params, state, memory, length)

    def advance(carry: tuple[Any, State], k: jax.Array) -> tuple[tuple[Any, State], State]:
        memory, state = carry
        memory, rpm = control(params, memory, state, k)
        state = step(params, state, rpm)
        return (memory, state), state

    def fly(carry: tuple[Any, State], ks: jax.Array) -> tuple[tuple[Any, State], State]:
        return jax.lax.scan(advance, carry, ks)

    ks = jnp.arange(length)
    if checkpoint is None:
        (_, final), trajectory = fly((memory, state), ks)
        return final, trajectory
    check_whole("checkpoint", checkpoint)
    if length % checkpoint:
        raise ValueError(f"length is {length}; give a multiple of checkpoint, {checkpoint}")
    (_, final), legs = jax.lax.scan(jax.checkpoint(fly), (memory, state), ks.reshape(-1, checkpoint))
    return final, jax.tree.map(lambda x: x.reshape(length, *x.shape[2:]), legs)


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
