"""What several expressions of a function use, stored once. XLA's CPU compiler computes it in each of them anew."""

from collections.abc import Callable, Iterable, Sequence

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun, jaxprs_in_params

from jaxdrones.numerics import stored

_WORTH = 6
"""Operations that are saved where a number is stored."""

_COSTS = {"div": 4, "sqrt": 4, "broadcast_in_dim": 0, "convert_element_type": 0}
"""In operations, where it is not one."""


def store_shared(function: Callable) -> Callable:
    """The same function; what several of its equations use, and is not cheap, is stored."""

    def storing(*arguments):
        traced, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
        same, equations = _without_repetition(traced.jaxpr)
        uses, equations = _needed(traced.jaxpr, same, equations)
        values = dict(zip(traced.jaxpr.constvars, traced.consts, strict=True))
        values |= dict(zip(traced.jaxpr.invars, jax.tree.leaves(arguments), strict=True))
        costs = dict.fromkeys(values, 0)
        for eqn in equations:
            variables = dict.fromkeys(v for v in eqn.invars if not isinstance(v, Literal))
            results = [v for v in eqn.outvars if v in uses]
            found = alone(eqn, variables, results)(*(values[same.get(v, v)] for v in variables))
            cost = _COSTS.get(eqn.primitive.name, 1) + sum(costs[v] for v in {same.get(v, v) for v in variables})
            for v, x in zip(results, found, strict=True):
                worth = x.ndim == 1 and cost * (uses[v] - 1) >= _WORTH
                values[v], costs[v] = (stored(x), 0) if worth else (x, cost)
        results = [v.val if isinstance(v, Literal) else values[same.get(v, v)] for v in traced.jaxpr.outvars]
        return jax.tree.structure(shape).unflatten(results)

    return storing


def _without_repetition(jaxpr: Jaxpr) -> tuple[dict[Var, Var], list[JaxprEqn]]:
    """Names of what was computed before, and the other equations."""
    same, known, equations = {}, {}, []
    for eqn in jaxpr.eqns:
        inputs = (_exactly(v) if isinstance(v, Literal) else same.get(v, v) for v in eqn.invars)
        key = (eqn.primitive, str(eqn.params), *inputs)
        if any(jaxprs_in_params(eqn.params)) or eqn.effects or key not in known:
            known[key] = eqn.outvars
            equations.append(eqn)
        else:
            same |= dict(zip(eqn.outvars, known[key], strict=True))
    return same, equations


def _exactly(literal: Literal) -> str:
    return f"{np.asarray(literal.val).tolist()} {literal.aval}"


def _needed(jaxpr: Jaxpr, same: dict[Var, Var], equations: list[JaxprEqn]) -> tuple[dict[Var, int], list[JaxprEqn]]:
    """How many equations use each variable that the results depend on, and the equations that compute them."""

    def names(variables):
        return {same.get(v, v) for v in variables if not isinstance(v, Literal)}

    uses, needed = dict.fromkeys(names(jaxpr.outvars), 1), []
    for eqn in reversed(equations):
        if any(v in uses for v in eqn.outvars):
            needed.append(eqn)
            for v in names(eqn.invars):
                uses[v] = uses.get(v, 0) + 1
    return uses, needed[::-1]


def alone(eqn: JaxprEqn, variables: Iterable[Var], results: Sequence[Var]) -> Callable:
    """An equation as a function."""
    empty = jax.make_jaxpr(lambda: ())().jaxpr  # has what a program must tell about its source
    program = empty.replace(invars=[*variables], outvars=[*results], eqns=[eqn], effects=eqn.effects)
    return jaxpr_as_fun(ClosedJaxpr(program, ()))
