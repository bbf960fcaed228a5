"""Numbers that XLA's CPU compiler is made to store."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxdrones.accelerate import compiler


@jax.custom_jvp
def stored(tree: Any) -> Any:
    """The same numbers, which XLA's CPU compiler stores before they are used.

    The compiler would otherwise compute them anew in every expression that reads them, or read them there out of the
    stack of a `scan`, which it does not vectorize. It fuses nothing across a call, so they go through a call that does
    nothing.
    """
    return compiler.set_notes(_same(tree), inlineable="false") if jax.default_backend() == "cpu" else tree


@jax.custom_jvp
def stored_for_derivatives(tree: Any) -> Any:
    """The same numbers, which are stored only where derivatives are taken."""
    return tree


_same = jax.jit(lambda tree: tree)


@stored.defjvp
@stored_for_derivatives.defjvp
def _by_quotient(tree, tangent):
    """Derivatives are stored by a division by one, which takes less than a call.

    The compiler stores a quotient that is used several times, and sees too late that the divisor is one.
    """

    def quotient(x):
        if not jnp.issubdtype(x.dtype, jnp.inexact):
            return x
        return x / jax.lax.optimization_barrier(jnp.ones((), x.dtype))

    return jax.jvp(lambda tree: jax.tree.map(quotient, tree), tree, tangent)
