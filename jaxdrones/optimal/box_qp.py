"""Small quadratic programs with bounds."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

_ITERATIONS = 6
_STEP_SIZES = tuple(0.4**k for k in range(6))


def box_qp(
    hessian: Float[Array, "m m"], gradient: Float[Array, " m"], low: Float[Array, " m"], high: Float[Array, " m"]
) -> tuple[Float[Array, " m"], Bool[Array, " m"]]:
    """Minimize x H x / 2 + g x between bounds, by projected Newton steps (Tassa, Mansard, Todorov 2014, algorithm 1).

    H is symmetric and positive. Return the minimizer (m,), and the mask of its free components, between their bounds.
    """
    sizes = jnp.asarray(_STEP_SIZES, gradient.dtype)

    def cost(x: Array) -> Array:
        return x @ (hessian @ x) / 2 + gradient @ x

    def free_at(x: Array) -> tuple[Array, Array]:
        slope = gradient + hessian @ x
        return slope, ~(((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0)))

    def newton(x: Array, _: None) -> tuple[Array, None]:
        slope, free = free_at(x)
        step = -solve_free(hessian, slope, free)
        tried = jax.vmap(lambda size: jnp.clip(x + size * step, low, high))(sizes)
        costs = jax.vmap(cost)(tried)
        best = jnp.argmin(costs)
        return jnp.where(costs[best] < cost(x), tried[best], x), None

    x, _ = jax.lax.scan(newton, jnp.clip(jnp.zeros_like(gradient), low, high), length=_ITERATIONS)
    return x, free_at(x)[1]


def solve_free(hessian: Float[Array, "m m"], right: Float[Array, "m *n"], free: Bool[Array, " m"]) -> Array:
    """Solution of H x = right in the free components, zero in the others."""
    both = free[:, None] & free[None, :]
    part = jnp.where(both, hessian, jnp.eye(len(hessian), dtype=hessian.dtype))
    return jnp.linalg.solve(part, jnp.where(free.reshape(-1, *[1] * (right.ndim - 1)), right, 0))
