"""Conditional computation of costly functions in many worlds."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array


@jax.custom_batching.custom_vmap
def in_all_worlds(holds: Array) -> Array:
    """Whether a condition () holds, under `jax.vmap` in all worlds: a branch on it remains one under `vmap`."""
    return holds


@in_all_worlds.def_vmap
def _in_all_worlds(worlds: int, batched: list[bool], holds: Array) -> tuple[Array, bool]:
    return in_all_worlds(jnp.all(holds)), False


def where_needed(function: Callable[..., Any], one_in: int = 64) -> Callable[..., Any]:
    """Build `(needed, *args) -> function(*args)`, with zeros where `needed` () is false.

    Under `jax.vmap` only worlds with `needed` are computed, in chunks of one in `one_in`. Derivatives are those of the
    function where it is needed, else zero; they are computed in every world.
    """

    @jax.custom_batching.custom_vmap
    def one(needed: Array, args: tuple[Any, ...]):
        return function(*args)

    @one.def_vmap
    def many(worlds: int, batched: tuple[bool, Any], needed: Array, args: tuple[Any, ...]):
        leaves, structure = jax.tree.flatten(args)
        mapped = jax.tree.leaves(batched[1])
        if not any(mapped):
            return function(*args), jax.tree.map(lambda _: False, jax.eval_shape(function, *args))

        def of(leaves: list[Array]) -> Any:
            return function(*jax.tree.unflatten(structure, leaves))

        every = jax.vmap(of, ([0 if m else None for m in mapped],))
        needed = jnp.broadcast_to(needed, (worlds,))
        count, size = jnp.sum(needed), max(worlds // one_in, 1)

        def some(i: Array, found: Any, index: Array) -> Any:
            to = jax.lax.dynamic_slice_in_dim(index, i * size, size)
            at = jnp.minimum(to, worlds - 1)
            new = every([leaf[at] if m else leaf for leaf, m in zip(leaves, mapped, strict=True)])
            return jax.tree.map(lambda all, x: all.at[to].set(x, mode="drop"), found, new)

        def compute(zeros: Any) -> Any:
            index = jnp.nonzero(needed, size=worlds + -worlds % size, fill_value=worlds)[0]
            return jax.lax.fori_loop(0, -(-count // size), functools.partial(some, index=index), zeros)

        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(every, leaves))
        out = jax.lax.cond(count > 0, compute, lambda zeros: zeros, zeros)
        return out, jax.tree.map(lambda _: True, out)

    @jax.custom_jvp
    def result(needed: Array, args: tuple[Any, ...]) -> Any:
        return one(needed, args)

    @result.defjvp
    def _(primals: tuple, tangents: tuple) -> tuple[Any, Any]:
        needed, args = primals
        _, changes = jax.jvp(function, args, tangents[1])
        return result(needed, args), jax.tree.map(lambda x: jnp.where(needed, x, jnp.zeros_like(x)), changes)

    return lambda needed, *args: result(needed, args)
