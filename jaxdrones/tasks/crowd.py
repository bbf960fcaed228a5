"""Task: a crowd of drones crosses a box without touching."""

import math
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.arguments import Switch, checked, number
from jaxdrones.params import Params
from jaxdrones.sensing import Scene, Sphere
from jaxdrones.state import State
from jaxdrones.tasks import crossing, shaping
from jaxdrones.tasks.starts import thrown
from jaxdrones.tasks.task import Task, Team

FLOOR = 2.0  # m, height of the box above the ground
_SPACING = 4.0  # collision radii between starts, and between goals (GCBF+, arXiv 2401.14554)
_CLEARANCE = 0.25  # m between obstacles and the surfaces of drones at starts and goals
_RADII = (0.1, 0.2)  # m, smallest and largest of the obstacles
_TRIES = 32  # random places of a drone, of which the first free one is taken
_SETTLING = 6.0  # s of an episode beyond the straight flight
_NARROWEST, _LONGEST = 0.6, 2.0  # sides of a random box over those of the cube


@checked
def crowd(
    drones: Team = 8,
    density: Annotated[float, number("1/m^3", above=0, at_most=8)] = 1.0,
    obstacles: Annotated[float, number("1/m^3", at_least=0, at_most=2)] = 0.0,
    random_box: Switch = False,
    patience: Annotated[float, number(at_least=1)] = 1.0,
) -> Task:
    """Drones fly from random starts to random goals in a cube whose volume grows with their number.

    Starts are four collision radii apart where a random place permits it, and so are goals. Two drones touch when their
    centers come closer than two collision radii. A drone out of control ends its own episode. Obstacles are balls of a
    radius of 0.1 to 0.2 m, 0.25 m away from drones at starts and goals; where a drone's center comes within a collision
    radius of one at a control step, it has touched it.

    Args:
        drones: number of drones, at least two.
        density: drones per volume of the cube.
        obstacles: balls per volume of the cube.
        random_box: for training: sides drawn for every episode, 0.6 to 1.1 times those of the cube; in half of the
            episodes one side is up to twice as long, so that drones meet at full speed.
        patience: duration of an episode over that of a straight flight along the diagonal plus 6 s.
    """
    side = (drones / density) ** (1 / 3)
    longest = side * (_LONGEST if random_box else 1)
    balls = round(obstacles * side**3)
    duration = patience * (_SETTLING + math.hypot(longest, side, side) / crossing.SPEED)
    middle = np.array([0, 0, FLOOR + side / 2])

    def scene(key: jax.Array) -> Scene:
        pos_key, radius_key = jax.random.split(key)
        pos = middle[None] + jax.random.uniform(pos_key, (balls, 3), minval=-side / 2, maxval=side / 2)
        radius = jax.random.uniform(radius_key, (balls,), minval=_RADII[0], maxval=_RADII[1])
        return Scene.of(Sphere(pos=pos, radius=radius))

    def start(key: jax.Array, params: Params, scene: Scene) -> tuple[State, dict[str, Array]]:
        """Nearly at rest at random places in the box."""
        state, goal = in_box(key, params, scene, middle, side, random_box)
        return state, crossing.variables(state, goal)

    return crossing.task(
        obstacles=balls > 0,
        scene=scene if balls else Scene(),
        name="crowd",
        summary="cross a box full of drones without touching",
        drones=drones,
        duration=duration,
        start=start,
        terminations=shaping.out_of_control(longest + 4.0, center=(0, 0, FLOOR + side / 2)),
        ends="drone",
    )


def in_box(
    key: jax.Array, params: Params, scene: Scene, middle: np.ndarray, side: float, random_box: bool
) -> tuple[State, Float[Array, "n 3"]]:
    """Drones nearly at rest at random places of a cube about `middle` (m), or of a random box, and random goals."""
    box_key, start_key, place_key, goal_key = jax.random.split(key, 4)
    sides = _random_sides(box_key, side) if random_box else jnp.full(3, side)
    n, radius = len(params.mass), jnp.max(params.collision_radius)
    place, goal = (_places(k, n, middle, sides, scene, radius) for k in (place_key, goal_key))
    return thrown(start_key, params, place, reach=0.0, speed=0.1, omega=0.1, tilt=0.1), goal


def _random_sides(key: jax.Array, side: float) -> Float[Array, "3"]:
    """Sides of a random box, m."""
    sides_key, which_key, long_key = jax.random.split(key, 3)
    sides = jax.random.uniform(sides_key, (3,), minval=_NARROWEST * side, maxval=1.1 * side)
    long = jax.random.uniform(long_key, (), minval=side, maxval=_LONGEST * side)
    return jnp.where(jnp.arange(3) == jax.random.randint(which_key, (), 0, 6), long, sides)


def _places(
    key: jax.Array, n: int, middle: np.ndarray, sides: Array, scene: Scene, radius: Array
) -> Float[Array, "n 3"]:
    """Random places in a box, apart from each other and from obstacles where one of the tries is."""
    tries = jax.random.uniform(key, (n, _TRIES, 3), minval=-0.5, maxval=0.5) * sides[None, None] + middle[None, None]
    spacing = _SPACING * radius
    clear = jnp.full((n, _TRIES), jnp.inf)
    if scene.has_obstacles:
        clear = jax.vmap(jax.vmap(scene.distance))(tries) - radius - _CLEARANCE + spacing

    def place(taken: Array, drone: tuple[Array, Array, Array]) -> tuple[Array, None]:
        i, tries, clear = drone
        apart = jnp.linalg.norm(tries[:, None] - taken[None], axis=-1)
        free = jnp.minimum(clear, jnp.min(jnp.where(jnp.arange(n)[None] < i, apart, jnp.inf), axis=-1))
        first = jnp.argmax(jnp.where(free > spacing, spacing + _TRIES - jnp.arange(_TRIES), free))
        return taken.at[i].set(tries[first]), None

    return jax.lax.scan(place, jnp.zeros((n, 3)), (jnp.arange(n), tries, clear))[0]
