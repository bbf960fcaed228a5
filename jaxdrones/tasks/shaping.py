"""Shared parts of tasks: a target, terminations, and reward terms, all smooth for gradient-based learners."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdrones import rotation
from jaxdrones.control import Setpoint
from jaxdrones.params import Params
from jaxdrones.quantity import described
from jaxdrones.sensing import Scene
from jaxdrones.tasks.task import Condition, Task, Term, World, norm, square

MAX_SPIN = 100.0  # rad/s; an episode in which a drone turns faster is terminated
_NEAR, _FAR = 0.02, 3.0  # m: the position term is a parabola below the first, and levels off beyond the second
_PRECISE, _CALM = 0.1, 0.2  # m, m/s: the reward near the target falls by a factor of e over each
_STILL = 0.02  # m/s; below, its exponent is a parabola
_SLOW = 0.1  # m/s; below, the velocity term is a parabola
_SLOW_TURN = 1.0  # rad/s; below, the term of the body rates is a parabola
_STEEP = 0.1  # length of the nose's level part below which there is no heading
_CROWDED = 0.4  # m, distance of the nearest drone below which the reward falls
_MARGIN = 0.2  # m between a drone and an obstacle beside it
_SOFTNESS = 0.1  # m, over which the margin begins


def goal(variables: dict[str, Array], t: Array) -> Setpoint:
    """Goal."""
    return Setpoint.at(variables["goal"])


def length(v: Float[Array, "n 3"], small: float) -> Float[Array, " n"]:
    """Smoothed length of every row, quadratic below about `small`."""
    return jnp.sqrt(square(v) + small**2) - small


def caught_up(metric: Float[Array, "T n"], seconds: float, dt: float) -> Float[Array, "t n"]:
    """Metric of an episode without its first seconds, or of its last step in a shorter one."""
    return metric[min(round(seconds / dt), len(metric) - 1) :]


def alive(task: Task, world: World) -> Float[Array, " n"]:
    """One in every step."""
    return jnp.ones_like(world.drones.pos[:, 0])


def position(task: Task, world: World) -> Float[Array, " n"]:
    """Distance from the target, m; it levels off far away."""
    distance = length(world.drones.pos - task.target_now(world).pos, _NEAR)
    return distance / (1 + distance / _FAR)


def near(task: Task, world: World) -> Float[Array, " n"]:
    """exp(-distance / 10 cm - speed / 0.2 m/s) relative to the target; steep near the target and at rest."""
    target = task.target_now(world)
    distance = length(world.drones.pos - target.pos, _NEAR)
    speed = length(world.drones.vel - target.vel, _STILL)
    return jnp.exp(-distance / _PRECISE - speed / _CALM)


def velocity(task: Task, world: World) -> Float[Array, " n"]:
    """Speed relative to the target, m/s."""
    return length(world.drones.vel - task.target_now(world).vel, _SLOW)


def body_rates(task: Task, world: World) -> Float[Array, " n"]:
    """Magnitude of the body rates, rad/s; quadratic where they are small."""
    return length(world.drones.omega, _SLOW_TURN)


def heading(task: Task, world: World) -> Float[Array, " n"]:
    """One minus the cosine of the heading."""

    def of_drone(quat: Array) -> Array:
        east, north, _ = rotation.axes(quat)[0]
        return 1 - east / jnp.sqrt(east**2 + north**2 + _STEEP**2)

    return jax.vmap(of_drone)(world.drones.quat)


def gap(params: Params, pos: Float[Array, "n 3"], scene: Scene) -> Float[Array, " n"]:
    """Distance of every drone's center from the nearest obstacle or the ground, less its collision radius, m."""
    return jax.vmap(scene.distance)(pos) - params.collision_radius


def clearance(margin_time: float = 0.1) -> Term:
    """Term of the smoothed penetration of the margin around obstacles and ground, m.

    Margin and term grow with the closing speed, as in the cost of DiffPhysDrone ("Back to Newton's laws", 2024): a
    drone needs more distance the faster it approaches an obstacle, and none if it flies past it.

    `margin_time` is the growth of the margin with the closing speed, s.
    """

    def term(task: Task, world: World) -> Float[Array, " n"]:
        """Smoothed penetration of the margin around obstacles and ground, m; it grows with the closing speed."""

        def of_drone(radius: Array, pos: Array, vel: Array) -> Array:
            away, rate = jax.jvp(world.scene.distance, (pos,), (vel,))
            closing = jnp.maximum(-rate, 0)
            inside = _MARGIN + margin_time * closing - (away - radius)
            return (1 + closing) * _SOFTNESS * jax.nn.softplus(inside / _SOFTNESS)

        return jax.vmap(of_drone)(world.params.collision_radius, world.drones.pos, world.drones.vel)

    return term


def velocity_to_target(task: Task, world: World, speed: float, slow_within: float) -> Float[Array, "n 3"]:
    """Velocity straight to the target, m/s, world: at a given speed, slower within `slow_within` (m) of it."""
    away = task.target_now(world).pos - world.drones.pos
    return speed * away / jnp.maximum(norm(away), slow_within)[:, None]


def nearest_drone(pos: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Distance of the nearest other drone, m; infinity for a single drone."""
    apart = [norm(jnp.roll(pos, k, axis=0) - pos) for k in range(1, len(pos))]
    return functools.reduce(jnp.minimum, apart, jnp.full_like(pos[:, 0], jnp.inf))


def crowding(task: Task, world: World) -> Float[Array, " n"]:
    """Squared relative penetration of the 0.4 m around a drone by its nearest neighbor."""
    return jnp.maximum(1 - nearest_drone(world.drones.pos) / _CROWDED, 0) ** 2


def variable(name: str, meaning: str) -> Term:
    """Task variable as a metric or reward term, described by `meaning`."""
    return described(meaning, lambda task, world: world.variables[name].astype(world.drones.pos.dtype))


def flag(name: str, meaning: str) -> Condition:
    """Boolean task variable as a condition, described by `meaning`."""
    return described(meaning, lambda task, world: world.variables[name])


def action_change(task: Task, world: World) -> Float[Array, " n"]:
    """Squared difference of the last two actions."""
    return square(world.actions[:, -1] - world.actions[:, -2])


def out_of_control(reach: float, center: tuple[float, float, float] | None = None) -> dict[str, Condition]:
    """Conditions of an unrecoverable flight or a state that is not finite.

    `lost`: a drone is farther than `reach` (m) from `center` (m, world; by default its target) along some axis.
    `spinning`: it rotates faster than 100 rad/s about some axis.
    """

    def lost(task: Task, world: World) -> Bool[Array, " n"]:
        pos = world.drones.pos
        middle = task.target_now(world).pos if center is None else jnp.asarray(center, pos.dtype)[None]
        return _beyond(pos - middle, reach)

    def spinning(task: Task, world: World) -> Bool[Array, " n"]:
        return _beyond(world.drones.omega, MAX_SPIN)

    place = "the target" if center is None else f"({', '.join(f'{x:g}' for x in center)}) m"
    return {
        "lost": described(f"A drone is {reach:g} m or more from {place} along some axis.", lost),
        "spinning": described(f"A drone rotates at {MAX_SPIN:g} rad/s or faster about some axis.", spinning),
    }


def _beyond(v: Float[Array, "n 3"], limit: float) -> Bool[Array, " n"]:
    x, y, z = (jnp.abs(column) < limit for column in v.T)  # false for NaN
    return ~(x & y & z)


REACH_AND_STAY: dict[str, tuple[float, Term]] = {
    "alive": (2.0, alive),
    "position": (-1.0, position),
    "velocity": (-0.1, velocity),
    "omega": (-0.02, body_rates),
    "action_change": (-0.02, action_change),
}
"""Terms for flight to a moving or resting target and hover there with small body rates."""
