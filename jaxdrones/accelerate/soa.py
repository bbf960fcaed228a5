"""Structure of arrays over worlds, for a single kernel of XLA's CPU compiler and for few kernels on an accelerator.

`jax.vmap` batches a velocity to an array (worlds, 3). XLA's CPU compiler shuffles vectors for each use of a component,
and recomputes common subexpressions. On a GPU each array is a kernel, and an iteration of a loop waits for all of them.
Here every entry is a separate array (worlds,), so stacking, splitting and transposing are free, common subexpressions
are stored once, and the arithmetic of an iteration is one kernel.
"""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.fitting import (
    ELEMENTWISE,
    IDENTITIES,
    LARGEST,
    PRODUCTS,
    REDUCTIONS,
    SHAPES,
    NoKernelError,
    iterations_at_once,
)
from jaxdrones.accelerate.layout import Value, Whole, apart, number_by_number, of_numbers, product, reduced, whole
from jaxdrones.accelerate.reordered import store_reordered
from jaxdrones.accelerate.shared import store_shared

_BY_NUMBERS = ELEMENTWISE | SHAPES | REDUCTIONS | PRODUCTS
_RULES = dict.fromkeys(REDUCTIONS, reduced) | dict.fromkeys(PRODUCTS, product) | {"reshard": lambda _, x: [x]}


def over_last_axis(
    program: Any, inputs: Sequence[Array], varies: Sequence[bool], by_numbers: bool, consts: Sequence[Array] = ()
) -> list[Array]:
    """Evaluate a program of one world in a form for kernels, with the worlds last in the results and varying inputs.

    It is computed number by number, or array by array.

    Raises:
        NoKernelError: the program cannot be a single kernel.
    """
    if not by_numbers:
        axes = [-1 if each else None for each in varies]
        return jax.vmap(functools.partial(store_reordered, program, consts, rules=_RULES), axes, -1)(*inputs)
    worlds = next(x.shape[-1] for x, each in zip(inputs, varies, strict=True) if each)

    def evaluated(consts, inputs):
        of_worlds = [Whole(x, each) for x, each in zip(inputs, varies, strict=True)]
        results = _evaluate(program, [Whole(x, False) for x in consts], of_worlds)
        return [whole(value).in_all_worlds(worlds) for value in results]

    return store_shared(evaluated)(list(consts), list(inputs))


def _evaluate(program: Any, consts: Sequence[Value], inputs: Sequence[Value]) -> list[Value]:
    """Results of a program."""
    values = dict(zip(program.constvars, consts, strict=True))
    values |= dict(zip(program.invars, inputs, strict=True))

    def read(v):
        return Whole(np.asarray(v.val, v.aval.dtype), False) if compiler.is_literal(v) else values[v]

    for eqn in program.eqns:
        results = _equation(eqn, [read(v) for v in eqn.invars])
        values |= dict(zip(eqn.outvars, results, strict=True))
    return [read(v) for v in program.outvars]


def _equation(eqn: compiler.Equation, inputs: list[Value]) -> list[Value]:
    """Results of an equation."""
    name = eqn.primitive.name
    if name in IDENTITIES:
        return inputs
    if name == "scan":
        return _scan(eqn, inputs)
    if name in compiler.CALLS:
        program, consts = compiler.called(eqn)
        return _evaluate(program, [Whole(x, False) for x in consts], inputs)
    if name in _BY_NUMBERS and all(v.aval.size <= LARGEST for v in (*eqn.invars, *eqn.outvars)):
        return number_by_number(eqn, [apart(x) for x in inputs])
    arrays = [whole(x) for x in inputs]
    if name in REDUCTIONS:
        return [Whole(x, arrays[0].varies) for x in reduced(eqn, arrays[0].x)]
    return _vmapped(eqn, arrays)


def _vmapped(eqn: compiler.Equation, inputs: list[Whole]) -> list[Whole]:
    """Results of any equation, by `jax.vmap`.

    Raises:
        NoKernelError: an unsupported equation.
    """
    if eqn.primitive.name == "dynamic_update_slice" and any(x.varies for x in inputs[2:]):
        raise NoKernelError("a place that differs between worlds is a scatter")
    variables = {v: x for v, x in zip(eqn.invars, inputs, strict=True) if not compiler.is_literal(v)}
    function, varies = compiler.alone(eqn, variables, eqn.outvars), any(x.varies for x in variables.values())
    if varies:
        function = jax.vmap(function, tuple(-1 if x.varies else None for x in variables.values()), -1)
    return [Whole(x, varies) for x in function(*(x.x for x in variables.values()))]


def _scan(eqn: compiler.Equation, inputs: list[Value]) -> list[Value]:
    """Results of a scan that carries small arrays split, and larger ones whole."""
    first, carried = compiler.scan_counts(eqn)
    last = first + carried
    program, own_consts = compiler.opened(eqn.params["jaxpr"])
    own_consts = [Whole(x, False) for x in own_consts]
    avals = [v.aval for v in eqn.invars[:last]]
    consts = [apart(x) if aval.size <= LARGEST else x for x, aval in zip(inputs[:first], avals[:first], strict=True)]
    stacks = [whole(x) for x in inputs[last:]]
    avals = avals[first:]

    def to_carry(values):
        return [
            list(apart(x).flat) if aval.size <= LARGEST else [whole(x).x] for x, aval in zip(values, avals, strict=True)
        ]

    def from_carry(carry):
        return [
            of_numbers(x, aval.shape) if aval.size <= LARGEST else Whole(x[0], x[0].ndim > aval.ndim)
            for x, aval in zip(carry, avals, strict=True)
        ]

    def body(carry, xs):
        xs = [Whole(x, stack.varies) for x, stack in zip(xs, stacks, strict=True)]
        results = _evaluate(program, own_consts, [*consts, *from_carry(carry), *xs])
        return to_carry(results[:carried]), [whole(x).x for x in results[carried:]]

    def advance(carry, xs):
        after, ys = store_shared(body)(carry, xs)
        return jax.tree.map(_grown, after, carry), ys

    carry, grown = None, jax.tree.map(jnp.asarray, to_carry(inputs[first:last]))
    while carry is None or jax.tree.map(jnp.shape, grown) != jax.tree.map(jnp.shape, carry):
        carry = grown  # a carry that is equal in all worlds at first may vary later
        after, _ = jax.eval_shape(body, carry, [jax.eval_shape(lambda x: x[0], stack.x) for stack in stacks])
        grown = jax.tree.map(_grown, carry, after)
    options = {name: eqn.params[name] for name in ("length", "reverse", "unroll")}
    if not compiler.is_cpu():
        options["unroll"] = max(options["unroll"], iterations_at_once(program, options["length"]))
    carry, ys = jax.lax.scan(advance, carry, [stack.x for stack in stacks], **options)
    of_ys = zip(ys, eqn.outvars[carried:], strict=True)
    return [*from_carry(carry), *(Whole(y, y.ndim > v.aval.ndim) for y, v in of_ys)]


def _grown(x: Array, other: Array) -> Array:
    """Broadcast an array over worlds if its counterpart varies."""
    return jnp.broadcast_to(x[..., None], other.shape) if x.ndim < other.ndim else x
