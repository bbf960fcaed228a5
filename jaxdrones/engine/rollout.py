"""Rollouts: many control steps in one program."""

import functools
from collections.abc import Callable, Iterator
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.arguments import Count, checked, function
from jaxdrones.checks import check_params, short_repr
from jaxdrones.engine.step import HostStep, Step, is_traced
from jaxdrones.engine.team import check_state
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.state import State

Advance = Callable[[Params, State, jax.Array], State]
Control = Callable[[Params, Any, State, jax.Array], tuple[Any, jax.Array]]

_LEG = 1 / 30  # s: one leg a screen frame


@checked
def rollout(
    step: Advance,
    control: Annotated[
        Control, function("lambda params, memory, state, k: (memory, rpm)", ("params", "memory", "state", "k"))
    ],
    params: Params,
    state: Annotated[State, check_state],
    memory: Any,
    length: Count,
    checkpoint: Count | None = None,
) -> tuple[State, State]:
    """Fly `length` control steps.

    Args:
        step: of either backend, `(params, state, rpm) -> state`.
        control: `(params, memory, state, k) -> (memory, rpm)`, rpm (n, 4); k counts control steps.
        params: of the team.
        state: initial state of the team; missing model states are initialized.
        memory: memory of the controller, any pytree; `None` for none.
        length: number of control steps.
        checkpoint: control steps between checkpoints of the backward pass. Other steps are recomputed, which reduces
            memory from `length` to `length / checkpoint + checkpoint` steps.

    Returns:
        The final state, and the state after every control step: arrays (length, n, ...).

    Raises:
        ValueError: `length` < 1 or not a multiple of `checkpoint`, wrong shapes, a controller with another result, or
            concrete values that cannot fly: not finite, a mass that is not positive, a quaternion that is not of unit
            length.
    """
    check_params(params)
    state = step.init(params, state) if isinstance(step, Step) else state
    if isinstance(step, HostStep) and checkpoint is not None:
        raise UserError("checkpoint is given and the bullet backend has no backward pass; leave it out")
    if isinstance(step, HostStep) and not is_traced((params, state, memory)):
        (states,) = legs(step, control, params, state, memory, length, length)
        return jax.tree.map(lambda x: jnp.asarray(x[-1]), states), states

    def fly(carry: tuple[Any, State], ks: jax.Array) -> tuple[tuple[Any, State], State]:
        return jax.lax.scan(functools.partial(_advance, step, control, params), carry, ks)

    ks = jnp.arange(length)
    if checkpoint is None:
        (_, final), trajectory = fly((memory, state), ks)
        return final, trajectory
    if length % checkpoint:
        raise UserError(f"length is {length}; give a multiple of checkpoint, {checkpoint}")
    (_, final), parts = jax.lax.scan(jax.checkpoint(fly), (memory, state), ks.reshape(-1, checkpoint))
    return final, jax.tree.map(lambda x: x.reshape(length, *x.shape[2:]), parts)


def leg_length(dt: float) -> int:
    """Number of control steps of `dt` seconds in a leg of about 1/30 s; at least one."""
    return max(1, round(_LEG / dt))


def legs(
    step: Step, control: Control, params: Params, state: State, memory: Any, length: int, leg: int
) -> Iterator[State]:
    """Fly `length` control steps as `rollout` does, in legs of `leg` steps; the last leg may be shorter.

    Yields:
        State after every control step of a leg: arrays (leg, n, ...) on the host.
    """
    carry = memory, step.init(params, state)
    if isinstance(step, HostStep):  # is faster called than called back
        control, states = jax.jit(control), []
        for k in range(length):
            carry, state = _advance(step, control, params, carry, k)
            states.append(state)
            if len(states) == leg or k == length - 1:
                yield jax.tree.map(lambda *x: np.stack(x), *states)
                states = []
        return

    @jax.jit
    def fly(params: Params, carry: tuple[Any, State], first: jax.Array) -> tuple[tuple[Any, State], State]:
        return jax.lax.scan(functools.partial(_advance, step, control, params), carry, first + jnp.arange(leg))

    for first in range(0, length, leg):
        carry, states = fly(params, carry, jnp.asarray(first))
        yield jax.tree.map(lambda x, left=length - first: np.asarray(x)[:left], states)


def _advance(
    step: Advance, control: Control, params: Params, carry: tuple[Any, State], k: Any
) -> tuple[tuple[Any, State], State]:
    memory, rpm = _commanded(control, params, *carry, k)
    state = step(params, carry[1], rpm)
    return (memory, state), state


def _commanded(control: Control, params: Params, memory: Any, state: State, k: Any) -> tuple[Any, jax.Array]:
    answer = control(params, memory, state, k)
    if not (isinstance(answer, tuple | list) and len(answer) == 2):
        given = (
            f"an array of shape {np.shape(answer)}"
            if isinstance(answer, jax.Array | np.ndarray)
            else short_repr(answer)
        )
        raise UserError(f"control returned {given}; return (memory, rpm), with memory as it was given if there is none")
    given, returned = (str(jax.tree.structure(x)) for x in (memory, answer[0]))
    if given != returned:
        raise UserError(
            f"control was given the memory {given} and returned {returned}; "
            "return (memory, rpm) with memory of the same structure"
        )
    return answer[0], answer[1]
