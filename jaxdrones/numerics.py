"""Functions that stay differentiable where the usual ones do not."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def safe_sqrt(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The square root; zero, with a zero gradient, of what is not positive. What is not a number stays so."""
    none = x <= 0
    return jnp.where(none, 0, jnp.sqrt(jnp.where(none, 1, x)))
