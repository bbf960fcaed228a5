"""Following: what is in view, and where a follower should be."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized
from scipy.spatial.transform import Rotation

from jaxdrones.envs import make
from jaxdrones.sensing import Scene

ENV = functools.cache(lambda: make("follow", drones=3))
first_world = functools.cache(lambda: jit_unoptimized(ENV().reset)(jax.random.key(0))[1])


def world_with(offset, yaw=0.0):
    """The leader `offset` from the second drone, whose heading is `yaw`; the third is far behind."""
    world = first_world()
    second = np.array([1.0, 2.0, 3.0])
    pos = np.stack([second + offset, second, second - [3.0, 0, 0]])
    quat = np.tile([0, 0, np.sin(yaw / 2), np.cos(yaw / 2)], (3, 1))
    world = world.replace(drones=world.drones.replace(pos=pos, quat=quat))
    return world.replace(variables=world.variables | {"pos": pos})


def test_a_drone_is_in_view_where_the_camera_shows_it():
    in_view = jit_unoptimized(lambda world: ENV().task.metrics["in_view"](ENV().task, world))
    half = np.tan(np.radians(30))  # of the vertical field of view
    for offset, seen in [
        ((2, 0, 0), 1),
        ((-2, 0, 0), 0),
        ((2, 0, 1.9 * half), 1),
        ((2, 0, 2.1 * half), 0),
        ((2, -1.9 * half * 4 / 3, 0), 1),
        ((2, 2.1 * half * 4 / 3, 0), 0),
    ]:
        assert in_view(world_with(offset)).tolist() == [1, seen, 1]
    assert in_view(world_with((-2, 0, 0), yaw=np.pi))[1] == 1


def test_what_is_out_of_sight_costs_one_minus_the_cosine_from_the_axis_of_the_camera():
    scale, cost = ENV().task.rewards["view"]
    for offset, expected in ((2, 0, 0), 0), ((0, 2, 0), 1), ((-2, 0, 0), 2), ((1, 0, 1), 1 - 0.5**0.5):
        np.testing.assert_allclose(cost(ENV().task, world_with(offset)), [0, expected, 0], atol=1e-6)
    assert scale < 0


def test_a_follower_should_be_at_its_distance_on_the_level_line_to_the_drone_before_it():
    task, world = ENV().task, world_with((4.0, 0.0, 1.0))
    places, errors = jit_unoptimized(
        lambda world: (task.target_now(world).pos, task.metrics["distance_error"](task, world))
    )(world)
    np.testing.assert_allclose(places[1:], [[3.5, 2, 4], [-0.5, 2, 3]], atol=1e-12)
    np.testing.assert_allclose(errors, [0, np.sqrt(17) - 1.5, 1.5], atol=1e-12)


def test_a_follower_is_told_the_direction_of_the_drone_before_it_in_its_own_axes():
    observe = jit_unoptimized(lambda world: ENV().task.observations["line_of_sight"].observe(ENV().task, world))
    line = observe(world_with((0.0, 4.0, 3.0), yaw=np.pi / 2))
    np.testing.assert_allclose(line, [[0, 0, 0], [0.8, 0, 0.6], [0, -1, 0]], atol=1e-12)


def test_a_follower_that_passes_through_another_drone_between_two_control_steps_has_touched_it():
    """Eight meters a second: 40 cm in a control step at 20 Hz."""
    world = world_with((0.2, 0.0, 0.0))
    touched_in = jit_unoptimized(lambda world: ENV().task.advance(ENV().task, world)["touched"])
    radius = float(world.params.collision_radius[0])
    for gap, touched in ((1.9, True), (2.1, False)):
        pos = world.drones.pos + np.array([[0, 0, 0], [0.4, gap * radius, 0], [0, 0, 0]])
        before = world.drones.pos + np.array([[0, 0, 0], [0, gap * radius, 0], [0, 0, 0]])
        now = world.replace(drones=world.drones.replace(pos=pos), variables=world.variables | {"pos": before})
        np.testing.assert_array_equal(touched_in(now), [touched, touched, False])
    pos = np.array([[9.0, 0, 3], [0, 0, 3], [0, 9, 0.5 * radius]])
    already = world.variables | {"pos": pos, "touched": np.array([False, True, False])}
    now = world.replace(drones=world.drones.replace(pos=pos), variables=already)
    assert touched_in(now).tolist() == [False, True, True], "the ground, and what had touched before"


def test_a_team_starts_in_a_line_at_its_distance_with_the_motion_of_the_leader_and_in_view():
    task, params = ENV().task, ENV().params

    @jit_unoptimized
    @jax.vmap
    def starts(key):
        state, variables = task.begin(key, params, Scene())
        return state, task.target(variables, jnp.zeros(()))

    state, target = starts(jax.random.split(jax.random.key(0), 50))
    ahead = np.asarray(state.pos[:, :-1] - state.pos[:, 1:])
    assert np.all(np.abs(np.linalg.norm(ahead, axis=-1) - 1.5) < 0.2 * np.sqrt(3))
    np.testing.assert_allclose(np.abs(np.mean(ahead, axis=0)), 0, atol=0.6)  # in any direction
    east = Rotation.from_quat(np.reshape(state.quat[:, 1:], (-1, 4))).apply([1, 0, 0]).reshape(ahead.shape)
    assert np.min(np.sum(east * ahead, axis=-1)) > 1.2
    assert np.all(np.abs(state.vel - target.vel[:, :1]) <= 0.1)
    np.testing.assert_array_equal(target.vel[:, 1:], state.vel[:, :-1])
    assert np.all(np.any(target.acc[:, 0] != 0, axis=-1)) and not np.any(target.acc[:, 1:])


@pytest.mark.parametrize(
    ("error", "unseen", "touched", "success"), [(0.4, 5, 0, 1), (0.5, 5, 0, 0), (0.4, 6, 0, 0), (0.4, 5, 1, 0)]
)
def test_success_is_the_distance_on_average_and_the_other_in_view_for_95_percent_after_two_seconds(
    error, unseen, touched, success
):
    k = np.arange(200)[:, None]
    metrics = {
        "distance_error": np.where(k < 100, 9.0, error + 0.3 * (-1.0) ** k),
        "in_view": np.where((k < 100) | (k >= 200 - unseen), 0.0, 1.0),
        "touched": np.where(k < 199, 0.0, touched),
    }
    assert ENV().task.success({name: jnp.asarray(x) for name, x in metrics.items()}, 0.02).tolist() == [bool(success)]
