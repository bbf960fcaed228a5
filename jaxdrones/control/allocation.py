"""Control allocation: rotor speeds from thrust and torque, given the geometry of the rotors."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.params import Params
from jaxdrones.vector import largest, safe_sqrt

_MIN_SHARE = 0.01  # smallest significant share of a rotor in thrust or yaw; usually each rotor has 0.25
_ACTIVE_SETS = np.array([[i >> k & 1 for k in range(4)] for i in range(16)], bool)  # rotors whose speed is not zero


def mixer(params: Params) -> Float[Array, "4 3"]:
    """Normalized share of each rotor in roll, pitch and yaw: 2y/sum|y|, -2x/sum|x|, spin."""
    x, y, _ = params.rotor_pos.T
    return jnp.stack([2 * y / jnp.sum(jnp.abs(y)), -2 * x / jnp.sum(jnp.abs(x)), params.rotor_spin], axis=-1)


def rpm_from_wrench(params: Params, thrust: Float[Array, ""], torque: Float[Array, "3"]) -> Float[Array, "4"]:
    """Rotor speeds in [0, `max_rpm`] for a thrust (N, body z) and a torque (N m, body), as close as possible.

    A feasible demand is produced exactly. Otherwise yaw torque is reduced first, until no rotor would turn backwards or
    faster than `max_rpm`. Then thrust is reduced if it is too high, and roll and pitch torque keep their direction (the
    priorities of Faessler, Falanga and Scaramuzza 2017). If thrust is too low for roll and pitch, the squared speeds
    are the non-negative least-squares solution of A P^2 = b, with the rows 1, y/L, -x/L, spin of A and
    b = (T/k_F, tau_x/(k_F L), tau_y/(k_F L), tau_z/k_T). With an infinite `max_rpm` they are this solution for every
    demand, as in gym-pybullet-drones, whose allocation has no upper limit. The allocation is differentiable; the
    derivative of a rotor at a limit is zero.
    """
    x, y, _ = params.rotor_pos.T
    arm = params.arm
    matrix = jnp.stack([jnp.ones_like(x), y / arm, -x / arm, params.rotor_spin])
    torque_scale = jnp.stack([params.kf * arm, params.kf * arm, params.km])
    target = jnp.append(thrust / params.kf, torque / torque_scale)
    inverses = _inverses(matrix)
    inverse, limit = inverses[-1], _square_of_limit(params)
    target = _within_authority(inverse, target, limit)
    squares = _non_negative_least_squares(matrix, inverses, target)
    squares = squares - _excess(squares, limit, inverse[:, 0]) * inverse[:, 0]
    return jnp.minimum(safe_sqrt(squares), params.max_rpm)


def _square_of_limit(params: Params) -> Float[Array, ""]:
    """Square of `max_rpm`, RPM^2; infinite, with a zero gradient, for an infinite `max_rpm`."""
    unlimited = jnp.isinf(params.max_rpm)
    return jnp.where(unlimited, jnp.inf, jnp.where(unlimited, 0, params.max_rpm) ** 2)


@jax.checkpoint  # recomputing is cheaper in a backward pass than storing
def _within_authority(
    inverse: Float[Array, "4 4"], target: Float[Array, "4"], limit: Float[Array, ""]
) -> Float[Array, "4"]:
    """Demand with roll and pitch scaled down to the feasible range, then yaw to the remaining range.

    Otherwise least squares would trade thrust for infeasible torques. Without a limit the demand is unchanged.
    """
    turning = inverse[:, 1:3] @ target[1:3]
    exact = inverse @ target
    spread = largest(turning) + largest(-turning)
    spread = jnp.minimum(spread, jnp.maximum(largest(exact), 0) + jnp.maximum(largest(-exact), 0))
    share = 1 / jnp.maximum(spread / jnp.maximum(limit, 1), 1)
    target = jnp.stack([target[0], share * target[1], share * target[2], target[3]])
    squares, sign = inverse @ target, jnp.sign(target[3])
    yaw = sign * inverse[:, 3]
    too_fast = _excess(squares, limit, yaw)
    backwards = jnp.where(jnp.isinf(limit), 0, _excess(-squares, 0.0, -yaw))
    given_up = jnp.minimum(jnp.maximum(too_fast, backwards), jnp.abs(target[3]))
    return target.at[3].add(-sign * given_up)


def _excess(
    squares: Float[Array, "4"], limit: Float[Array, ""] | float, direction: Float[Array, "4"]
) -> Float[Array, ""]:
    """Step back along a direction until no rotor accelerated by it exceeds the limit, RPM^2."""
    raises = direction > _MIN_SHARE
    beyond = jnp.maximum(squares - limit, 0) / jnp.where(raises, direction, 1)
    return largest(jnp.where(raises, beyond, 0))


def _inverses(matrix: Float[Array, "4 4"]) -> Float[Array, "16 4 4"]:
    """Least-squares inverses of A for all sixteen sets of nonzero unknowns; the last one is the inverse of A.

    They depend only on the vehicle.
    """

    def solve_on(active):
        part = matrix * active[None]
        normal = part.T @ part + jnp.diag(1.0 - active)
        return jnp.linalg.solve(normal, part.T)

    return jax.vmap(solve_on)(jnp.asarray(_ACTIVE_SETS, matrix.dtype))


def _non_negative_least_squares(
    matrix: Float[Array, "4 4"], inverses: Float[Array, "16 4 4"], target: Float[Array, "4"]
) -> Float[Array, "4"]:
    """Minimizer x >= 0 of |A x - b| for a regular A: the best non-negative candidate of sixteen."""
    candidates = jnp.swapaxes(inverses, 0, 1) @ target  # (4, 16)
    misses = (matrix[None] @ inverses - jnp.eye(4, dtype=matrix.dtype)[None]) @ jax.lax.stop_gradient(target)
    residuals = jnp.sum(misses**2, axis=-1)
    feasible = jnp.all(candidates >= 0, axis=0)
    return candidates[:, jnp.argmin(jnp.where(feasible, residuals, jnp.inf))]
