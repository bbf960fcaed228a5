"""Many worlds as a structure of arrays, for the CPU.

Of a world's velocity `jax.vmap` makes an array (worlds, 3). XLA's CPU compiler shuffles vectors wherever a component of
it is used, and computes in each expression anew what several share. Here every number in a loop is an array (worlds,)
of its own, so that to stack, split or transpose is only to name, and what is shared is stored once. Gradients take
three quarters to a quarter of the time (semi-implicit Euler 29 instead of 39 ns a step, rk4 85 instead of 190, through
the paper's attitude loop 63 instead of 278), flights between 0.4 of it and all.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable, Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, jaxpr_as_fun, jaxprs_in_params
from jaxtyping import Array

from jaxdrones.backends.shared import alone, store_shared

_LARGEST = 36
"""Numbers of an array in a loop: the places of three drones' rotors. Arrays of four drones fill vectors as they are."""

_MOST = 8_000
"""Numbers that a passage of all loops computes; so many compile in a quarter of a minute, 13,000 in half a minute."""

_ELEMENTWISE = frozenset(
    "abs add add_any and atan2 cbrt ceil clamp convert_element_type cos cosh div eq erf exp exp2 expm1 floor ge gt"
    " integer_pow is_finite le log log1p logistic lt max min mul ne neg not or pow rem round rsqrt select_n sign sin"
    " sinh sqrt square stop_gradient sub tan tanh xor".split()
)
_SHAPES = frozenset("broadcast_in_dim concatenate pad reshape rev slice split squeeze transpose unstack".split())
_NOTHING = frozenset("copy copy_p optimization_barrier xla_metadata_value".split())
_REDUCTIONS = {
    "reduce_sum": operator.add,
    "reduce_prod": operator.mul,
    "reduce_max": jnp.maximum,
    "reduce_min": jnp.minimum,
    "reduce_and": operator.and_,
    "reduce_or": operator.or_,
}


@dataclasses.dataclass(frozen=True)
class _Whole:
    """An array as JAX has it: (..., worlds), or without that axis if it does not vary."""

    x: Array
    varies: bool


_Apart = np.ndarray
"""An array of objects, its numbers: (worlds,) each, or () if the same in all worlds."""

_Value = _Whole | _Apart


def vmap_apart(function: Callable) -> Callable:
    """`jax.vmap(function, -1, -1)`, with the numbers of its loops apart.

    Not where there are too many, nor where it is differentiated: take derivatives in the function.
    """

    def many(*arguments):
        leaves, tree = jax.tree.flatten(arguments)
        of_one = [jax.ShapeDtypeStruct(x.shape[:-1], x.dtype) for x in leaves]
        traced, shape = jax.make_jaxpr(lambda *x: function(*tree.unflatten(x)), return_shape=True)(*of_one)
        sizes = _sizes_in_loops(traced.jaxpr)

        @jax.custom_jvp
        def apart(consts, leaves):
            inputs = [_Whole(x, True) for x in leaves]
            results = map(_whole, _evaluate(ClosedJaxpr(traced.jaxpr, consts), inputs, in_loop=False))
            return [_varying(value, leaves[0].shape[-1]) for value in results]

        def together(consts, leaves):
            return jax.vmap(jaxpr_as_fun(ClosedJaxpr(traced.jaxpr, consts)), -1, -1)(*leaves)

        apart.defjvp(lambda values, tangents: jax.jvp(together, values, tangents))
        too_many = max(sizes, default=0) > _LARGEST or sum(sizes) > _MOST or 0 in sizes
        return jax.tree.structure(shape).unflatten((together if too_many else apart)(traced.consts, leaves))

    return many


def _sizes_in_loops(jaxpr: Jaxpr, inside: bool = False) -> list[int]:
    """Numbers of each array that loops compute, or hand on."""
    sizes = []
    for eqn in jaxpr.eqns:
        inner = list(jaxprs_in_params(eqn.params))
        for each in inner:
            sizes += _sizes_in_loops(each, inside or eqn.primitive.name == "scan")
        sizes += [v.aval.size for v in eqn.outvars] if inside and not inner else []
        if eqn.primitive.name == "scan":
            sizes += [v.aval.size for v in eqn.outvars[: eqn.params["num_carry"]]]
    return sizes


def _evaluate(traced: ClosedJaxpr, inputs: Sequence[_Value], in_loop: bool) -> list[_Value]:
    jaxpr = traced.jaxpr
    values = dict(zip(jaxpr.constvars, (_Whole(x, False) for x in traced.consts), strict=True))
    values |= dict(zip(jaxpr.invars, inputs, strict=True))

    def read(v):
        return _Whole(np.asarray(v.val, v.aval.dtype), False) if isinstance(v, Literal) else values[v]

    for eqn in jaxpr.eqns:
        results = _equation(eqn, [read(v) for v in eqn.invars], in_loop)
        values |= dict(zip(eqn.outvars, results, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _equation(eqn: JaxprEqn, inputs: list[_Value], in_loop: bool) -> list[_Value]:
    if eqn.primitive.name in _NOTHING:
        return inputs
    if eqn.primitive.name == "scan":
        return _scan(eqn, inputs)
    if called := eqn.params.get("jaxpr") or eqn.params.get("call_jaxpr"):
        return _evaluate(ClosedJaxpr(called, ()) if isinstance(called, Jaxpr) else called, inputs, in_loop)
    if in_loop and eqn.primitive.name in _ELEMENTWISE | _REDUCTIONS.keys() | _SHAPES:
        return _number_by_number(eqn, [_apart(x) for x in inputs])
    return _vmapped(eqn, [_whole(x) for x in inputs])


def _number_by_number(eqn: JaxprEqn, inputs: list[_Apart]) -> list[_Apart]:
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
            return [x.reshape(p["new_sizes"])]
        case "squeeze":
            return [np.squeeze(x, p["dimensions"])]
        case "transpose":
            return [x.transpose(p["permutation"])]
        case "rev":
            return [np.flip(x, p["dimensions"])]
        case "concatenate":
            return [np.concatenate(inputs, p["dimension"])]
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


def _elementwise(eqn: JaxprEqn, inputs: list[_Apart]) -> _Apart:
    def result(*numbers):
        if eqn.primitive.name == "div" and isinstance(numbers[1], np.generic) and numbers[1] == 1:
            return numbers[0]  # `numerics.stored`, in derivatives
        return eqn.primitive.bind(*_alike(numbers), **eqn.params)

    inputs = np.broadcast_arrays(*inputs)
    return _of([result(*numbers) for numbers in zip(*(x.flat for x in inputs), strict=True)], inputs[0].shape)


def _vmapped(eqn: JaxprEqn, inputs: list[_Whole]) -> list[_Whole]:
    """By `jax.vmap`, whatever the equation does."""
    variables = {v: x for v, x in zip(eqn.invars, inputs, strict=True) if not isinstance(v, Literal)}
    function, varies = alone(eqn, variables, eqn.outvars), any(x.varies for x in variables.values())
    if varies:
        function = jax.vmap(function, tuple(-1 if x.varies else None for x in variables.values()), -1)
    return [_Whole(x, varies) for x in function(*(x.x for x in variables.values()))]


def _scan(eqn: JaxprEqn, inputs: list[_Value]) -> list[_Value]:
    p = eqn.params
    first, last = p["num_consts"], p["num_consts"] + p["num_carry"]
    shapes = [v.aval.shape for v in p["jaxpr"].jaxpr.invars[first:last]]
    consts = [
        _apart(x) if v.aval.size <= _LARGEST else x for v, x in zip(eqn.invars[:first], inputs[:first], strict=True)
    ]
    stacks = [_whole(x) for x in inputs[last:]]

    def body(carry, xs):
        """Of the numbers of each array and whole arrays; returns the next ones."""
        xs = [_Whole(x, stack.varies) for x, stack in zip(xs, stacks, strict=True)]
        results = _evaluate(p["jaxpr"], [*consts, *map(_of, carry, shapes), *xs], in_loop=True)
        return [list(_apart(x).flat) for x in results[: len(carry)]], [_whole(x).x for x in results[len(carry) :]]

    def advance(carry, xs):
        after, ys = store_shared(body)(carry, xs)
        return jax.tree.map(lambda old, new: jnp.broadcast_to(new, old.shape), carry, after), ys

    carry, grown = None, [list(map(jnp.asarray, _apart(x).flat)) for x in inputs[first:last]]
    while carry is None or jax.tree.map(jnp.shape, grown) != jax.tree.map(jnp.shape, carry):
        carry = grown  # what is the same in all worlds at first need not stay so
        after, _ = jax.eval_shape(body, carry, [jax.eval_shape(lambda x: x[0], stack.x) for stack in stacks])
        grown = jax.tree.map(lambda x, new: jnp.broadcast_to(x, max(x.shape, new.shape, key=len)), carry, after)
    options = {name: p[name] for name in ("length", "reverse", "unroll")}
    carry, ys = jax.lax.scan(advance, carry, [stack.x for stack in stacks], **options)
    of_ys = zip(ys, eqn.outvars[len(carry) :], strict=True)
    return [*map(_of, carry, shapes), *(_Whole(y, y.ndim > v.aval.ndim) for y, v in of_ys)]


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
