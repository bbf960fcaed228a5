"""Conditional images: computed only in worlds where one is due, also under `vmap` and in gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

Draw = Callable[..., Any]


def where_due(draw: Draw, chunk: int) -> Draw:
    """Build `f(due, before, *args)`, `draw(*args)` where due and `before` elsewhere, at the cost of the due worlds.

    Under `jax.vmap` a condition computes both of its branches in every world. This function gathers the worlds where
    `due` holds and computes only those, in chunks. Gradients are those of `jnp.where`, in reverse mode, at the cost of
    one recomputation; unused gradients are not computed.

    Args:
        draw: pure function of arrays with a result of the type of `before`.
        chunk: number of worlds per chunk.
    """

    def f(due: Array, before: Any, *args: Any) -> Any:
        leaves, structure = jax.tree.flatten(args)
        kept, kept_structure = jax.tree.flatten(before)
        differentiable = [jnp.issubdtype(x.dtype, jnp.inexact) for x in leaves]
        shown = [jnp.issubdtype(x.dtype, jnp.inexact) for x in kept]

        def images(real: list, other: list) -> tuple[list, list]:
            """Images of real numbers, and of integers."""
            leaves = map(jnp.asarray, _merge(differentiable, real, other))  # constants arrive as Python numbers
            drawn = jax.tree.leaves(draw(*jax.tree.unflatten(structure, leaves)))
            return _split(shown, drawn)

        out = _selected(images, chunk)(due, *_split(shown, kept), *_split(differentiable, leaves))
        return jax.tree.unflatten(kept_structure, _merge(shown, *out))

    return f


def _selected(images: Callable, chunk: int) -> Callable:
    """`(due, real images, other images, real arguments, other arguments) -> real and other images`, lists each."""

    @jax.custom_vjp
    def select(due, real_before, other_before, real, other):
        return _of_due(lambda args: images(*args), chunk)(due, (real_before, other_before), (real, other))

    def forward(due, real_before, other_before, real, other):
        values = jax.tree.map(lambda x: x.value, (due, real_before, other_before, real, other))
        moved = [() if x.perturbed else None for x in real]  # in the structure: no number of a program
        return select(*values), (values[0], values[3], values[4], moved)

    def backward(residuals, cotangents):
        due, real, other, moved = residuals
        moved = [x is not None for x in moved]
        given, _ = cotangents
        given = [jnp.zeros(x.shape, x.dtype) if isinstance(x, SymbolicZero) else x for x in given]

        def pulled_back(args):
            real, other, given = args
            fixed, free = _split(moved, real)[::-1]
            _, pull_back = jax.vjp(lambda free: images(_merge(moved, free, fixed), other)[0], free)
            return pull_back(given)[0]

        free = _split(moved, real)[0]
        zeros = [jnp.zeros(x.shape, x.dtype) for x in free]
        to_free = _of_due(pulled_back, chunk)(due, zeros, (real, other, given))
        to_real = _merge(moved, to_free, [None] * (len(moved) - len(to_free)))
        to_before = [jnp.where(due, jnp.zeros_like(x), x) for x in given]
        return None, to_before, None, to_real, None

    select.defvjp(forward, backward, symbolic_zeros=True)
    return select


def _of_due(draw: Callable[[Any], Any], chunk: int) -> Callable:
    """`(due, before, args) -> draw(args) where due, else before`, without gradients."""

    @jax.custom_batching.custom_vmap
    def one(due, before, args):
        return jax.lax.cond(due, lambda: draw(args), lambda: before)

    @one.def_vmap
    def many(worlds, batched, due, before, args):
        due_batched, before_batched, args_batched = batched
        axes = jax.tree.map(lambda x: 0 if x else None, args_batched)
        every = jax.vmap(draw, in_axes=(axes,), axis_size=worlds)
        before = jax.tree.map(lambda x, b: x if b else jnp.broadcast_to(x, (worlds, *x.shape)), before, before_batched)
        out_batched = jax.tree.map(lambda _: True, before)
        if not due_batched:
            return jax.lax.cond(due, lambda: every(args), lambda: before), out_batched
        size = min(chunk, worlds)
        count = jnp.sum(due)
        index = jnp.nonzero(due, size=worlds + -worlds % size, fill_value=worlds)[0]

        def of_chunk(i, images):
            to = jax.lax.dynamic_slice_in_dim(index, i * size, size)
            at = jnp.minimum(to, worlds - 1)
            chosen = jax.tree.map(lambda x, b: x[at] if b else x, args, args_batched)
            drawn = jax.vmap(draw, in_axes=(axes,), axis_size=size)(chosen)
            return jax.tree.map(lambda image, new: image.at[to].set(new, mode="drop"), images, drawn)

        return jax.lax.fori_loop(0, -(-count // size), of_chunk, before), out_batched

    return one


def _split(mask: list[bool], leaves: list) -> tuple[list, list]:
    """Split leaves by a mask."""
    return [x for x, m in zip(leaves, mask, strict=True) if m], [x for x, m in zip(leaves, mask, strict=True) if not m]


def _merge(mask: list[bool], chosen: list, others: list) -> list:
    """Inverse of `_split`."""
    first, second = iter(chosen), iter(others)
    return [next(first) if m else next(second) for m in mask]
