"""Storing what several expressions of a function share. XLA's CPU compiler would compute it anew in each of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.compiler import Equation, Variable, is_literal
from jaxdrones.accelerate.stored import stored, stored_for_derivatives

_MIN_SAVED_IN_KERNEL = 6
"""Operations that storing a number must save within one kernel, where it costs a write and a few reads."""

_MIN_SAVED_BETWEEN_KERNELS = 40
"""Operations that storing a number must save where it ends a kernel of XLA's and starts another."""

_COSTS = {"div": 4, "sqrt": 4, "broadcast_in_dim": 0, "convert_element_type": 0}
"""Operations that a primitive takes for one number, where it is not one."""


def materialize_shared(function: Callable) -> Callable:
    """The same function, for a CPU: what its expressions share is stored, and what its arguments' derivatives are.

    It works under `jit`, `vmap` and `grad` alike. On other devices, and with versions of JAX that lack what it needs,
    the function is traced as it is.

    Args:
        function: of pytrees of arrays, and traceable. What it closes over is not stored.
    """

    def materialized(*arguments):
        if jax.default_backend() != "cpu" or not compiler.AVAILABLE:
            return function(*arguments)
        return _store_shared(function, _MIN_SAVED_BETWEEN_KERNELS)(*stored_for_derivatives(arguments))

    return materialized


def recomputed(function: Callable) -> Callable:
    """The same function, which a backward pass computes again: faster than storing more than its arguments."""
    return jax.checkpoint(materialize_shared(function))


def store_shared(function: Callable) -> Callable:
    """The same function, for the inside of a single kernel: what its expressions share, and is not cheap, is stored."""
    return _store_shared(function, _MIN_SAVED_IN_KERNEL)


def _store_shared(function: Callable, min_saved: float) -> Callable:
    def storing(*arguments):
        program, consts, shape = compiler.trace(function, *arguments)
        same, equations = _without_repetition(program)
        uses, equations = _needed(program, same, equations)

        used = [
            (eqn, [same.get(v, v) for v in eqn.invars if not is_literal(v)], [v for v in eqn.outvars if v in uses])
            for eqn in equations
        ]
        chosen = _shared(used, uses, min_saved)
        values = dict(zip(program.constvars, consts, strict=True))
        values |= dict(zip(program.invars, jax.tree.leaves(arguments), strict=True))
        for eqn, _, results in used:
            variables = dict.fromkeys(v for v in eqn.invars if not is_literal(v))
            found = compiler.alone(eqn, variables, results)(*(values[same.get(v, v)] for v in variables))
            values |= {v: stored(x) if v in chosen else x for v, x in zip(results, found, strict=True)}
        results = [
            jnp.asarray(v.val, v.aval.dtype) if is_literal(v) else values[same.get(v, v)] for v in program.outvars
        ]
        return jax.tree.structure(shape).unflatten(results)

    return storing


def _without_repetition(program: Any) -> tuple[dict[Variable, Variable], list[Equation]]:
    """The equations that compute something new, and for every result of the others the variable that has its value."""
    same, known, equations = {}, {}, []
    for eqn in program.eqns:
        inputs = (_exactly(v) if is_literal(v) else same.get(v, v) for v in eqn.invars)
        key = (eqn.primitive, str(eqn.params), *inputs)
        if any(compiler.held(eqn)) or eqn.effects or key not in known:
            known[key] = eqn.outvars
            equations.append(eqn)
        else:
            same |= dict(zip(eqn.outvars, known[key], strict=True))
    return same, equations


def _exactly(literal: Any) -> str:
    return f"{np.asarray(literal.val).tolist()} {literal.aval}"


def _needed(program: Any, same: dict, equations: list[Equation]) -> tuple[dict[Variable, int], list[Equation]]:
    """How often each variable is used on which the results depend, and the equations that compute them or act."""

    def names(variables):
        return {same.get(v, v) for v in variables if not is_literal(v)}

    uses, needed = dict.fromkeys(names(program.outvars), 1), []
    for eqn in reversed(equations):
        if eqn.effects or any(v in uses for v in eqn.outvars):
            needed.append(eqn)
            for v in names(eqn.invars):
                uses[v] = uses.get(v, 0) + _copies(eqn)
    return uses, needed[::-1]


def _copies(eqn: Equation) -> int:
    """How often an equation uses a number of its input: a broadcast once for each of its copies."""
    if eqn.primitive.name != "broadcast_in_dim":
        return 1
    return max(1, eqn.outvars[0].aval.size // max(1, eqn.invars[0].aval.size))


_Used = tuple[Equation, list[Variable], list[Variable]]
"""An equation, the variables that it reads, and those of its results that are needed."""


def _shared(equations: Sequence[_Used], uses: dict[Variable, int], min_saved: float) -> set[Variable]:
    """Results that take `min_saved` operations more to compute again for every use than to store."""
    costs, chosen = {}, set()
    for eqn, inputs, results in equations:
        cost = _COSTS.get(eqn.primitive.name, 1) + sum(costs.get(v, 0) for v in set(inputs))
        worth = {v for v in results if v.aval.ndim and cost * (uses[v] - 1) >= min_saved}
        chosen |= worth
        costs |= {v: 0 if v in worth else cost for v in results}
    return chosen
