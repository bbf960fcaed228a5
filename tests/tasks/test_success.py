"""What a success is: each task's criterion can be met by a scripted flight, or the task has none; starts are drawn."""

from collections.abc import Callable
from types import SimpleNamespace

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

from jaxdrones import load_params, repeat, rotation, stack
from jaxdrones.envs import TASKS, make
from jaxdrones.learning import evaluate
from jaxdrones.pytree import PyTreeNode
from jaxdrones.tasks.starts import above_ground, standing_height

KEY = jax.random.key(0)
GAINS = jnp.array([[-0.793, -0.179, -0.659, -0.372, 0.948, -0.53]])  # of 800 random ones, insensitive to rounding
HEIGHTS = {
    "hover-2021": [1.0],
    "takeoff": [2.0],
    "leader-follower": [0.5, 0.5],
    "flock": [1.0, 1.0],
    "hover-2x": [1.0],
    "multi-hover": [1.1125, 0.6125],
}


def climb_to(heights, position=5, velocity=3):
    """All rotors alike, from the error of the height and its rate, which observations are divided by."""
    return lambda obs: jnp.clip(2 * (jnp.array(heights) - position * obs[:, 2]) - 3 * velocity * obs[:, 8], -1, 1)[
        :, None
    ]


def come_near(obs):
    """Slowly towards the partner, level, as long as it is out of reach."""
    away = jnp.flip(obs[:, :2], axis=0) - obs[:, :2]
    return jnp.concatenate([15 * away, jnp.full((2, 1), 0.5), jnp.full((2, 1), -0.8)], axis=1)


SCRIPTED = {name: climb_to(heights) for name, heights in HEIGHTS.items()} | {
    "hover-2x": climb_to([1.0], 1, 1),
    "multi-hover": climb_to([1.1125, 0.6125], 1, 1),
    "tune": lambda obs: GAINS,
    "meetup": come_near,
}


class Script(PyTreeNode):
    """A scripted policy, or one that gives full negative actions."""

    flies: jax.Array
    script: Callable = flax.struct.field(pytree_node=False)

    def __call__(self, obs):
        return jnp.where(self.flies, self.script(obs), -1)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(SCRIPTED))
def test_a_scripted_flight_succeeds_and_one_without_thrust_does_not(name):
    env = make(name)
    assert [evaluate(env, Script(jnp.array(flies), SCRIPTED[name]), KEY, 1).success for flies in (True, False)] == [
        1,
        0,
    ]


def test_tasks_whose_goal_cannot_be_reached_have_no_criterion():
    assert TASKS["fly-through-gate"]().success is None
    for name in "hover-2021", "tune", "hover-2x":  # two drones cannot be at one place
        assert TASKS[name](drones=2).success is None
    for name, least in ("hover", 2.0), ("tracking", 1.0), ("follow", 2.0):  # shorter than what the criterion asks for
        assert TASKS[name](duration=least).success is None and TASKS[name](duration=least + 0.5).success is not None


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("wake", {"altitude_error": 0.04}, {"altitude_error": 0.06}),
        ("tracking", {"error": 0.04}, {"error": 0.06}),
        ("sling", {"error": 0.09, "swing": 14.0}, {"error": 0.09, "swing": 16.0}),
        ("follow", {"distance_error": 0.1, "in_view": 1.0}, {"distance_error": 0.1, "in_view": 0.0}),
    ],
)
def test_an_episode_no_longer_than_what_its_criterion_leaves_out_is_judged_by_its_last_step(name, good, bad):
    task = TASKS[name](duration=3.0)

    def succeeds(end):
        metrics = {metric: jnp.full((20, task.drones), jnp.inf).at[-1].set(x) for metric, x in end.items()}
        return task.success(metrics | {"touched": jnp.zeros((20, task.drones))}, 0.1 if name == "follow" else 0.05)

    assert jnp.all(succeeds(good)) and not jnp.any(succeeds(bad))


def test_a_hover_of_less_than_two_seconds_is_no_success():
    """An environment with fewer steps than its task has the criterion of the task."""
    task, still = TASKS["hover"](), jnp.zeros((200, 1))
    for steps, success in (200, True), (199, False), (50, False):
        assert task.success({"error": still[:steps], "speed": still[:steps]}, 0.01).tolist() == [success]
    for name in "error", "speed":
        metrics = {"error": still, "speed": still} | {name: still.at[0].set(0.2)}
        assert task.success(metrics, 0.01).tolist() == [False]


@pytest.mark.parametrize("name", [*HEIGHTS, "fly-through-gate", "tune", "meetup", "gates"])
def test_starts_are_one_unless_a_spread_is_given(name):
    """Every drone has a start of its own, within the spread, and what the task keeps of the start is the same."""
    task, spread = TASKS[name](), TASKS[name](start_spread=0.12)
    params = repeat(load_params("cf2x"), task.drones)
    (usual, _), (same, _) = (task.begin(jax.random.key(k), params, task.scene) for k in range(2))
    found = [spread.begin(jax.random.key(k), params, task.scene) for k in range(3)]
    np.testing.assert_array_equal(usual.pos, same.pos)
    off = np.array([state.pos - usual.pos for state, _ in found])
    drawn = off[..., :2] if name == "gates" else off[..., 2:]
    assert len(np.unique(drawn)) == drawn.size and np.all(np.abs(drawn) < 0.12)
    assert np.count_nonzero(off) == drawn.size
    for state, variables in found:
        np.testing.assert_array_equal(variables["pos"] if name == "gates" else variables, state.pos)
    with pytest.raises(ValueError, match="start_spread"):
        TASKS[name](start_spread=0.6)


def test_a_spread_beyond_the_height_of_the_start_leaves_drones_above_the_ground():
    params = repeat(load_params("cf2x"), 1)
    keys = jax.random.split(KEY, 1000)
    z = jit_unoptimized(jax.vmap(lambda key: above_ground(0.4)(key, params)[0].pos[0, 2]))(keys) - standing_height(
        params
    )
    assert 0 <= z.min() < 0.01 and 0.49 < z.max() <= 0.5


def test_drones_of_different_vehicles_start_apart():
    one, large = load_params("cf2x"), load_params("hb")
    params = stack([one, large, one, one, one])
    pos = np.asarray(jit_unoptimized(lambda key: above_ground(0.0)(key, params)[1])(KEY))
    apart = np.linalg.norm(pos[:, None] - pos[None], axis=-1) + np.eye(5)
    assert np.min(apart) > 2 * np.max(params.arm)


def test_what_teams_of_gym_pybullet_drones_are_charged_for_and_where_they_should_be():
    starts = jnp.array([[0.0, 0, 0.1], [0.2, 0.2, 0.1], [0.4, 0.4, 0.1]])
    pos = jnp.array([[0.0, 0, 0.6], [0.2, 0.2, 1.0], [0.4, 0.4, 0.4]])
    params = SimpleNamespace(collision_radius=jnp.array([0.05, 0.06, 0.07]))
    world = SimpleNamespace(
        drones=SimpleNamespace(pos=pos), variables=starts, time=jnp.zeros(()), dt=0.02, params=params
    )
    costs = {"leader-follower": [0.01, 0.16 / 3, 0.04 / 3], "flock": [0.16, 0.16, 0.36], "meetup": [0.36, 0, 0.36]}
    for name, expected in costs.items():
        task = TASKS[name](drones=3)
        np.testing.assert_allclose(task.rewards["cost"][1](task, world), expected, atol=1e-12)
    gap = task.metrics["gap"](task, world)
    np.testing.assert_allclose(gap[0], np.sqrt(0.36) - 0.12, rtol=1e-9)
    np.testing.assert_allclose(task.target(starts, 0.0).pos, np.tile([0.2, 0.2, 0.1], (3, 1)))
    highest = TASKS["multi-hover"](drones=3).target(starts, 0.0).pos
    np.testing.assert_allclose(highest[:, 2], 0.1 + 1 / np.array([1, 2, 3]))


def test_a_drone_of_version_2_is_cut_outside_its_box_above_two_meters_or_tilted_by_more_than_23_degrees():
    cut = TASKS["hover-2x"](drones=5).truncations
    pos = jnp.array([[1.6, 0, 1], [0, -1.6, 1], [0, 0, 2.1], [1.4, 1.4, 1.9], [0, 0, 1]])
    rpy = jnp.array([[0.41, 0, 0], [0, -0.41, 0], [0.39, 0, 0], [0, 0.39, 0], [0, 0, 3.0]])
    world = SimpleNamespace(drones=SimpleNamespace(pos=pos, quat=jax.vmap(rotation.from_rpy)(rpy)))
    assert cut["out_of_box"](None, world).tolist() == [True, True, True, False, False]
    assert cut["tilted"](None, world).tolist() == [True, True, False, False, False]


def test_who_takes_off_or_meets_does_so_in_the_end():
    for name, metric, good, bad in ("takeoff", "height", 1.0, 0.9), ("meetup", "gap", 0.04, 0.06):
        values = jnp.array([[bad, good], [good, bad]])
        assert TASKS[name](drones=2).success({metric: values}, 0.02).tolist() == [True, False]
