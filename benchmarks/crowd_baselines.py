"""Collision avoidance without learning, as policies of `crowd`: control barrier functions and velocity obstacles.

Both fly straight to the goal, as the reward of the task requires, with the smallest change that satisfies their
constraints: a quadratic program in three variables for every drone, solved by qpax. Their observations are those of the
learned policies.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import qpax
from jaxtyping import Array, Float

import jaxdrones as jd
from jaxdrones import rotation
from jaxdrones.control import Setpoint, rates
from jaxdrones.tasks import crossing

_RESPONSE = 4.0  # 1/s, of the velocity
_MAX_ACCELERATION = 6.0  # m/s^2
_SLOW_WITHIN = 0.8  # m of the goal
_MARGIN = 0.06  # m beyond two collision radii
_MAX_RATES = (10.0, 10.0, 5.0)  # rad/s, of the action
_PENALTY = 1e3  # of a violated constraint, over its size


def cbf(pos: Array, vel: Array, own: Array, desired: Array, clear: Array, rate: float = 4.0) -> Array:
    """Acceleration (3,) closest to that towards a desired velocity under exponential control barrier functions.

    h = |p|^2 - clear^2 of every other drone, h'' + 2 rate h' + rate^2 h >= 0, half of which each drone takes on itself
    (Wang, Ames and Egerstedt 2017; Nguyen and Sreenath 2016).

    Args:
        pos: (k, 3) positions of the others, relative, m.
        vel: (k, 3) velocities of the others, relative, m/s.
        own: (3,) velocity, m/s.
        desired: (3,) velocity, m/s.
        clear: distance to keep, m.
        rate: of the barrier, 1/s.
    """
    barrier = jnp.sum(pos**2, axis=-1) - clear**2
    change = 2 * jnp.sum(pos * vel, axis=-1)
    drift = 2 * jnp.sum(vel**2, axis=-1) + 2 * rate * change + rate**2 * barrier
    return _nearest_point(_RESPONSE * (desired - own), 2 * pos, drift / 2)


def velocity_obstacles(pos: Array, vel: Array, own: Array, desired: Array, clear: Array, horizon: float = 1.5) -> Array:
    """Acceleration (3,) towards the velocity closest to a desired one outside of the others' velocity obstacles.

    Optimal reciprocal collision avoidance (van den Berg et al. 2011) in three dimensions, free of collisions for
    `horizon` (s); the other arguments are those of `cbf`.
    """
    normal, step = jax.vmap(functools.partial(_out_of_obstacle, clear=clear, horizon=horizon))(pos, -vel)
    free = _nearest_point(desired, -normal, -jnp.sum(normal * (own + step / 2), axis=-1))
    return _RESPONSE * (free - own)


def _out_of_obstacle(pos: Array, vel: Array, clear: Array, horizon: float) -> tuple[Array, Array]:
    """Outward normal, and smallest change of the relative velocity that leaves the velocity obstacle of a drone.

    Args:
        pos: (3,) of the other one, relative, m.
        vel: (3,) of this one relative to it, m/s.
        clear: distance to keep, m.
        horizon: s; drones that are too close part within a tenth of it.
    """
    near = jnp.sum(pos**2) < clear**2
    horizon = jnp.where(near, horizon / 10, horizon)
    from_center = vel - pos / horizon
    along = jnp.sum(from_center * pos)
    in_front = near | ((along < 0) & (along**2 > clear**2 * jnp.sum(from_center**2)))

    a = jnp.sum(pos**2)
    b = jnp.sum(pos * vel)
    c = jnp.sum(vel**2) - jnp.sum(jnp.cross(pos, vel) ** 2) / jnp.where(near, 1, a - clear**2)
    time = (b + jnp.sqrt(jnp.maximum(b**2 - a * c, 0))) / a
    offset = jnp.where(in_front, from_center, vel - time * pos)
    size = jnp.maximum(jnp.linalg.norm(offset), 1e-6)
    radius = clear * jnp.where(in_front, 1 / horizon, time)
    return offset / size, (radius - size) * offset / size


def _nearest_point(x: Float[Array, "3"], rows: Float[Array, "k 3"], limits: Float[Array, " k"]) -> Float[Array, "3"]:
    """Point nearest to `x` with `rows` @ point <= `limits`, violated as little as possible where there is none."""
    size = jnp.maximum(jnp.linalg.norm(rows, axis=-1), 1e-6)
    solution = qpax.solve_qp_elastic(jnp.eye(3), -x, rows / size[:, None], limits / size, _PENALTY, max_iter=20)
    return jnp.where(jnp.all(jnp.isfinite(solution[0])), solution[0], x)


def policy(avoid: Callable[..., Array], env: jd.envs.Env) -> Callable[[Array], Array]:
    """Policy (n, d) -> (n, 4) of `crowd` that avoids collisions by `cbf` or `velocity_obstacles`."""
    params = jax.tree.map(lambda x: x[0], env.params)
    reach = env.sets[0][-1]

    def act(obs: Array) -> Array:
        goal, matrix, vel, omega, rows = jnp.split(obs, np.cumsum(env.term_sizes)[:-1])
        rows = rows.reshape(-1, env.sets[0][2])
        seen = (jnp.linalg.norm(rows[:, :3], axis=-1) < reach)[:, None]
        pos = jnp.where(seen, rows[:, :3], 1e2)  # too far away for a constraint to matter
        away = jnp.linalg.norm(goal)
        desired = crossing.SPEED * goal / jnp.maximum(away, _SLOW_WITHIN)
        clear = 2 * params.collision_radius + _MARGIN
        acc = avoid(pos, jnp.where(seen, rows[:, 3:6], 0), vel, desired, clear)
        acc = acc * jnp.minimum(1, _MAX_ACCELERATION / jnp.maximum(jnp.linalg.norm(acc), 1e-6))
        quat = rotation.from_matrix(matrix.reshape(3, 3))
        zero = jnp.zeros(3)
        state = jd.State(pos=zero, vel=vel, quat=quat, omega=omega, rpm=jnp.zeros(4))
        thrust, turn = rates.command(rates.gains(), params, state, Setpoint.at(zero, vel=vel, acc=acc))
        beyond_hover = params.mass * thrust - params.weight
        span = jnp.where(beyond_hover > 0, params.max_thrust - params.weight, params.weight)
        return jnp.clip(jnp.concatenate([beyond_hover[None] / span, turn / jnp.array(_MAX_RATES)]), -1, 1)

    return jax.vmap(act)
