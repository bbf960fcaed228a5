"""Storage of arrays used in several orders, each of which can double the code of XLA's CPU compiler."""

import collections
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.compiler import Variable, is_literal
from jaxdrones.accelerate.stored import stored

_MAX_REORDERED = 8
"""Largest number of reordered arrays of an unchanged program."""

_REORDERING = frozenset("dynamic_slice gather pad rev slice".split())


def store_reordered(
    program: Any, consts: Sequence[Array], *inputs: Array, rules: Mapping[str, Callable] | None = None
) -> list[Array]:
    """Evaluate a traced program for one world, and store its reordered arrays if they are many.

    `consts` are its closed-over values, `rules` the evaluation of some primitives, `(equation, *inputs) -> results`.
    With rules, derivatives are no longer those of the program.
    """
    reordered = _reordered(program)
    values = dict(zip(program.constvars, consts, strict=True)) | dict(zip(program.invars, inputs, strict=True))
    inlined = compiler.CALLS if rules else compiler.PLAIN_CALLS

    def inner(*arguments):
        return store_reordered(*arguments, rules=rules)

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
        values |= {v: stored(x) if v in reordered else x for v, x in found}
    return [read(v) for v in program.outvars]


def has_reordered(program: Any) -> bool:
    """Whether `store_reordered` changes a program."""
    return bool(_reordered(program)) or any(
        has_reordered(inner) for eqn in program.eqns for inner in compiler.held(eqn)
    )


def _reordered(program: Any) -> set[Variable]:
    """Variables with a reordered use beside another use, if they are many."""
    read = [v for eqn in program.eqns for v in eqn.invars if not is_literal(v)]
    uses = collections.Counter(read)
    reordered = [eqn.invars[0] for eqn in program.eqns if eqn.primitive.name in _REORDERING]
    reordered = [v for v in reordered if not is_literal(v) and uses[v] > 1]
    return set(reordered) if len(reordered) > _MAX_REORDERED else set()
