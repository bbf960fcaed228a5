"""Functions that stay differentiable where the usual ones do not."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def safe_sqrt(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The square root of what is positive; zero, with a zero gradient, elsewhere."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)
