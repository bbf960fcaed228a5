"""Many worlds as a structure of arrays, in a form that XLA's CPU compiler can make a single kernel of.

Of a world's velocity `jax.vmap` makes an array (worlds, 3). XLA's CPU compiler shuffles vectors wherever a component of
it is used, and computes in each expression anew what several share. Here every number is an array (worlds,) of its own,
so that to stack, split or transpose is only to name, and what is shared is stored once.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.reordered import store_reordered
from jaxdrones.accelerate.shared import store_shared

_LARGEST = 36
"""Numbers of an array: the places of three drones' rotors. Arrays of four drones fill vectors as they are."""

_MOST = 8_000
"""Numbers that a program computes; so many compile in a quarter of a minute, 13,000 in half a minute."""

_WRITTEN_OUT = 32
"""Terms of a reduction; of more it is a loop."""

_ELEMENTWISE = frozenset(
    "abs add add_any and atan2 bitcast_convert_type cbrt ceil clamp convert_element_type cos cosh div eq erf exp exp2"
    " expm1 floor ge gt integer_pow is_finite le log log1p logistic lt max min mul ne neg not or pow rem round rsqrt"
    " select_n shift_left shift_right_arithmetic shift_right_logical sign sin sinh sqrt square stop_gradient sub tan"
    " tanh xor".split()
)
_SHAPES = frozenset(
    "broadcast_in_dim concatenate pad reshape rev slice split squeeze stack tile transpose unstack".split()
)
_NOTHING = frozenset("copy copy_p optimization_barrier xla_metadata_value".split())
_REDUCTIONS = {
    "reduce_sum": operator.add,
    "reduce_prod": operator.mul,
    "reduce_max": jnp.maximum,
    "reduce_min": jnp.minimum,
    "reduce_and": operator.and_,
    "reduce_or": operator.or_,
}
_BY_NUMBERS = _ELEMENTWISE | _SHAPES | _REDUCTIONS.keys()
_BY_VMAP = frozenset("dynamic_slice dynamic_update_slice gather iota reduce_precision".split())
_KERNEL = compiler.CALLS | _BY_NUMBERS | _BY_VMAP | _NOTHING | {"scan"}
"""Primitives of which XLA's CPU compiler can make a single kernel, in the form that they get here."""


class NoKernel(Exception):
    """XLA's CPU compiler can make no kernel of a program."""


def fits_a_kernel(program: Any) -> bool:
    """Whether XLA's CPU compiler can make a single kernel of what `vmap_for_kernel` makes of a program, and should.

    It must have a loop, whose passages would otherwise be many kernels each, and nothing whose lowering is not known.
    """
    equations = list(_equations(program))
    loops = [eqn for eqn in equations if eqn.primitive.name == "scan" and eqn.params["length"] > 1]
    return (
        bool(loops)
        and not program.effects
        and all(_is_known(eqn) for eqn in equations)
        and all(_is_plain(v.aval) for eqn in equations for v in (*eqn.invars, *eqn.outvars))
        and all(_is_plain(v.aval) for v in (*program.invars, *program.constvars))
    )


def _equations(program: Any) -> Iterable[compiler.Equation]:
    for eqn in program.eqns:
        yield eqn
        for inner in compiler.held(eqn):
            yield from _equations(inner)


def _is_known(eqn: compiler.Equation) -> bool:
    match eqn.primitive.name:
        case "scan":
            return eqn.params["length"] > 0
        case "bitcast_convert_type":
            return eqn.invars[0].aval.shape == eqn.outvars[0].aval.shape
        case name:
            return name in _KERNEL


def _is_plain(aval: Any) -> bool:
    """Whether it is an array of real numbers or truth values, and not empty."""
    dtype = getattr(aval, "dtype", None)
    return isinstance(dtype, np.dtype) and dtype.kind in "biuf" and aval.size > 0


@dataclasses.dataclass(frozen=True)
class _Whole:
    """An array as JAX has it: (..., worlds), or without that axis if it does not vary."""

    x: Array
    varies: bool


_Apart = np.ndarray
"""An array of objects, its numbers: (worlds,) each, or () if the same in all worlds."""

_Value = _Whole | _Apart


def vmap_for_kernel(program: Any, consts: Sequence[Array], leaves: Sequence[Array]) -> list[Array]:
    """The results of a program that `fits_a_kernel` for many worlds, with these last, like its inputs `leaves`.

    Raises:
        NoKernel: it does not, which shows only here.
    """
    if not _is_small(program):
        return jax.vmap(
            functools.partial(store_reordered, program, consts, rules=dict.fromkeys(_REDUCTIONS, _reduced)), -1, -1
        )(*leaves)

    def apart(consts, leaves):
        results = _evaluate(program, [_Whole(x, False) for x in consts], [_Whole(x, True) for x in leaves])
        return [_varying(_whole(value), leaves[0].shape[-1]) for value in results]

    return store_shared(apart)(list(consts), list(leaves))


def _is_small(program: Any) -> bool:
    """Whether the numbers of its loops can be arrays of their own."""
    sizes = list(_sizes_in_loops(program))
    return max(sizes, default=0) <= _LARGEST and sum(sizes) <= _MOST


def _sizes_in_loops(program: Any, inside: bool = False) -> Iterable[int]:
    """Numbers of each array that loops compute, or hand on."""
    for eqn in program.eqns:
        inner = list(compiler.held(eqn))
        for each in inner:
            yield from _sizes_in_loops(each, inside or eqn.primitive.name == "scan")
        if inside and not inner:
            yield from (v.aval.size for v in eqn.outvars)
        if eqn.primitive.name == "scan":
            yield from (v.aval.size for v in eqn.outvars[: compiler.scan_counts(eqn)[1]])


def _evaluate(program: Any, consts: Sequence[_Value], inputs: Sequence[_Value]) -> list[_Value]:
    """The results of a program."""
    values = dict(zip(program.constvars, consts, strict=True))
    values |= dict(zip(program.invars, inputs, strict=True))

    def read(v):
        return _Whole(np.asarray(v.val, v.aval.dtype), False) if compiler.is_literal(v) else values[v]

    for eqn in program.eqns:
        results = _equation(eqn, [read(v) for v in eqn.invars])
        values |= dict(zip(eqn.outvars, results, strict=True))
    return [read(v) for v in program.outvars]


def _equation(eqn: compiler.Equation, inputs: list[_Value]) -> list[_Value]:
    name = eqn.primitive.name
    if name in _NOTHING:
        return inputs
    if name == "scan":
        return _scan(eqn, inputs)
    if name in compiler.CALLS:
        program, consts = compiler.called(eqn)
        return _evaluate(program, [_Whole(x, False) for x in consts], inputs)
    if name in _BY_NUMBERS and all(v.aval.size <= _LARGEST for v in (*eqn.invars, *eqn.outvars)):
        return _number_by_number(eqn, [_apart(x) for x in inputs])
    inputs = [_whole(x) for x in inputs]
    return (
        [_Whole(x, inputs[0].varies) for x in _reduced(eqn, inputs[0].x)]
        if name in _REDUCTIONS
        else _vmapped(eqn, inputs)
    )


def _number_by_number(eqn: compiler.Equation, inputs: list[_Apart]) -> list[_Apart]:
    p, x = eqn.params, inputs[0] if inputs else None
    match eqn.primitive.name:
        case name if name in _ELEMENTWISE:
            return [_elementwise(eqn, inputs)]
        case name if name in _REDUCTIONS:
            rows = np.moveaxis(x, p["axes"], range(len(p["axes"])))
            rows = rows.reshape(-1, *rows.shape[len(p["axes"]) :])
            totals = [functools.reduce(_REDUCTIONS[name], _alike(rows[:, *i])) for i in np.ndindex(rows.shape[1:])]
            return [_of(totals, rows.shape[1:])]
        case "broadcast_in_dim":
            shape = np.ones(len(p["shape"]), int)
            shape[list(p["broadcast_dimensions"])] = x.shape
            return [np.broadcast_to(x.reshape(shape), p["shape"])]
        case "reshape":
            return [(x if p["dimensions"] is None else x.transpose(p["dimensions"])).reshape(p["new_sizes"])]
        case "squeeze":
            return [np.squeeze(x, p["dimensions"])]
        case "transpose":
            return [x.transpose(p["permutation"])]
        case "rev":
            return [np.flip(x, p["dimensions"])]
        case "concatenate":
            return [np.concatenate(inputs, p["dimension"])]
        case "stack":
            return [np.stack(inputs, p["axis"])]
        case "tile":
            return [np.tile(x, p["reps"])]
        case "split":
            return np.split(x, np.cumsum(p["sizes"])[:-1], p["axis"])
        case "unstack":
            return [np.squeeze(part, p["axis"]) for part in np.split(x, x.shape[p["axis"]], p["axis"])]
        case "slice":
            strides = p["strides"] or (1,) * x.ndim
            return [x[tuple(map(slice, p["start_indices"], p["limit_indices"], strides))]]
        case "pad":
            shape = eqn.outvars[0].aval.shape
            padded = _of([inputs[1].item()] * int(np.prod(shape)), shape)
            for i in np.ndindex(x.shape):
                to = tuple(low + k * (1 + between) for k, (low, _, between) in zip(i, p["padding_config"], strict=True))
                if all(0 <= k < n for k, n in zip(to, shape, strict=True)):
                    padded[to] = x[i]
            return [padded]


def _elementwise(eqn: compiler.Equation, inputs: list[_Apart]) -> _Apart:
    def result(*numbers):
        if eqn.primitive.name == "div" and isinstance(numbers[1], np.generic) and numbers[1] == 1:
            return numbers[0]  # `numerics.stored`, in derivatives
        return eqn.primitive.bind(*_alike(numbers), **eqn.params)

    inputs = np.broadcast_arrays(*inputs)
    return _of([result(*numbers) for numbers in zip(*(x.flat for x in inputs), strict=True)], inputs[0].shape)


def _vmapped(eqn: compiler.Equation, inputs: list[_Whole]) -> list[_Whole]:
    """By `jax.vmap`, whatever the equation does.

    Raises:
        NoKernel: XLA's CPU compiler can make no kernel of that.
    """
    if eqn.primitive.name == "dynamic_update_slice" and any(x.varies for x in inputs[2:]):
        raise NoKernel("a place that differs between worlds is a scatter")
    variables = {v: x for v, x in zip(eqn.invars, inputs, strict=True) if not compiler.is_literal(v)}
    function, varies = compiler.alone(eqn, variables, eqn.outvars), any(x.varies for x in variables.values())
    if varies:
        function = jax.vmap(function, tuple(-1 if x.varies else None for x in variables.values()), -1)
    return [_Whole(x, varies) for x in function(*(x.x for x in variables.values()))]


def _reduced(eqn: compiler.Equation, x: Array) -> list[Array]:
    """Written out, or by a loop: of a reduction XLA may make a call of a library, of which it can make no kernel."""
    axes, operation = eqn.params["axes"], _REDUCTIONS[eqn.primitive.name]
    rows = jnp.moveaxis(x, axes, range(len(axes)))
    rows = rows.reshape(-1, *rows.shape[len(axes) :])
    if len(rows) <= _WRITTEN_OUT:
        return [functools.reduce(operation, jnp.unstack(rows))]
    return [jax.lax.scan(lambda total, row: (operation(total, row), None), rows[0], rows[1:])[0]]


def _scan(eqn: compiler.Equation, inputs: list[_Value]) -> list[_Value]:
    first, carried = compiler.scan_counts(eqn)
    last = first + carried
    program, own_consts = compiler.opened(eqn.params["jaxpr"])
    own_consts = [_Whole(x, False) for x in own_consts]
    avals = [v.aval for v in eqn.invars[:last]]
    consts = [_apart(x) if aval.size <= _LARGEST else x for x, aval in zip(inputs[:first], avals[:first], strict=True)]
    stacks = [_whole(x) for x in inputs[last:]]
    avals = avals[first:]

    def taken(values):
        return [
            list(_apart(x).flat) if aval.size <= _LARGEST else [_whole(x).x]
            for x, aval in zip(values, avals, strict=True)
        ]

    def given(carry):
        return [
            _of(x, aval.shape) if aval.size <= _LARGEST else _Whole(x[0], x[0].ndim > aval.ndim)
            for x, aval in zip(carry, avals, strict=True)
        ]

    def body(carry, xs):
        """Of the numbers of each array and whole arrays; returns the next ones."""
        xs = [_Whole(x, stack.varies) for x, stack in zip(xs, stacks, strict=True)]
        results = _evaluate(program, own_consts, [*consts, *given(carry), *xs])
        return taken(results[:carried]), [_whole(x).x for x in results[carried:]]

    def advance(carry, xs):
        after, ys = store_shared(body)(carry, xs)
        return jax.tree.map(_grown, after, carry), ys

    carry, grown = None, jax.tree.map(jnp.asarray, taken(inputs[first:last]))
    while carry is None or jax.tree.map(jnp.shape, grown) != jax.tree.map(jnp.shape, carry):
        carry = grown  # what is the same in all worlds at first need not stay so
        after, _ = jax.eval_shape(body, carry, [jax.eval_shape(lambda x: x[0], stack.x) for stack in stacks])
        grown = jax.tree.map(_grown, carry, after)
    options = {name: eqn.params[name] for name in ("length", "reverse", "unroll")}
    carry, ys = jax.lax.scan(advance, carry, [stack.x for stack in stacks], **options)
    of_ys = zip(ys, eqn.outvars[carried:], strict=True)
    return [*given(carry), *(_Whole(y, y.ndim > v.aval.ndim) for y, v in of_ys)]


def _grown(x: Array, other: Array) -> Array:
    """An array, given to each world if another one like it varies."""
    return jnp.broadcast_to(x[..., None], other.shape) if x.ndim < other.ndim else x


def _apart(value: _Value) -> _Apart:
    if not isinstance(value, _Whole):
        return value
    shape = value.x.shape[:-1] if value.varies else value.x.shape
    return _of([value.x[i] for i in np.ndindex(shape)], shape)


def _whole(value: _Value) -> _Whole:
    if isinstance(value, _Whole):
        return value
    x = jnp.stack(_alike(value.flat))
    return _Whole(x.reshape(*value.shape, *x.shape[1:]), x.ndim > 1)


def _varying(value: _Whole, worlds: int) -> Array:
    return value.x if value.varies else jnp.broadcast_to(value.x[..., None], (*value.x.shape, worlds))


def _of(numbers: Sequence, shape: tuple[int, ...]) -> _Apart:
    array = np.empty(len(numbers), object)
    for i, x in enumerate(numbers):
        array[i] = x
    return array.reshape(shape)


def _alike(numbers: Iterable) -> list:
    """All (worlds,), if one of them is."""
    numbers = list(numbers)
    shape = max(map(jnp.shape, numbers), key=len)
    return [x if jnp.shape(x) == shape else jnp.broadcast_to(x, shape) for x in numbers]
