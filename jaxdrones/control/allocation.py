"""Control allocation: rotor speeds from thrust and torque, given the geometry of the rotors."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdrones.params import Params
from jaxdrones.vector import components, dot, largest, safe_sqrt

_MIN_SHARE = 0.01  # smallest significant share of a rotor in thrust or yaw; usually each rotor has 0.25
_MOST_LIFT = 400.0  # largest demanded thrust over that of one rotor at `max_rpm`; all larger ones are as infeasible
_OTHERS = tuple(tuple(j for j in range(4) if j != i) for i in range(4))  # the other rotors of each one


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
    roll, pitch, yaw = components(torque)
    yaws = params.km > 0  # otherwise no rotor speeds produce a yaw torque, and its demand is ignored
    yaw = jnp.where(yaws, yaw / jnp.where(yaws, params.km, 1), 0)
    limit = _square_of_limit(params)
    lift = jnp.minimum(thrust / params.kf, _MOST_LIFT * limit)  # beyond it the difference from the limit is rounded
    target = jnp.stack([lift, roll / (params.kf * arm), pitch / (params.kf * arm), yaw])
    inverses = _inverses(jnp.stack([jnp.ones_like(x), y / arm, -x / arm, params.rotor_spin], axis=-1))
    inverse = jnp.stack([rows[-1] for rows in inverses])
    target = _within_authority(inverse, target, limit)
    squares = _non_negative_least_squares(inverses, target)
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
    return jnp.append(target[:3], target[3] - sign * given_up)


def _excess(
    squares: Float[Array, "4"], limit: Float[Array, ""] | float, direction: Float[Array, "4"]
) -> Float[Array, ""]:
    """Step back along a direction until no rotor accelerated by it exceeds the limit, RPM^2."""
    raises = direction > _MIN_SHARE
    beyond = jnp.maximum(squares - limit, 0) / jnp.where(raises, direction, 1)
    return largest(jnp.where(raises, beyond, 0))


def _inverses(wrenches: Float[Array, "4 4"]) -> list[Float[Array, "8 4"]]:
    """Rows of the least-squares inverses of A, the columns of `wrenches`, for every set of rotors.

    They depend only on the vehicle. A row is the squared speed of one rotor per demand, along the part of its wrench
    that the others do not produce: the orthogonalization of Gram and Schmidt.

    Returns:
        For each rotor its row with every set of the other rotors: the first without any, the last with all of them,
        which is a row of the inverse of A. Set k has the rotors whose bits are set, the highest bit first.
    """

    @functools.cache
    def alone(rotor: int, others: tuple[int, ...]) -> Array:
        """Part of a rotor's wrench that is orthogonal to those of others."""
        if not others:
            return wrenches[rotor]
        own, last = alone(rotor, others[:-1]), alone(others[-1], others[:-1])
        return own - dot(own, last) / dot(last, last) * last

    def row(rotor: int, k: int) -> Array:
        part = alone(rotor, tuple(j for bit, j in zip((4, 2, 1), _OTHERS[rotor], strict=True) if k & bit))
        return part / dot(part, part)

    return [jnp.stack([row(rotor, k) for k in range(8)]) for rotor in range(4)]


def _non_negative_least_squares(inverses: list[Float[Array, "8 4"]], target: Float[Array, "4"]) -> Float[Array, "4"]:
    """Minimizer x >= 0 of |A x - b| for a regular A.

    The rotors are added one by one, for every set of later rotors: a new rotor turns if its square is positive together
    with the rotors that turn without it. The minimizer is unique, because the columns of A are independent.
    """
    squares: list[Array] = []  # of the rotors so far, with an axis of length 2 for each later one: at rest or turning
    for rows in inverses:
        own = jnp.reshape(rows @ target, (2, 2, 2))  # by the earlier rotors, then by the later ones
        turns = _choose(own, [x[0] > 0 for x in squares]) > 0
        squares = [_choose(x, [turns]) for x in squares]
        squares.append(_choose(own, [x > 0 for x in squares]))
    return jnp.maximum(jnp.stack(squares), 0)


def _choose(values: Float[Array, "..."], turning: list[Bool[Array, "..."]]) -> Float[Array, "..."]:
    """Entries of the first axes for rotors at rest (0) or turning (1)."""
    for turns in turning:
        rest, turn = values
        values = jnp.where(jnp.broadcast_to(turns, rest.shape), turn, rest)
    return values
