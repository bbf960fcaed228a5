"""Thrust and torque -> rotor speeds, from the geometry of the rotors."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.checks import check_shape
from jaxdrones.numerics import safe_sqrt
from jaxdrones.params import Params

_ACTIVE_SETS = np.array([[i >> k & 1 for k in range(4)] for i in range(16)], bool)  # which rotors turn


def mixer(params: Params) -> Float[Array, "4 3"]:
    """Normalised share of each rotor in roll, pitch and yaw: 2y/sum|y|, -2x/sum|x|, spin."""
    x, y, _ = params.rotor_pos.T
    return jnp.stack([2 * y / jnp.sum(jnp.abs(y)), -2 * x / jnp.sum(jnp.abs(x)), params.rotor_spin], axis=-1)


def rpm_from_wrench(params: Params, thrust: Float[Array, ""], torque: Float[Array, "3"]) -> Float[Array, "4"]:
    """Rotor speeds that produce a thrust (N, body z) and a torque (N m, body), as nearly as rotors that only push can.

    Where the exact inverse asks for a negative thrust it is the non-negative least-squares solution of
    A P^2 = b, with rows 1, y/L, -x/L, spin and b = (T/k_F, tau_x/(k_F L), tau_y/(k_F L), tau_z/k_T). There is no
    upper limit. Differentiable; where a rotor is held at zero its derivative is zero.

    Raises:
        ValueError: arrays of a team (use `jax.vmap`).
    """
    check_shape("thrust", thrust, (), "one number for one drone; use jax.vmap for a team")
    check_shape("torque", torque, (3,), "a vector for one drone; use jax.vmap for a team")
    x, y, _ = params.rotor_pos.T
    arm = params.arm
    matrix = jnp.stack([jnp.ones_like(x), y / arm, -x / arm, params.rotor_spin])
    torque_scale = jnp.stack([params.kf * arm, params.kf * arm, params.km])
    target = jnp.append(thrust / params.kf, torque / torque_scale)
    return safe_sqrt(_non_negative_least_squares(matrix, target))


def _non_negative_least_squares(matrix: Float[Array, "4 4"], target: Float[Array, "4"]) -> Float[Array, "4"]:
    """The x >= 0 that minimises |A x - b| for a regular A, by trying all sixteen sets of positive unknowns.

    The minimum is the best of the least-squares solutions on each set among those that are not negative. The
    exact inverse is the full set with residual zero. The sixteen inverses depend on the vehicle alone, so they are
    computed once however many drones of that vehicle there are.
    """

    def solve_on(active):
        part = matrix * active[None]
        normal = part.T @ part + jnp.diag(1.0 - active)
        return jnp.linalg.solve(normal, part.T)

    active_sets = jnp.asarray(_ACTIVE_SETS, matrix.dtype)
    candidates = jax.vmap(solve_on)(active_sets) @ target
    residuals = jnp.sum((candidates @ matrix.T - target[None]) ** 2, axis=-1)
    feasible = jnp.all(candidates >= 0, axis=-1)
    return candidates[jnp.argmin(jnp.where(feasible, residuals, jnp.inf))]
