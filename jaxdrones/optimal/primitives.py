"""JAX primitives as functions of CasADi scalars. True is one, false zero."""

import functools
import operator
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxdrones.errors import needs

with needs("jaxdrones.optimal: casadi", "casadi"):
    import casadi


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


def _round(x: Any, rounding_method: Any, **_: Any) -> Any:
    """Nearest integer; halves to even numbers, or away from zero, as in JAX."""
    if int(rounding_method) == 0:  # away from zero
        return casadi.sign(x) * casadi.floor(casadi.fabs(x) + 0.5)
    nearest = casadi.floor(x + 0.5)
    is_odd_half = casadi.logic_and(nearest - x == 0.5, nearest != 2 * casadi.floor(nearest / 2))
    return nearest - is_odd_half


def truncated(x: Any) -> Any:
    """Integer part of a number."""
    return casadi.sign(x) * casadi.floor(casadi.fabs(x))


def converted(old: np.dtype, new: np.dtype) -> Callable[[Any], Any] | None:
    """Conversion of a number to another type; `None` where it keeps the value."""
    if new.kind == "b" != old.kind:
        return lambda x: x != 0
    return truncated if new.kind in "iu" and old.kind not in "biu" else None


def _of_two(function: Callable) -> Callable:
    return lambda x, y, **_: function(x, y)


def _of_one(function: Callable) -> Callable:
    return lambda x, **_: function(x)


_SAME_NAMES = "acos acosh asin asinh atan atanh ceil cos cosh erf exp expm1 floor log log1p sign sin sinh sqrt tan tanh"
_OPERATORS = "add eq ge gt le lt mul ne pow sub"

ELEMENTWISE: dict[str, Callable[..., Any]] = {
    **{name: _of_one(getattr(casadi, name)) for name in _SAME_NAMES.split()},
    **{name: _of_two(getattr(operator, name)) for name in _OPERATORS.split()},
    "abs": _of_one(casadi.fabs),
    "add_any": _of_two(operator.add),
    "and": _of_two(casadi.logic_and),
    "atan2": _of_two(casadi.atan2),
    "cbrt": _of_one(lambda x: casadi.sign(x) * casadi.fabs(x) ** (1 / 3)),
    "clamp": lambda low, x, high, **_: casadi.fmin(casadi.fmax(x, low), high),
    "div": _of_two(operator.truediv),
    "exp2": _of_one(lambda x: 2**x),
    "integer_pow": _integer_pow,
    "is_finite": _of_one(lambda x: casadi.fabs(x) < casadi.inf),
    "logistic": _of_one(lambda x: 1 / (1 + casadi.exp(-x))),
    "max": _of_two(casadi.fmax),
    "min": _of_two(casadi.fmin),
    "neg": _of_one(operator.neg),
    "not": _of_one(casadi.logic_not),
    "or": _of_two(casadi.logic_or),
    "round": _round,
    "rsqrt": _of_one(lambda x: 1 / casadi.sqrt(x)),
    "square": _of_one(lambda x: x * x),
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
