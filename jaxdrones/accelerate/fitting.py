"""Eligibility of programs for a single kernel of XLA's CPU compiler, by their primitives."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from jaxdrones.accelerate import compiler

LARGEST = 36
"""Largest size of an array to split into one array per entry: the rotor coordinates of three drones.
Arrays of four drones fill the vectors of a CPU without a split."""

_MAX_NUMBERS = 8_000
"""Largest number of entries in the loops of a program to split: they compile in about 15 s."""

_MAX_APART = 12_000
"""Largest number of entries of a program to split wherever they are, such as the derivative of a step of eight drones
without interaction; with interaction such programs of four drones compile for minutes."""

_MAX_AT_ONCE = 3_700
"""Largest number of entries of several iterations of a loop in one kernel of an accelerator: they compile in about 5 s.
Starting a kernel takes as long as some 40 iterations of the physics within it."""

_MANY_NUMBERS = 1_000
"""Size of an array of which those of all worlds may not fit in the cache."""

ELEMENTWISE = frozenset(
    "abs add add_any and atan2 bitcast_convert_type cbrt ceil clamp convert_element_type cos cosh div eq erf exp exp2"
    " expm1 floor ge gt integer_pow is_finite le log log1p logistic lt max min mul ne neg not or pow rem round rsqrt"
    " select_n shift_left shift_right_arithmetic shift_right_logical sign sin sinh sqrt square stop_gradient sub tan"
    " tanh xor".split()
)
"""Elementwise primitives."""

SHAPES = frozenset(
    "broadcast_in_dim concatenate pad reshape rev slice split squeeze stack tile transpose unstack".split()
)
"""Rearranging primitives."""

IDENTITIES = frozenset("copy copy_p optimization_barrier reshard xla_metadata_value".split())
"""Identity primitives; `reshard` is one because no mesh divides the arrays of one world."""

REDUCTIONS = frozenset("reduce_sum reduce_prod reduce_max reduce_min reduce_and reduce_or".split())

PRODUCTS = frozenset(["dot_general"])
"""Products of matrices and vectors, in a kernel up to the size `LARGEST`; larger ones are faster by a library."""

_BY_VMAP = frozenset("dynamic_slice dynamic_update_slice gather iota reduce_precision".split())
_ALLOWED = compiler.CALLS | ELEMENTWISE | SHAPES | REDUCTIONS | _BY_VMAP | IDENTITIES | {"scan"}
"""Primitives that XLA's CPU compiler can fuse into a single kernel, in their form in `soa`."""


class NoKernelError(Exception):
    """Program that cannot be a single kernel of XLA's CPU compiler."""


def fits_a_kernel(program: Any) -> bool:
    """Whether a program of many worlds can and should be a single kernel.

    It should if it has a loop, which would otherwise run many kernels per iteration.
    """
    return _has_loop(program) and can_be_a_kernel(program)


def gains_by_chunks(program: Any) -> bool:
    """Whether a program of several kernels gains by chunks of worlds that fit in the cache.

    It does if it has a loop. Random numbers take many kernels, each with a cost per chunk, so they need large arrays.
    """
    equations = list(_equations(program))
    has_random = any(eqn.primitive.name.startswith("random_") for eqn in equations)
    largest = max((v.aval.size for eqn in equations for v in eqn.outvars), default=0)
    return _has_loop(program) and not program.effects and (not has_random or largest > _MANY_NUMBERS)


def can_be_a_kernel(program: Any) -> bool:
    """Whether every primitive of a program is on the list of supported ones, and every number real."""
    equations = list(_equations(program))
    return (
        not program.effects
        and all(_is_allowed(eqn) for eqn in equations)
        and all(_is_plain(v.aval) for eqn in equations for v in (*eqn.invars, *eqn.outvars))
        and all(_is_plain(v.aval) for v in (*program.invars, *program.constvars))
    )


def has_reverse_rule(program: Any) -> bool:
    """Whether a program has a `jax.custom_vjp`, which has no derivative once it was differentiated as a program."""
    return any(eqn.primitive.name.startswith("custom_vjp_call") for eqn in _equations(program))


def fits_number_by_number(program: Any) -> bool:
    """Whether the loops of a program have few enough entries to split."""
    sizes = list(_sizes_in_loops(program))
    return max(sizes, default=0) <= LARGEST and sum(sizes) <= _MAX_NUMBERS


def has_few_entries(program: Any) -> bool:
    """Whether a program as a whole has few enough entries to split."""
    return _numbers(program) <= _MAX_APART


def _numbers(program: Any) -> int:
    """Entries of all the arrays that a program computes."""
    return sum(v.aval.size for eqn in _equations(program) if not any(compiler.held(eqn)) for v in eqn.outvars)


def iterations_at_once(program: Any, length: int) -> int:
    """Number of iterations of a loop in one kernel of an accelerator, a divisor of `length`; one with inner loops."""
    if _has_loop(program):
        return 1
    most = max(1, min(length, _MAX_AT_ONCE // max(_numbers(program), 1)))
    return next(count for count in range(most, 0, -1) if length % count == 0)


def _has_loop(program: Any) -> bool:
    """Whether a program has a loop of more than one iteration."""
    return any(
        eqn.primitive.name == "while" or (eqn.primitive.name == "scan" and eqn.params["length"] > 1)
        for eqn in _equations(program)
    )


def _equations(program: Any) -> Iterable[compiler.Equation]:
    """Equations of a program and of all its subprograms."""
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
        case name if name in PRODUCTS:
            return all(v.aval.size <= LARGEST for v in (*eqn.invars, *eqn.outvars))
        case name:
            return name in _ALLOWED


def _is_plain(aval: Any) -> bool:
    """Whether it is a nonempty array of real numbers or booleans."""
    dtype = getattr(aval, "dtype", None)
    return isinstance(dtype, np.dtype) and dtype.kind in "biuf" and aval.size > 0


def _sizes_in_loops(program: Any, inside: bool = False) -> Iterable[int]:
    """Sizes of the arrays computed or carried by loops."""
    for eqn in program.eqns:
        inner = list(compiler.held(eqn))
        for each in inner:
            yield from _sizes_in_loops(each, inside or eqn.primitive.name == "scan")
        if inside and not inner:
            yield from (v.aval.size for v in eqn.outvars)
        if eqn.primitive.name == "scan":
            yield from (v.aval.size for v in eqn.outvars[: compiler.scan_counts(eqn)[1]])
