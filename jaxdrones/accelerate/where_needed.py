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

from jaxdrones.accelerate import compiler, one_world


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
        program, consts, shape = compiler.trace_open(function, *args)
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
    otherwise, inputs = list(inputs[:rest]), inputs[rest:]
    otherwise = otherwise or [jnp.zeros(x.shape, x.dtype) for x in one_world.shapes_of(program.outvars, worlds)]
    if worlds is None:
        evaluate = compiler.as_function(program, ())
        return jax.lax.cond(needed, lambda: evaluate(*inputs), lambda: otherwise)
    count, size = jnp.sum(needed), _chunk(worlds, **of_chunk)
    every = one_world.by_vmap(program, mapped, size)

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


def _at_once(needed: Array, *inputs: Array, **params: Any) -> list[Array]:
    if params["worlds"] is None and needed:
        return compiler.as_function(params["program"], ())(*inputs[params["rest"] :])
    return jax.jit(functools.partial(_computed, **params))(needed, *inputs)


def _shapes(needed: Any, *inputs: Any, program: Any, worlds: int | None, **_: Any) -> list[Any]:
    return one_world.abstract(program.outvars, worlds)


def _batched(
    operands: Sequence, axes: Sequence, *, rest: int, mapped: tuple, worlds: int | None, **params: Any
) -> tuple:
    """More worlds: an axis over worlds, or one over worlds of worlds, which becomes part of it."""
    always = 1 + rest
    was = (worlds is not None,) * always + mapped
    operands, varying, size = one_world.in_more_worlds(operands, axes, was, always, worlds)
    results = _where.bind(*operands, rest=rest, mapped=varying[always:], worlds=size * (worlds or 1), **params)
    return one_world.of_worlds(results, worlds, size)


def _differentiated(
    primals: Sequence, tangents: Sequence, *, program: Any, rest: int, mapped: tuple, **params: Any
) -> tuple:
    """Results and their tangents, computed by the differentiated program of one world."""
    results = _where.bind(*primals, program=program, rest=rest, mapped=mapped, **params)
    needed, inputs = primals[0], primals[1 + rest :]
    of_otherwise, changes = tangents[1 : 1 + rest], tangents[1 + rest :]
    operands, of_changes, smooth = one_world.differentiated(program, mapped, inputs, changes, results)
    still = all(map(compiler.is_zero, of_otherwise))
    kept = [] if still else [compiler.instantiated(of_otherwise[i]) for i in smooth]
    found = _where.bind(needed, *kept, *operands, rest=len(kept), **of_changes, **params)
    return results, one_world.replaced([compiler.zero_of(x) for x in results], smooth, found)


def _transposed(
    given: Sequence, needed: Array, *inputs: Any, program: Any, rest: int, mapped: tuple, **params: Any
) -> list:
    """Cotangents of `otherwise`, and of the inputs in which the program is linear."""
    otherwise, inputs = inputs[:rest], inputs[rest:]
    operands, of_cotangents, of_inputs = one_world.transposed(program, mapped, params["worlds"], inputs, given)
    found = _where.bind(needed, *operands, rest=0, **of_cotangents, **params)
    unneeded = [
        _unneeded(needed, x) if compiler.is_linear(other) and not compiler.is_zero(x) else None
        for other, x in zip(otherwise, given[:rest], strict=True)
    ]
    return [None, *unneeded, *of_inputs(found)]


def _unneeded(needed: Array, value: Array) -> Array:
    """A value where the function is not needed, else zero."""
    return jnp.where(jnp.expand_dims(needed, range(needed.ndim, value.ndim)), 0, value)


if compiler.AVAILABLE:
    _where = compiler.primitive("where_needed", _computed, _at_once, _shapes, _batched, _differentiated, _transposed)
    """Operands are `needed`, `rest` results where it is false, and the inputs of `program`. Inputs that are `mapped`,
    and all other operands and results, have a leading axis over `worlds`. Without worlds (`None`) nothing has it."""
