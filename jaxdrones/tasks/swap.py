"""Task: a swarm exchanges places without collisions."""

import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones.arguments import checked
from jaxdrones.control import Setpoint
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.tasks import shaping
from jaxdrones.tasks.conditions import out_of_control
from jaxdrones.tasks.starts import thrown
from jaxdrones.tasks.task import Task, Team, World

HEIGHT = 2.0  # m
_MIN_SPACING = 0.6  # m between neighboring places on the ring


@checked
def swap_goals(drones: Team = 8, duration: float = 6.0) -> Task:
    """Drones on a ring exchange places: each flies the same number of places on, and keeps clear of the others.

    Two drones collide when their centers are closer than two collision radii.

    Args:
        drones: number of drones, at least two.
        duration: duration of an episode, s.
    """
    radius = max(1.0, _MIN_SPACING * drones / (2 * math.pi))

    def start(key: jax.Array, params: Params) -> tuple[State, dict[str, Array]]:
        """Nearly at rest on a ring."""
        start_key, order_key = jax.random.split(key)
        angle = 2 * jnp.pi * jnp.arange(drones, dtype=params.mass.dtype) / drones
        ring = jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle), jnp.full_like(angle, HEIGHT)], axis=-1)
        state = thrown(start_key, params, ring, reach=0.1, speed=0.1, omega=0.1, tilt=0.1)
        goal = jnp.roll(ring, jax.random.randint(order_key, (), 1, drones), axis=0)
        return state, {
            "goal": goal,
            "nearest": shaping.nearest_drone(state.pos),
            "collisions": jnp.zeros(drones, goal.dtype),
        }

    def target(variables, t) -> Setpoint:
        """Goal: the place of another drone at the start."""
        return Setpoint.at(variables["goal"])

    def advance(task: Task, world: World) -> dict[str, Array]:
        nearest = shaping.nearest_drone(world.drones.pos)
        touching = nearest < 2 * world.params.collision_radius
        return world.variables | {"nearest": nearest, "collisions": world.variables["collisions"] + touching}

    return Task(
        name="swap-goals",
        summary="a swarm exchanges places without touching",
        drones=drones,
        duration=duration,
        start=start,
        target=target,
        rewards=shaping.REACH_AND_STAY | {"crowding": (-5.0, shaping.crowding)},
        terminations=out_of_control(2 * radius + 4.0),
        advance=advance,
        metrics={
            "collisions": shaping.variable(
                "collisions", "Control steps so far in which the drone touched another one."
            ),
            "nearest": shaping.variable("nearest", "Distance of the nearest other drone, m."),
        },
        success=_arrived_untouched,
        observation=("position_error", "rotation_matrix", "velocity_error", "omega", "last_action", "neighbors"),
    )


def _arrived_untouched(metrics: Mapping[str, Array], dt: float) -> Array:
    """Whether a drone was within 10 cm of its goal in the end and never touched another one."""
    return (metrics["error"][-1] < 0.1) & (metrics["collisions"][-1] == 0)
