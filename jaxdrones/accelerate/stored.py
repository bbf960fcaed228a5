"""Forced storage of intermediate results with XLA's CPU compiler."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxdrones.accelerate import compiler


@jax.custom_jvp
def stored(tree: Any) -> Any:
    """Identity that forces XLA's CPU compiler to store its result.

    The compiler would otherwise recompute it in every expression, or read it from the stack of a `scan`, which is not
    vectorized. It does not fuse across calls, so this is an empty call.
    """
    return compiler.set_notes(_same(tree), inlineable="false") if compiler.is_cpu() else tree


@jax.custom_jvp
def stored_for_derivatives(tree: Any) -> Any:
    """Identity that forces storage only under differentiation."""
    return tree


_same = jax.jit(lambda tree: tree)


@stored.defjvp
@stored_for_derivatives.defjvp
def _by_quotient(tree, tangent):
    """Identity with derivatives stored by a division by one, which is cheaper than a call.

    The compiler stores a quotient with several uses, before it simplifies the division.
    """

    def quotient(x):
        if not jnp.issubdtype(x.dtype, jnp.inexact):
            return x
        return x / jax.lax.optimization_barrier(jnp.ones((), x.dtype))

    return jax.jvp(lambda tree: jax.tree.map(quotient, tree), tree, tangent)
