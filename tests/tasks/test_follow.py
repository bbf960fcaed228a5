"""Following: what is in view, and where a follower should be."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from helpers import jit_unoptimized

from jaxdrones.envs import make

ENV = make("follow", drones=3)
TASK = ENV.task
first_world = functools.cache(lambda: jit_unoptimized(ENV.reset)(jax.random.key(0))[1])


def world_with(offset, yaw=0.0):
    """The leader `offset` from the second drone, whose heading is `yaw`; the third is far behind."""
    world = first_world()
    second = jnp.array([1.0, 2.0, 3.0])
    pos = jnp.stack([second + jnp.asarray(offset), second, second - jnp.array([3.0, 0, 0])])
    quat = jnp.tile(jnp.array([0, 0, jnp.sin(yaw / 2), jnp.cos(yaw / 2)]), (3, 1))
    world = world.replace(drones=world.drones.replace(pos=pos, quat=quat))
    return world.replace(variables=world.variables | {"pos": pos})


def test_a_drone_is_in_view_where_the_camera_shows_it():
    half = np.tan(np.radians(30))  # of the vertical field of view
    for offset, seen in [
        ((2, 0, 0), 1),
        ((-2, 0, 0), 0),
        ((2, 0, 1.9 * half), 1),
        ((2, 0, 2.1 * half), 0),
        ((2, -1.9 * half * 4 / 3, 0), 1),
        ((2, 2.1 * half * 4 / 3, 0), 0),
    ]:
        assert TASK.metrics["in_view"](TASK, world_with(offset)).tolist() == [1, seen, 1]
    assert TASK.metrics["in_view"](TASK, world_with((-2, 0, 0), yaw=np.pi))[1] == 1


def test_a_follower_should_be_at_its_distance_on_the_level_line_to_the_drone_before_it():
    world = world_with((4.0, 0.0, 1.0))
    np.testing.assert_allclose(TASK.target_now(world).pos[1:], [[3.5, 2, 4], [-0.5, 2, 3]], atol=1e-12)
    np.testing.assert_allclose(TASK.metrics["distance_error"](TASK, world), [0, np.sqrt(17) - 1.5, 1.5], atol=1e-12)


def test_a_follower_is_told_the_direction_of_the_drone_before_it_in_its_own_axes():
    line = TASK.observations["line_of_sight"].observe(TASK, world_with((0.0, 4.0, 3.0), yaw=np.pi / 2))
    np.testing.assert_allclose(line, [[0, 0, 0], [0.8, 0, 0.6], [0, -1, 0]], atol=1e-12)


def test_a_follower_that_passes_through_another_drone_between_two_control_steps_has_touched_it():
    """Eight meters a second: 40 cm in a control step at 20 Hz."""
    world = world_with((0.2, 0.0, 0.0))
    radius = float(world.params.collision_radius[0])
    for gap, touched in ((1.9, True), (2.1, False)):
        pos = world.drones.pos.at[1].add(jnp.array([0.4, gap * radius, 0.0]))
        before = world.drones.pos.at[1, 1].add(gap * radius)
        now = world.replace(drones=world.drones.replace(pos=pos), variables=world.variables | {"pos": before})
        np.testing.assert_array_equal(TASK.advance(TASK, now)["touched"], [touched, touched, False])
