"""What several expressions of a function use, stored once. XLA's CPU compiler computes it in each of them anew."""

import collections
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.compiler import Equation, Variable, is_literal
from jaxdrones.accelerate.stored import stored

_WORTH = 6
"""Operations that are saved where a number is stored."""

_MOST_VIEWS = 8
"""Of arrays in other orders that a body has; each may double what XLA's CPU compiler makes of it."""

_REORDERING = frozenset("dynamic_slice gather pad rev slice".split())

_COSTS = {"div": 4, "sqrt": 4, "broadcast_in_dim": 0, "convert_element_type": 0}
"""In operations, where it is not one."""


def store_shared(function: Callable) -> Callable:
    """The same function; what several of its equations use, and is not cheap, is stored."""

    def storing(*arguments):
        program, consts, shape = compiler.trace(function, *arguments)
        same, equations = _without_repetition(program)
        uses, equations = _needed(program, same, equations)

        used = [
            (eqn, [same.get(v, v) for v in eqn.invars if not is_literal(v)], [v for v in eqn.outvars if v in uses])
            for eqn in equations
        ]
        chosen = _shared(used, uses)
        values = dict(zip(program.constvars, consts, strict=True))
        values |= dict(zip(program.invars, jax.tree.leaves(arguments), strict=True))
        for eqn, _, results in used:
            variables = dict.fromkeys(v for v in eqn.invars if not is_literal(v))
            found = compiler.alone(eqn, variables, results)(*(values[same.get(v, v)] for v in variables))
            values |= {v: stored(x) if v in chosen else x for v, x in zip(results, found, strict=True)}
        results = [
            np.asarray(v.val, v.aval.dtype) if is_literal(v) else values[same.get(v, v)] for v in program.outvars
        ]
        return jax.tree.structure(shape).unflatten(results)

    return storing


def _without_repetition(program: Any) -> tuple[dict[Variable, Variable], list[Equation]]:
    """Names of what was computed before, and the other equations."""
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
    """How many equations use each variable that the results depend on, and the equations that compute them."""

    def names(variables):
        return {same.get(v, v) for v in variables if not is_literal(v)}

    uses, needed = dict.fromkeys(names(program.outvars), 1), []
    for eqn in reversed(equations):
        if any(v in uses for v in eqn.outvars):
            needed.append(eqn)
            for v in names(eqn.invars):
                uses[v] = uses.get(v, 0) + 1
    return uses, needed[::-1]


_Used = tuple[Equation, list[Variable], list[Variable]]
"""An equation, what it reads, and those of its results that are needed."""


def _shared(equations: Sequence[_Used], uses: dict[Variable, int]) -> set[Variable]:
    """Results that take more to compute again for every use than to store."""
    costs, chosen = {}, set()
    for eqn, inputs, results in equations:
        cost = _COSTS.get(eqn.primitive.name, 1) + sum(costs.get(v, 0) for v in set(inputs))
        worth = {v for v in results if v.aval.ndim and cost * (uses[v] - 1) >= _WORTH}
        chosen |= worth
        costs |= {v: 0 if v in worth else cost for v in results}
    return chosen


def without_copies(
    program: Any, consts: Sequence[Array], *inputs: Array, rules: Mapping[str, Callable] | None = None
) -> list[Array]:
    """The results of a program for one world.

    Arrays that it uses in another order too are stored where they are many: each might double what the compiler makes.

    Args:
        program: traced.
        consts: what it closes over.
        *inputs: of the program.
        rules: how to evaluate equations of some primitives, `(equation, *inputs) -> results`. With rules, derivatives
            are no longer those of the program.
    """
    viewed = _viewed(program)
    values = dict(zip(program.constvars, consts, strict=True)) | dict(zip(program.invars, inputs, strict=True))
    inlined = compiler.CALLS if rules else compiler.PLAIN_CALLS

    def inner(*arguments):
        return without_copies(*arguments, rules=rules)

    def results(eqn, inputs):
        name = eqn.primitive.name
        if rules and name in rules:
            return rules[name](eqn, *inputs)
        if name == "scan":
            return compiler.scan_of(eqn, inner, inputs)
        if name in inlined and (called := compiler.called(eqn))[0].eqns:
            return inner(*called, *inputs)
        return compiler.evaluated(eqn, inputs)

    def read(v):
        return jnp.asarray(v.val, v.aval.dtype) if is_literal(v) else values[v]

    for eqn in program.eqns:
        found = zip(eqn.outvars, results(eqn, [read(v) for v in eqn.invars]), strict=True)
        values |= {v: stored(x) if v in viewed else x for v, x in found}
    return [read(v) for v in program.outvars]


def has_copies(program: Any) -> bool:
    """Whether `without_copies` stores something."""
    return bool(_viewed(program)) or any(has_copies(inner) for eqn in program.eqns for inner in compiler.held(eqn))


def _viewed(program: Any) -> set[Variable]:
    """Variables that are used in another order beside another use; none where there are few."""
    read = [v for eqn in program.eqns for v in eqn.invars if not is_literal(v)]
    uses = collections.Counter(read)
    views = [eqn.invars[0] for eqn in program.eqns if eqn.primitive.name in _REORDERING]
    views = [v for v in views if not is_literal(v) and uses[v] > 1]
    return set(views) if len(views) > _MOST_VIEWS else set()
