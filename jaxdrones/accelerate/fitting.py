"""Which programs can be a single kernel of XLA's CPU compiler, by the primitives that they are made of."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from jaxdrones.accelerate import compiler

LARGEST = 36
"""Numbers of an array whose numbers become arrays of their own: as many as the coordinates of three drones' rotors.
Arrays of four drones fill the vectors of a CPU as they are."""

_MAX_NUMBERS = 8_000
"""Numbers that a program computes in its loops, up to which each becomes an array of its own: so many compile in a
quarter of a minute."""

ELEMENTWISE = frozenset(
    "abs add add_any and atan2 bitcast_convert_type cbrt ceil clamp convert_element_type cos cosh div eq erf exp exp2"
    " expm1 floor ge gt integer_pow is_finite le log log1p logistic lt max min mul ne neg not or pow rem round rsqrt"
    " select_n shift_left shift_right_arithmetic shift_right_logical sign sin sinh sqrt square stop_gradient sub tan"
    " tanh xor".split()
)
"""Primitives that compute each number from the numbers at its place."""

SHAPES = frozenset(
    "broadcast_in_dim concatenate pad reshape rev slice split squeeze stack tile transpose unstack".split()
)
"""Primitives that put numbers in other places."""

IDENTITIES = frozenset("copy copy_p optimization_barrier xla_metadata_value".split())
"""Primitives whose results are their inputs."""

REDUCTIONS = frozenset("reduce_sum reduce_prod reduce_max reduce_min reduce_and reduce_or".split())

_BY_VMAP = frozenset("dynamic_slice dynamic_update_slice gather iota reduce_precision".split())
_ALLOWED = compiler.CALLS | ELEMENTWISE | SHAPES | REDUCTIONS | _BY_VMAP | IDENTITIES | {"scan"}
"""Primitives of which XLA's CPU compiler can make a single kernel, in the form that they get in `soa`."""


class NoKernelError(Exception):
    """XLA's CPU compiler can make no single kernel of a program."""


def fits_a_kernel(program: Any) -> bool:
    """Whether a program can be a single kernel, and should be.

    It should if it has a loop, whose passages would otherwise be many kernels each. It can if every primitive in it is
    known to become part of a kernel, whatever else JAX has or will have.
    """
    equations = list(_equations(program))
    loops = [eqn for eqn in equations if eqn.primitive.name == "scan" and eqn.params["length"] > 1]
    return (
        bool(loops)
        and not program.effects
        and all(_is_allowed(eqn) for eqn in equations)
        and all(_is_plain(v.aval) for eqn in equations for v in (*eqn.invars, *eqn.outvars))
        and all(_is_plain(v.aval) for v in (*program.invars, *program.constvars))
    )


def fits_number_by_number(program: Any) -> bool:
    """Whether the numbers of a program's loops are few enough to be arrays of their own."""
    sizes = list(_sizes_in_loops(program))
    return max(sizes, default=0) <= LARGEST and sum(sizes) <= _MAX_NUMBERS


def _equations(program: Any) -> Iterable[compiler.Equation]:
    """The equations of a program and of all programs that it holds."""
    for eqn in program.eqns:
        yield eqn
        for inner in compiler.held(eqn):
            yield from _equations(inner)


def _is_allowed(eqn: compiler.Equation) -> bool:
    match eqn.primitive.name:
        case "scan":
            return eqn.params["length"] > 0
        case "bitcast_convert_type":
            return eqn.invars[0].aval.shape == eqn.outvars[0].aval.shape
        case name:
            return name in _ALLOWED


def _is_plain(aval: Any) -> bool:
    """Whether it is an array of real numbers or truth values, and not empty."""
    dtype = getattr(aval, "dtype", None)
    return isinstance(dtype, np.dtype) and dtype.kind in "biuf" and aval.size > 0


def _sizes_in_loops(program: Any, inside: bool = False) -> Iterable[int]:
    """The size of each array that loops compute or carry."""
    for eqn in program.eqns:
        inner = list(compiler.held(eqn))
        for each in inner:
            yield from _sizes_in_loops(each, inside or eqn.primitive.name == "scan")
        if inside and not inner:
            yield from (v.aval.size for v in eqn.outvars)
        if eqn.primitive.name == "scan":
            yield from (v.aval.size for v in eqn.outvars[: compiler.scan_counts(eqn)[1]])
