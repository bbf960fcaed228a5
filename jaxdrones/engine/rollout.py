"""Many steps in one program."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.checks import (
    check_arrays,
    check_callable,
    check_finite,
    check_params,
    check_quaternion,
    check_whole,
    shown,
)
from jaxdrones.engine.step import HostStep, Step, is_traced
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.state import State

Advance = Callable[[Params, State, jax.Array], State]
Control = Callable[[Params, Any, State, jax.Array], tuple[Any, jax.Array]]


def rollout(
    step: Advance,
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
        state: of the team, at the start; the models of the step that have no state in it start anew.
        memory: what the controller keeps between calls, any pytree; `None` if nothing.
        length: number of control steps.
        checkpoint: control steps between those that a backward pass keeps; it flies the others again, and needs memory
            for `length / checkpoint + checkpoint` steps instead of `length`.

    Returns:
        The final state, and the state after every control step: arrays (length, n, ...).

    Raises:
        ValueError: `length` < 1 or no multiple of `checkpoint`, wrong shapes, a controller that answers something
            else, or numbers that do not fly (where they can be looked at): not finite, a mass that is not positive, a
            quaternion that is not of unit length.
    """
    check_whole("length", length)
    check_callable("control", control, "lambda params, memory, state, k: (memory, rpm)")
    check_params(params)
    check_arrays("state", state)
    check_finite("state", state)
    check_quaternion("state.quat", state.quat)

    state = step.init(params, state) if isinstance(step, Step) else state
    if isinstance(step, HostStep) and checkpoint is not None:
        raise UserError("checkpoint is given and the bullet backend has no backward pass; leave it out")
    if isinstance(step, HostStep) and not is_traced((params, state, memory)):
        return _loop(step, control, params, state, memory, length)

    def advance(carry: tuple[Any, State], k: jax.Array) -> tuple[tuple[Any, State], State]:
        memory, state = carry
        memory, rpm = _commanded(control, params, memory, state, k)
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
        raise UserError(f"length is {length}; give a multiple of checkpoint, {checkpoint}")
    (_, final), legs = jax.lax.scan(jax.checkpoint(fly), (memory, state), ks.reshape(-1, checkpoint))
    return final, jax.tree.map(lambda x: x.reshape(length, *x.shape[2:]), legs)


def _commanded(control: Control, params: Params, memory: Any, state: State, k: Any) -> tuple[Any, jax.Array]:
    """What a controller answers, or an error if that is something else than memory and rotor speeds."""
    answer = control(params, memory, state, k)
    if not (isinstance(answer, tuple | list) and len(answer) == 2):
        given = f"an array of shape {np.shape(answer)}" if isinstance(answer, jax.Array | np.ndarray) else shown(answer)
        raise UserError(f"control returned {given}; return (memory, rpm), with memory as it was given if there is none")
    given, returned = (str(jax.tree.structure(x)) for x in (memory, answer[0]))
    if given != returned:
        raise UserError(
            f"control was given the memory {given} and returned {returned}; "
            "return (memory, rpm) with memory of the same structure"
        )
    return answer[0], answer[1]


def _loop(
    step: HostStep, control: Control, params: Params, state: State, memory: Any, length: int
) -> tuple[State, State]:
    """The same in Python: a step on the host is faster called than called back."""
    control = jax.jit(control)
    states = []
    for k in range(length):
        memory, rpm = _commanded(control, params, memory, state, k)
        state = step(params, state, rpm)
        states.append(state)
    return state, jax.tree.map(lambda *leaves: np.stack(leaves), *states)
