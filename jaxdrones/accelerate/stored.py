"""Numbers that XLA's CPU compiler is made to store."""

import jax
import jax.numpy as jnp

from jaxdrones.accelerate import compiler


@jax.custom_jvp
def stored(tree):
    """The same numbers, which XLA's CPU compiler stores before they are used.

    It would otherwise compute them anew in every expression that reads them, or read them there out of the stack of a
    `scan`, which it does not vectorise. It fuses nothing across a call: so they go through one that does nothing.
    """
    return compiler.set_notes(_same(tree), inlineable="false") if jax.default_backend() == "cpu" else tree


@jax.custom_jvp
def stored_for_derivatives(tree):
    """The same numbers, stored where derivatives are taken."""
    return tree


_same = jax.jit(lambda tree: tree)


@stored.defjvp
@stored_for_derivatives.defjvp
def _by_quotient(tree, tangent):
    """A gradient by rk4 takes 240 ns a step with it, 400 with calls.

    A quotient that is used several times is stored, and the compiler sees too late that the divisor is one.
    """

    def quotient(tree):
        return jax.tree.map(lambda x: x / jax.lax.optimization_barrier(jnp.ones((), x.dtype)), tree)

    return jax.jvp(quotient, tree, tangent)
