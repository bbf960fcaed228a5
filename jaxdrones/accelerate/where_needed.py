"""Functions that are computed only in the worlds in which they are needed, and so are their derivatives.

Under `jax.vmap` a condition computes both of its branches in every world. The primitive here keeps one program of one
world under `jax.vmap` and under derivatives, and gathers the worlds when it is compiled.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones.accelerate import compiler


@jax.custom_batching.custom_vmap
def in_all_worlds(holds: Array) -> Array:
    """Whether a condition () holds, under `jax.vmap` in all worlds: a branch on it remains one under `vmap`."""
    return holds


@in_all_worlds.def_vmap
def _in_all_worlds(worlds: int, batched: list[bool], holds: Array) -> tuple[Array, bool]:
    return in_all_worlds(jnp.all(holds)), False


def where_needed(function: Callable[..., Any], one_in: int = 64, chunk: int | None = None) -> Callable[..., Any]:
    """Build `(needed, *args, otherwise=None) -> function(*args)`, with `otherwise` or zeros where `needed` () is false.

    Under `jax.vmap` only worlds with `needed` are computed, in chunks of `chunk` worlds, or of all worlds / `one_in`.
    Derivatives are those of the function of arrays where it is needed, else those of `otherwise`, and are computed only
    in these worlds, too; in reverse mode the function is recomputed.
    """

    def where(needed: Array, *args: Any, otherwise: Any = None) -> Any:
        if not compiler.AVAILABLE:
            found = function(*args)
            rest = jax.tree.map(jnp.zeros_like, found) if otherwise is None else otherwise
            return jax.tree.map(functools.partial(jnp.where, needed), found, rest)
        program, consts, shape = compiler.trace(function, *args)
        rest = () if otherwise is None else jax.tree.leaves(jax.tree.map(_of_type, otherwise, shape))
        inputs = [*consts, *map(jnp.asarray, jax.tree.leaves(args))]
        params = dict(mapped=(False,) * len(inputs), worlds=None, one_in=one_in, chunk=chunk)
        out = _where.bind(jnp.asarray(needed), *rest, *inputs, program=program, rest=len(rest), **params)
        return jax.tree.unflatten(jax.tree.structure(shape), out)

    return where


def _of_type(value: Any, shape: jax.ShapeDtypeStruct) -> Array:
    return jnp.asarray(value, shape.dtype)


def _computed(
    needed: Array, *inputs: Array, program: Any, rest: int, mapped: tuple, worlds: int | None, **of_chunk: Any
) -> list:
    evaluate, otherwise, inputs = _function(program), list(inputs[:rest]), inputs[rest:]
    otherwise = otherwise or [jnp.zeros(x.shape, x.dtype) for x in _results(program, worlds)]
    if worlds is None:
        return jax.lax.cond(needed, lambda: evaluate(*inputs), lambda: otherwise)
    count, size = jnp.sum(needed), _chunk(worlds, **of_chunk)
    every = jax.vmap(evaluate, [0 if varies else None for varies in mapped], axis_size=size)

    def of_needed() -> list:
        index = jnp.nonzero(needed, size=worlds + -worlds % size, fill_value=worlds)[0]

        def advance(i: Array, found: list) -> list:
            to = jax.lax.dynamic_slice_in_dim(index, i * size, size)
            at = jnp.minimum(to, worlds - 1)
            new = every(*(x[at] if varies else x for x, varies in zip(inputs, mapped, strict=True)))
            return [all.at[to].set(x, mode="drop") for all, x in zip(found, new, strict=True)]

        return jax.lax.fori_loop(0, -(-count // size), advance, otherwise)

    return jax.lax.cond(count > 0, of_needed, lambda: otherwise)


def _chunk(worlds: int, one_in: int, chunk: int | None) -> int:
    return min(chunk or max(worlds // one_in, 1), worlds)


def _results(program: Any, worlds: int | None) -> list[jax.ShapeDtypeStruct]:
    leading = () if worlds is None else (worlds,)
    return [jax.ShapeDtypeStruct((*leading, *v.aval.shape), v.aval.dtype) for v in program.outvars]


def _at_once(needed: Array, *inputs: Array, **params: Any) -> list[Array]:
    if params["worlds"] is None and needed:
        return _function(params["program"])(*inputs[params["rest"] :])
    return jax.jit(functools.partial(_computed, **params))(needed, *inputs)


def _shapes(needed: Any, *inputs: Any, program: Any, worlds: int | None, **_: Any) -> list[Any]:
    return [jax.core.ShapedArray(x.shape, x.dtype) for x in _results(program, worlds)]


def _batched(args: Sequence, dims: Sequence, *, rest: int, mapped: tuple, worlds: int | None, **params: Any) -> tuple:
    """More worlds: an axis over worlds, or one over worlds of worlds, which becomes part of it."""
    size = next(x.shape[dim] for x, dim in zip(args, dims, strict=True) if dim is not None)

    def leading(x: Array, dim: int | None, varies: bool) -> Array:
        x = x[None] if dim is None else jnp.moveaxis(x, dim, 0)
        if worlds is None:
            return jnp.broadcast_to(x, (size, *x.shape[1:]))
        x = x if varies else x[:, None]
        return jnp.broadcast_to(x, (size, worlds, *x.shape[2:])).reshape(size * worlds, *x.shape[2:])

    always = 1 + rest
    was = (worlds is not None,) * always + mapped
    varying = (True,) * always + tuple(v or dim is not None for v, dim in zip(mapped, dims[always:], strict=True))
    operands = [
        leading(x, dim, varied) if varies else x
        for x, dim, varied, varies in zip(args, dims, was, varying, strict=True)
    ]
    out = _where.bind(*operands, rest=rest, mapped=varying[always:], worlds=size * (worlds or 1), **params)
    if worlds is not None:
        out = [x.reshape(size, worlds, *x.shape[1:]) for x in out]
    return out, [0] * len(out)


def _differentiated(
    primals: Sequence, tangents: Sequence, *, program: Any, rest: int, mapped: tuple, **params: Any
) -> tuple:
    """Results, and their changes by the program of the changes of one world."""
    out = _where.bind(*primals, program=program, rest=rest, mapped=mapped, **params)
    needed, inputs = primals[0], primals[1 + rest :]
    of_otherwise, changes = tangents[1 : 1 + rest], tangents[1 + rest :]
    moving = [i for i, change in enumerate(changes) if not compiler.is_zero(change)]
    smooth = [i for i, x in enumerate(out) if jnp.issubdtype(x.dtype, jnp.inexact)]
    evaluate = _function(program)

    def changed(inputs: list, changes: list) -> list:
        def of_moving(*moved: Array) -> list:
            results = evaluate(*_replaced(inputs, moving, moved))
            return [results[i] for i in smooth]

        if not changes:
            return [jnp.zeros_like(x) for x in of_moving()]
        return jax.jvp(of_moving, [inputs[i] for i in moving], changes)[1]

    shapes = _inputs(program)
    linear, consts, _ = compiler.trace(changed, shapes, [shapes[i] for i in moving])
    still = all(map(compiler.is_zero, of_otherwise))
    kept = [] if still else [compiler.instantiated(of_otherwise[i]) for i in smooth]
    operands = [*kept, *consts, *inputs, *(changes[i] for i in moving)]
    mapped = (*(False for _ in consts), *mapped, *(mapped[i] for i in moving))
    found = _where.bind(needed, *operands, program=linear, rest=len(kept), mapped=mapped, **params)
    return out, _replaced([compiler.zero_of(x) for x in out], smooth, found)


def _transposed(
    given: Sequence, needed: Array, *inputs: Any, program: Any, rest: int, mapped: tuple, **params: Any
) -> list:
    """Cotangents of `otherwise`, and of the inputs in which the program is linear."""
    otherwise, inputs = inputs[:rest], inputs[rest:]
    linear = [i for i, x in enumerate(inputs) if compiler.is_linear(x)]
    known = [i for i in range(len(inputs)) if i not in linear]
    used = [i for i, x in enumerate(given) if not compiler.is_zero(x)]
    evaluate, shapes, results = _function(program), _inputs(program), _results(program, None)

    def pulled_back(values: list, given: list) -> list:
        def of_linear(*moved: Array) -> list:
            found = evaluate(*_replaced(_replaced([None] * len(inputs), known, values), linear, moved))
            return [found[i] for i in used]

        return jax.linear_transpose(of_linear, *(shapes[i] for i in linear))(given)

    back, consts, _ = compiler.trace(pulled_back, [shapes[i] for i in known], [results[i] for i in used])
    operands = [*consts, *(inputs[i] for i in known), *(given[i] for i in used)]
    has_worlds = params["worlds"] is not None
    varying = (*(False for _ in consts), *(mapped[i] for i in known), *(has_worlds for _ in used))
    found = _where.bind(needed, *operands, program=back, rest=0, mapped=varying, **params)
    found = [x.sum(axis=0) if has_worlds and not mapped[i] else x for i, x in zip(linear, found, strict=True)]
    of_otherwise = [
        _unneeded(needed, given[i]) if compiler.is_linear(x) and i in used else None for i, x in enumerate(otherwise)
    ]
    return [None, *of_otherwise, *_replaced([None] * len(inputs), linear, found)]


def _unneeded(needed: Array, value: Array) -> Array:
    """A value where the function is not needed, else zero."""
    return jnp.where(jnp.expand_dims(needed, range(needed.ndim, value.ndim)), 0, value)


def _function(program: Any) -> Callable[..., list]:
    """Function of closed-over values and inputs."""
    closed_over = len(program.constvars)
    return lambda *inputs: compiler.as_function(program, inputs[:closed_over])(*inputs[closed_over:])


def _inputs(program: Any) -> list[jax.ShapeDtypeStruct]:
    variables = (*program.constvars, *program.invars)
    return [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in variables]


def _replaced(values: Sequence, places: Sequence[int], others: Sequence) -> list:
    new = list(values)
    for i, x in zip(places, others, strict=True):
        new[i] = x
    return new


if compiler.AVAILABLE:
    _where = compiler.primitive("where_needed", _computed, _at_once, _shapes, _batched, _differentiated, _transposed)
    """Operands are `needed`, `rest` results where it is false, and the inputs of `program`. Inputs that are `mapped`,
    and all other operands and results, have a leading axis over `worlds`. Without worlds (`None`) nothing has it."""
