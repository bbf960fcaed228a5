"""Task: a swarm exchanges places without collisions."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdrones.arguments import Seconds, Switch, checked
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.state import State
from jaxdrones.tasks import crossing, shaping
from jaxdrones.tasks.crowd import in_box
from jaxdrones.tasks.starts import check_apart, thrown
from jaxdrones.tasks.task import Task, Team

HEIGHT = 2.0  # m
_MIN_SPACING = 0.6  # m between neighboring places on the ring
_REACH = 0.1  # m, spread of the starts along each axis
_SETTLING = 4.0  # s of an episode beyond the straight flight across the ring
_BOXED, _DENSITY = 0.5, 1.5  # share of the episodes with random places, and drones per cubic meter in these


@checked
def swap_goals(drones: Team = 8, duration: Seconds | None = None, random_places: Switch = False) -> Task:
    """Drones on a ring exchange places: each flies the same number of places on, and keeps clear of the others.

    Two drones collide when their centers come closer than two collision radii.

    Args:
        drones: number of drones, at least two.
        duration: duration of an episode, s; by default 4 s and a straight flight across the ring, 5.7 s for 8 drones.
        random_places: for training: in half of the episodes, random starts and goals in a random box as in `crowd`.
            Policies that trained on the ring alone touch more often in teams larger than theirs.
    """
    radius = max(1.0, _MIN_SPACING * drones / (2 * math.pi))
    side = (drones / _DENSITY) ** (1 / 3)
    middle = np.array([0, 0, HEIGHT + side / 2])

    def start(key: jax.Array, params: Params) -> tuple[State, dict[str, Array]]:
        """Nearly at rest, on a ring or at random places."""
        apart = 2 * radius * math.sin(math.pi / drones) - 2 * math.sqrt(2) * _REACH
        check_apart(params, apart, "a smaller vehicle or fewer drones")
        start_key, order_key, box_key, which_key = jax.random.split(key, 4)
        angle = 2 * jnp.pi * jnp.arange(drones, dtype=params.mass.dtype) / drones
        ring = jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle), jnp.full_like(angle, HEIGHT)], axis=-1)
        state = thrown(start_key, params, ring, reach=_REACH, speed=0.1, omega=0.1, tilt=0.1)
        goal = jnp.roll(ring, jax.random.randint(order_key, (), 1, drones), axis=0)
        if random_places:
            boxed = in_box(box_key, params, Scene(), middle, side, random_box=True)
            which = jax.random.bernoulli(which_key, _BOXED)
            state, goal = jax.tree.map(lambda x, y: jnp.where(which, x, y), boxed, (state, goal))
        return state, crossing.variables(state, goal)

    return crossing.task(
        name="swap-goals",
        summary="a swarm exchanges places without touching",
        drones=drones,
        duration=_SETTLING + 2 * radius / crossing.SPEED if duration is None else duration,
        start=start,
        terminations=shaping.out_of_control(2 * radius + 4.0),
    )
