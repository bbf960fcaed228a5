"""Conditional images: computed only in worlds where one is due, also under `vmap` and in gradients."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from jaxdrones.accelerate.where_needed import in_chosen_worlds

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
    of_due = functools.partial(in_chosen_worlds, chunk=lambda _: chunk)

    @jax.custom_vjp
    def select(due, real_before, other_before, real, other):
        return of_due(lambda args: images(*args))(due, (real_before, other_before), (real, other))

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
        to_free = of_due(pulled_back)(due, zeros, (real, other, given))
        to_real = _merge(moved, to_free, [None] * (len(moved) - len(to_free)))
        to_before = [jnp.where(due, jnp.zeros_like(x), x) for x in given]
        return None, to_before, None, to_real, None

    select.defvjp(forward, backward, symbolic_zeros=True)
    return select


def _split(mask: list[bool], leaves: list) -> tuple[list, list]:
    """Split leaves by a mask."""
    return [x for x, m in zip(leaves, mask, strict=True) if m], [x for x, m in zip(leaves, mask, strict=True) if not m]


def _merge(mask: list[bool], chosen: list, others: list) -> list:
    """Inverse of `_split`."""
    first, second = iter(chosen), iter(others)
    return [next(first) if m else next(second) for m in mask]
