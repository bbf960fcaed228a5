"""Flight of every drone of a team to its goal without touching anything: shared by `crowd`, `swap-goals`, `room`."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import vector
from jaxdrones.quantity import quantities
from jaxdrones.state import State
from jaxdrones.tasks import shaping
from jaxdrones.tasks.pairs import CORE, dot, nearby, nearest_on_the_way, seen_from, sums_with
from jaxdrones.tasks.task import ObservationTerm, Task, Term, World, distance
from jaxdrones.tasks.touching import balls_meet

SPEED = 1.2  # m/s, to the goal
_SLOW_WITHIN = 0.8  # m of the goal
_SIGHT = 2.0  # m, length at which the observed vector to the goal is clipped
_ARRIVED = 0.1  # m
_MARGIN, _SOFTNESS = 0.08, 0.04  # m: gap below which the reward falls for drones at rest, and its softness
_PASSING_TIME, _MARGIN_TIME = 0.06, 0.3  # s: growth of that gap with the relative and with the closing speed
_SLOW = 0.1  # m/s, added to the relative speed in quadrature
_SEEN = 8  # nearest drones that count


def task(obstacles: bool = False, **own: Any) -> Task:
    """Task whose drones fly to the variable `goal`; `own` are the remaining arguments of `Task`.

    With `obstacles` the drones observe those of the scene and keep clear of them.
    """
    return Task(
        target=shaping.goal,
        rewards=REWARDS_AMONG_OBSTACLES if obstacles else REWARDS,
        advance=advance,
        metrics={"safe": _safe, "reached": _reached},
        success=_arrived_untouched,
        observations=GOAL,
        control_hz=50.0,
        action="thrust_and_rates",
        observation=OBSERVATION_AMONG_OBSTACLES if obstacles else OBSERVATION,
        **own,
    )


def variables(state: State, goal: Float[Array, "n 3"]) -> dict[str, Array]:
    """Task variables at the start."""
    return {"goal": goal, "pos": state.pos, "touched": jnp.zeros(len(goal), bool)}


def advance(task: Task, world: World) -> dict[str, Array]:
    """Task variables after a step.

    Two drones touch when they come closer than both collision radii on the way, a drone and an obstacle when the center
    of the drone comes within a collision radius of it.
    """
    variables, pos = world.variables, world.drones.pos
    before = jnp.where(world.active[:, None], variables["pos"], pos)  # drones that left did not fly there
    touching = nearest_on_the_way(before, pos, nearby(pos, _SEEN), world.params.collision_radius) < 0
    if world.scene.has_obstacles:
        touching |= balls_meet(world, before)
    return variables | {"pos": pos, "touched": variables["touched"] | touching}


def _arrived_untouched(metrics: Mapping[str, Array], dt: float) -> Array:
    """Whether a drone was within 10 cm of its goal in the end and never touched anything."""
    return (metrics["reached"][-1] == 1) & (metrics["safe"][-1] == 1)


def _goal(task: Task, world: World) -> Float[Array, "n 3"]:
    """Vector to the goal, m, world axes, of a length up to 2 m."""
    away = world.variables["goal"] - world.drones.pos
    return away * jnp.minimum(1, _SIGHT / jnp.maximum(shaping.length(away, 1e-3), 1e-3))[:, None]


def _velocity(task: Task, world: World) -> Float[Array, " n"]:
    """Difference from the velocity straight to the goal, m/s."""
    return shaping.length(world.drones.vel - shaping.velocity_to_target(task, world, SPEED, _SLOW_WITHIN), 0.1)


def _approach(task: Task, world: World) -> Float[Array, " n"]:
    """Sum over the nearest drones of the smoothed penetration of a margin that grows with the relative motion, m."""
    index = nearby(world.drones.pos, _SEEN)
    pos, vel = seen_from(world.drones.pos, index), seen_from(world.drones.vel, index)
    apart = jnp.sqrt(dot(pos, pos) + CORE**2)
    closing = jnp.maximum(-dot(pos, vel) / apart, 0)
    gap = apart - sums_with(world.params.collision_radius, index)
    speed = jnp.sqrt(dot(vel, vel) + _SLOW**2)
    inside = _MARGIN + _PASSING_TIME * speed + _MARGIN_TIME * closing - gap
    return vector.total((1 + closing) * _SOFTNESS * jax.nn.softplus(inside / _SOFTNESS))


def _safe(task: Task, world: World) -> Float[Array, " n"]:
    """One if the drone has touched no other one, and no obstacle."""
    return 1 - world.variables["touched"].astype(world.drones.pos.dtype)


def _reached(task: Task, world: World) -> Float[Array, " n"]:
    """One if the drone is within 10 cm of its goal."""
    return (distance(task, world) < _ARRIVED).astype(world.drones.pos.dtype)


REWARDS: dict[str, tuple[float, Term]] = {
    "alive": (2.0, shaping.alive),
    "position": (-1.0, shaping.position),
    "velocity": (-0.5, _velocity),
    "approach": (-8.0, _approach),
    "heading": (-0.2, shaping.heading),  # policies that let it drift lost control on flights longer than in training
    "omega": (-0.02, shaping.body_rates),
    "action_change": (-0.02, shaping.action_change),
}
REWARDS_AMONG_OBSTACLES = REWARDS | {"clearance": (-8.0, shaping.clearance(_MARGIN_TIME))}
GOAL = {"goal": ObservationTerm(_goal, _SIGHT, entries=quantities("goal, from the drone, up to 2 m", "m", "world"))}
OBSERVATION = ("goal", "rotation_matrix", "velocity", "omega", "encounters")
OBSERVATION_AMONG_OBSTACLES = (*OBSERVATION[:-1], "obstacles", OBSERVATION[-1])
