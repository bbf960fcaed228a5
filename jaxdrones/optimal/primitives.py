"""JAX primitives as functions of CasADi scalars. True is one, false zero."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from typing import Any

from jaxdrones.errors import install

try:
    import casadi
except ImportError as error:
    raise ImportError(f"jaxdrones.optimal: casadi is not installed; {install('casadi')}") from error


def select(which: Any, *cases: Any) -> Any:
    """Case number `which`, from 0; a boolean selects one of two."""
    if not isinstance(which, casadi.SX):
        return cases[int(which)]
    if len(cases) == 2:
        return casadi.if_else(which, cases[1], cases[0])
    return functools.reduce(
        lambda rest, i: casadi.if_else(which <= i, cases[i], rest), reversed(range(len(cases) - 1)), cases[-1]
    )


def _integer_pow(x: Any, y: int, **_: Any) -> Any:
    product = functools.reduce(operator.mul, [x] * abs(y), 1.0)
    return product if y >= 0 else 1 / product


def _round(x: Any, **_: Any) -> Any:
    return casadi.floor(x + 0.5)


def _of_two(function: Callable) -> Callable:
    return lambda x, y, **_: function(x, y)


def _of_one(function: Callable) -> Callable:
    return lambda x, **_: function(x)


ELEMENTWISE: dict[str, Callable[..., Any]] = {
    "abs": _of_one(casadi.fabs),
    "acos": _of_one(casadi.acos),
    "acosh": _of_one(casadi.acosh),
    "add": _of_two(operator.add),
    "add_any": _of_two(operator.add),
    "and": _of_two(casadi.logic_and),
    "asin": _of_one(casadi.asin),
    "asinh": _of_one(casadi.asinh),
    "atan": _of_one(casadi.atan),
    "atan2": _of_two(casadi.atan2),
    "atanh": _of_one(casadi.atanh),
    "cbrt": _of_one(lambda x: casadi.sign(x) * casadi.fabs(x) ** (1 / 3)),
    "ceil": _of_one(casadi.ceil),
    "clamp": lambda low, x, high, **_: casadi.fmin(casadi.fmax(x, low), high),
    "cos": _of_one(casadi.cos),
    "cosh": _of_one(casadi.cosh),
    "div": _of_two(operator.truediv),
    "eq": _of_two(operator.eq),
    "erf": _of_one(casadi.erf),
    "exp": _of_one(casadi.exp),
    "exp2": _of_one(lambda x: 2**x),
    "expm1": _of_one(casadi.expm1),
    "floor": _of_one(casadi.floor),
    "ge": _of_two(operator.ge),
    "gt": _of_two(operator.gt),
    "integer_pow": _integer_pow,
    "is_finite": _of_one(lambda x: casadi.fabs(x) < casadi.inf),
    "le": _of_two(operator.le),
    "log": _of_one(casadi.log),
    "log1p": _of_one(casadi.log1p),
    "logistic": _of_one(lambda x: 1 / (1 + casadi.exp(-x))),
    "lt": _of_two(operator.lt),
    "max": _of_two(casadi.fmax),
    "min": _of_two(casadi.fmin),
    "mul": _of_two(operator.mul),
    "ne": _of_two(operator.ne),
    "neg": _of_one(operator.neg),
    "not": _of_one(casadi.logic_not),
    "or": _of_two(casadi.logic_or),
    "pow": _of_two(operator.pow),
    "round": _round,
    "rsqrt": _of_one(lambda x: 1 / casadi.sqrt(x)),
    "sign": _of_one(casadi.sign),
    "sin": _of_one(casadi.sin),
    "sinh": _of_one(casadi.sinh),
    "sqrt": _of_one(casadi.sqrt),
    "square": _of_one(lambda x: x * x),
    "sub": _of_two(operator.sub),
    "tan": _of_one(casadi.tan),
    "tanh": _of_one(casadi.tanh),
    "xor": _of_two(operator.ne),
}
"""Elementwise functions, with the parameters of the equation as keywords."""

REDUCTIONS: dict[str, Callable[[list], Any]] = {
    "reduce_and": lambda row: functools.reduce(casadi.logic_and, row),
    "reduce_max": lambda row: functools.reduce(casadi.fmax, row),
    "reduce_min": lambda row: functools.reduce(casadi.fmin, row),
    "reduce_or": lambda row: functools.reduce(casadi.logic_or, row),
    "reduce_prod": lambda row: functools.reduce(operator.mul, row),
    "reduce_sum": lambda row: functools.reduce(operator.add, row),
}
"""Reductions along axes."""
