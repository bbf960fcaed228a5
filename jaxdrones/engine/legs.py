"""A rollout in legs, whose states are at hand while the rest is still to be flown."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.engine.rollout import Control
from jaxdrones.engine.step import HostStep, Step
from jaxdrones.params import Params
from jaxdrones.state import State

_LEG = 1 / 30  # s: a leg for each picture of a screen


def leg_length(dt: float) -> int:
    """Control steps of `dt` seconds in a leg of about a thirtieth of a second; at least one."""
    return max(1, round(_LEG / dt))


def legs(
    step: Step, control: Control, params: Params, state: State, memory: Any, length: int, leg: int
) -> Iterator[State]:
    """Fly `length` control steps as `rollout` does, `leg` of them at a time; the last leg may be shorter.

    Args:
        step: of either backend.
        control: `(params, memory, state, k) -> (memory, rpm)`, rpm (n, 4); k counts control steps.
        params: of the team.
        state: of the team, at the start.
        memory: what the controller keeps between calls.
        length: number of control steps.
        leg: number of control steps of a leg.

    Yields:
        The state after every control step of a leg: arrays (leg, n, ...) on the host.
    """
    state = step.init(params, state)
    if isinstance(step, HostStep):
        control, states = jax.jit(control), []
        for k in range(length):
            memory, rpm = control(params, memory, state, k)
            state = step(params, state, rpm)
            states.append(state)
            if len(states) == leg or k == length - 1:
                yield jax.tree.map(lambda *x: np.stack(x), *states)
                states = []
        return

    @jax.jit
    def fly(params: Params, carry: tuple[Any, State], first: jax.Array) -> tuple[tuple[Any, State], State]:
        def advance(carry: tuple[Any, State], k: jax.Array) -> tuple[tuple[Any, State], State]:
            memory, state = carry
            memory, rpm = control(params, memory, state, k)
            state = step(params, state, rpm)
            return (memory, state), state

        return jax.lax.scan(advance, carry, first + jnp.arange(leg))

    carry = (memory, state)
    for first in range(0, length, leg):
        carry, states = fly(params, carry, jnp.asarray(first))
        yield jax.tree.map(lambda x, left=length - first: np.asarray(x)[:left], states)
