"""Storage of common subexpressions, which XLA's CPU compiler would recompute in each expression."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.compiler import Equation, Variable, is_literal
from jaxdrones.accelerate.stored import stored, stored_for_derivatives

_MIN_SAVED_IN_KERNEL = 6
"""Smallest number of operations saved by storing a number within one kernel, at the cost of a write and a few reads."""

_MIN_SAVED_BETWEEN_KERNELS = 40
"""Smallest number of operations saved by storing a number between two kernels."""

_COSTS = {"div": 4, "sqrt": 4, "broadcast_in_dim": 0, "convert_element_type": 0}
"""Operations of a primitive per entry, if not one."""


def materialize_shared(function: Callable) -> Callable:
    """Store the common subexpressions of a function of pytrees and the derivatives of its arguments, on a CPU.

    It works under `jit`, `vmap` and `grad`; closed-over values are not stored. On other devices and unsupported
    versions of JAX, the function is unchanged.
    """

    def materialized(*arguments):
        if not compiler.is_cpu() or not compiler.AVAILABLE:
            return function(*arguments)
        return _store_shared(function, _MIN_SAVED_BETWEEN_KERNELS)(*stored_for_derivatives(arguments))

    return materialized


def recomputed(function: Callable) -> Callable:
    """Recompute a function in the backward pass, storing only its arguments."""
    return jax.checkpoint(materialize_shared(function))


def store_shared(function: Callable) -> Callable:
    """Store the costly common subexpressions of a function, for the inside of a single kernel."""
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
    """Distinct equations, and the equivalent variable of every result of a duplicate equation."""
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
    """Live equations, and number of uses of each live variable."""

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
    """Number of uses of an input's entry in an equation: one per copy for a broadcast."""
    if eqn.primitive.name != "broadcast_in_dim":
        return 1
    return max(1, eqn.outvars[0].aval.size // max(1, eqn.invars[0].aval.size))


_Used = tuple[Equation, list[Variable], list[Variable]]
"""Equation, its inputs, and its live results."""


def _shared(equations: Sequence[_Used], uses: dict[Variable, int], min_saved: float) -> set[Variable]:
    """Results whose storage saves at least `min_saved` operations."""
    costs, chosen = {}, set()
    for eqn, inputs, results in equations:
        cost = _COSTS.get(eqn.primitive.name, 1) + sum(costs.get(v, 0) for v in set(inputs))
        worth = {v for v in results if v.aval.ndim and cost * (uses[v] - 1) >= min_saved}
        chosen |= worth
        costs |= {v: 0 if v in worth else cost for v in results}
    return chosen
