"""Costly functions whose result matters in few of many worlds at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array


def where_needed(function: Callable[..., Any], one_in: int = 64) -> Callable[..., Any]:
    """`(needed, *args) -> function(*args)`, whose result matters only where `needed` () is true.

    Of many worlds, by `jax.vmap`, only those are computed in which it matters; the others get zeros. If it matters in
    more than one of `one_in` worlds, all are computed. It is not differentiable.
    """

    @jax.custom_batching.custom_vmap
    def one(needed: Array, args: tuple[Any, ...]):
        return function(*args)

    @one.def_vmap
    def many(worlds: int, batched: tuple[bool, Any], needed: Array, args: tuple[Any, ...]):
        leaves, structure = jax.tree.flatten(args)
        mapped = jax.tree.leaves(batched[1])
        if not any(mapped):
            raise ValueError(
                "many worlds are given one and the same key, so that all would get the same result; split the key, "
                "jax.random.split(key, worlds), and map over the keys"
            )

        def of(leaves: list[Array]) -> Any:
            return function(*jax.tree.unflatten(structure, leaves))

        every = jax.vmap(of, ([0 if m else None for m in mapped],))
        few = max(worlds // one_in, 1)

        def needed_ones() -> Any:
            index = jnp.nonzero(needed, size=few, fill_value=worlds)[0]
            place = jnp.minimum(index, worlds - 1)
            found = every([leaf[place] if m else leaf for leaf, m in zip(leaves, mapped, strict=True)])
            blank = jax.eval_shape(every, leaves)
            return jax.tree.map(
                lambda all, x: jnp.zeros(all.shape, all.dtype).at[index].set(x, mode="drop"), blank, found
            )

        needed = jnp.broadcast_to(needed, (worlds,))
        out = jax.lax.cond(jnp.sum(needed) <= few, needed_ones, lambda: every(leaves))
        return out, jax.tree.map(lambda _: True, out)

    return lambda needed, *args: one(needed, args)
