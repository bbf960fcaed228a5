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

    @jax.custom_jvp
    def result(needed: Array, args: tuple[Any, ...]) -> Any:
        shapes = jax.eval_shape(function, *args)
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        return in_chosen_worlds(lambda args: function(*args), lambda worlds: worlds // one_in)(needed, zeros, args)

    @result.defjvp
    def _(primals: tuple, tangents: tuple) -> tuple[Any, Any]:
        needed, args = primals
        _, changes = jax.jvp(function, args, tangents[1])
        return result(needed, args), jax.tree.map(lambda x: jnp.where(needed, x, jnp.zeros_like(x)), changes)

    return lambda needed, *args: result(needed, args)


def in_chosen_worlds(function: Callable[[Any], Any], chunk: Callable[[int], int]) -> Callable[[Array, Any, Any], Any]:
    """Build `(chosen, otherwise, args) -> function(args) if chosen else otherwise`, without derivatives.

    Under `jax.vmap` the chosen worlds are gathered and computed in chunks; `chunk` returns their size for a number of
    worlds. A condition would compute both of its branches in every world.
    """

    @jax.custom_batching.custom_vmap
    def one(chosen: Array, otherwise: Any, args: Any) -> Any:
        return jax.lax.cond(chosen, lambda: function(args), lambda: otherwise)

    @one.def_vmap
    def many(worlds: int, batched: list, chosen: Array, otherwise: Any, args: Any) -> tuple[Any, Any]:
        chosen_varies, otherwise_varies, args_vary = batched
        axes = jax.tree.map(lambda x: 0 if x else None, args_vary)
        otherwise = jax.tree.map(
            lambda x, varies: x if varies else jnp.broadcast_to(x, (worlds, *x.shape)), otherwise, otherwise_varies
        )
        chosen = chosen if chosen_varies else jnp.broadcast_to(chosen, (worlds,))
        count, size = jnp.sum(chosen), min(max(chunk(worlds), 1), worlds)

        def of_chunk(i: Array, found: Any, index: Array) -> Any:
            to = jax.lax.dynamic_slice_in_dim(index, i * size, size)
            at = jnp.minimum(to, worlds - 1)
            inputs = jax.tree.map(lambda x, varies: x[at] if varies else x, args, args_vary)
            new = jax.vmap(function, in_axes=(axes,), axis_size=size)(inputs)
            return jax.tree.map(lambda all, x: all.at[to].set(x, mode="drop"), found, new)

        def of_all(found: Any) -> Any:
            index = jnp.nonzero(chosen, size=worlds + -worlds % size, fill_value=worlds)[0]
            return jax.lax.fori_loop(0, -(-count // size), functools.partial(of_chunk, index=index), found)

        out = jax.lax.cond(count > 0, of_all, lambda found: found, otherwise)
        return out, jax.tree.map(lambda _: True, out)

    return one
