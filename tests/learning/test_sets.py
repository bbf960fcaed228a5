"""A network of a set sees neither its order nor its size, and one policy flies teams of any size."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

from jaxdrones import envs
from jaxdrones.envs.observations import encounters, neighbors, obstacles
from jaxdrones.learning import bptt, checkpoint
from jaxdrones.learning.layers import MLP, Network, SetEncoder, make_network, split_sets
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.normalize import RunningStatistics
from jaxdrones.sensing import Cylinder, Scene, Sphere
from jaxdrones.tasks.pairs import nearest

KEY = jax.random.key(0)
REACH = 1.2


def encoded(own, rows, reach=REACH):
    encoder = SetEncoder((8, 4), reach)
    params, apply = jit_unoptimized(encoder.init)(KEY, own, rows), jit_unoptimized(encoder.apply)
    return lambda own, rows: np.asarray(apply(params, own, rows))


def test_the_features_of_a_set_depend_on_neither_order_nor_far_rows():
    rng = np.random.default_rng(0)
    own, rows = rng.normal(size=(5, 6)), rng.uniform(-0.6, 0.6, (5, 7, 13))
    features = encoded(own, rows)
    expected = features(own, rows)
    np.testing.assert_allclose(features(own, rows[:, rng.permutation(7)]), expected, rtol=1e-6)
    far = rng.normal(size=(5, 3, 13))
    far[..., :3] = [REACH, 0.01, 0]
    np.testing.assert_allclose(features(own, np.concatenate([far, rows], axis=1)), expected, rtol=1e-6)
    for other in (features(own, rows[:, :6]), features(own + np.eye(6)[0], rows)):
        assert np.all(np.max(np.abs(other - expected), axis=-1) > 1e-3)


def test_a_row_fades_out_without_a_jump():
    own, rows = np.ones(2), np.ones((1, 5))
    faded, full = (encoded(own, rows, reach) for reach in (REACH, 1e9))
    for share, weight in (0.3, 1.0), (1 / 3, 1.0), (2 / 3, 0.5), (0.99, 0.015), (1.0, 0.0):
        row = np.array([[share * REACH, 0.0, 0.0, 1.0, 1.0]])
        np.testing.assert_allclose(faded(own, row), weight * full(own, row), atol=1e-6)


def test_a_drone_beyond_a_reach_is_not_seen_and_a_reach_that_networks_do_not_see_is_refused():
    """Policies clip what they observe at 10, also the 20 m of a drone that does not exist."""
    stats, rows = RunningStatistics.empty(13), np.random.default_rng(0).normal(size=(1, 3, 13))
    rows[..., :3] = [[20, 0, 0], [0, -15, 3], [12, 12, 12]]
    network = make_network(jnp.zeros(40), (4,), 2, 1.0, sets=((1, 3, 13, 10.0),), set_sizes=(8,))
    params = jit_unoptimized(network.init)(KEY, jnp.zeros(40))
    seen = jit_unoptimized(lambda rows: network.apply(params, jnp.append(1.0, stats.normalize(rows)))[1])
    np.testing.assert_allclose(seen(rows), seen(2 * rows), atol=1e-6)
    with pytest.raises(ValueError, match="has a reach of 20 m, and networks see positions up to 10 m"):
        make_network(jnp.zeros(40), (4,), 2, 1.0, sets=((1, 3, 13, 20.0),), set_sizes=(8,))


def test_sets_are_cut_out_of_an_observation_where_they_stand():
    x = jnp.arange(20.0).reshape(2, 10)
    own, (first, second) = split_sets(((1, 2, 2, 1.0), (6, 1, 3, 2.0)), x)
    np.testing.assert_array_equal(own, x[:, [0, 5, 9]])
    np.testing.assert_array_equal(first, x[:, 1:5].reshape(2, 2, 2))
    np.testing.assert_array_equal(second, x[:, None, 6:9])


def crowd(drones, count=3):
    return envs.make("crowd", drones=drones, observation=("goal", "velocity", encounters(count, REACH)))


@pytest.mark.slow
@pytest.mark.float32
def test_one_policy_flies_teams_of_any_size():
    policy = Policy.init(KEY, crowd(4), (8,), set_sizes=(8, 8))
    for drones in (2, 9):
        env = crowd(drones)
        obs, _ = env.reset(KEY)
        assert policy(obs).shape == (drones, env.action_size)


@pytest.mark.slow
@pytest.mark.float32
def test_rows_are_not_normalized_and_all_else_is(tmp_path):
    env = crowd(4)
    config = bptt.Config(updates=2, worlds=4, horizon=3, hidden_sizes=(8,), set_sizes=(6, 5))
    policy = bptt.train(KEY, env, config).policy
    ((at, rows, size, reach),) = env.sets
    assert (at, rows, size, reach) == (6, 3, 13, REACH)
    assert np.all(policy.obs_stats.mean[at:] == 0) and np.all(policy.obs_stats.var[at:] == 1)
    assert np.all(policy.obs_stats.var[:at] != 1)
    checkpoint.save(tmp_path / "crowd", policy)
    again = checkpoint.load(tmp_path / "crowd")
    obs, _ = env.reset(KEY)
    assert again.network == policy.network
    np.testing.assert_array_equal(again(obs), policy(obs))


def test_the_statistics_of_a_row_are_those_of_no_observation_and_those_of_a_policy_without_sets_are_kept():
    policy = Policy(None, RunningStatistics.empty(5), Network((4,), 1, sets=((1, 1, 3, REACH),)))
    seen = RunningStatistics(2 + jnp.arange(5.0), 7 + jnp.arange(5.0), jnp.ones(()))
    kept = policy.with_obs_stats(seen).obs_stats
    np.testing.assert_array_equal([kept.mean, kept.var], [[2, 0, 0, 0, 6], [7, 1, 1, 1, 11]])
    assert Policy(None, seen, MLP((4,), 1)).with_obs_stats(seen).obs_stats is seen


@functools.lru_cache
def started(drones):
    env = envs.make("crowd", drones=drones)
    return env.task, jit_unoptimized(env.reset)(KEY)[1]


def observed(term, pos, vel, scene=None):
    task, world = started(len(pos))
    world = world if scene is None else world.replace(scene=scene)
    world = world.replace(drones=world.drones.replace(pos=jnp.asarray(pos), vel=jnp.asarray(vel)))
    return np.asarray(jit_unoptimized(lambda world: term.observe(task, world))(world))


@pytest.mark.parametrize("count", [1, 3, 5])
def test_encounters_are_those_of_the_nearest_drones_at_constant_velocity(count):
    rng = np.random.default_rng(1)
    pos, vel = rng.uniform(-2, 2, (4, 3)), rng.normal(size=(4, 3))
    rows = observed(encounters(count), pos, vel).reshape(4, count, 13)
    for i in range(4):
        others = [j for j in range(4) if j != i]
        nearest = sorted(others, key=lambda j: np.linalg.norm(pos[j] - pos[i]))[:count]
        found = rows[i][np.argsort(np.linalg.norm(rows[i][:, :3], axis=1))]
        np.testing.assert_allclose(found[: len(nearest), :3], pos[nearest] - pos[i], atol=1e-12)
        np.testing.assert_allclose(found[: len(nearest), 3:6], vel[nearest] - vel[i], atol=1e-12)
        assert np.all(np.linalg.norm(found[len(nearest) :, :3], axis=1) > 20)
        times = np.linspace(0, 1.5, 20001)
        for row in found[: len(nearest)]:
            away = np.linalg.norm(row[:3] + times[:, None] * row[3:6], axis=1)
            assert np.linalg.norm(row[6:9]) < away.min() + 0.03  # a small term keeps slow drones smooth
            np.testing.assert_allclose(row[6:9], row[:3] + row[9] * row[3:6], atol=1e-12)
            np.testing.assert_allclose(np.cross(row[10:], row[:3]), 0, atol=1e-9)


def test_an_obstacle_is_seen_like_a_drone_that_rests_at_its_nearest_point():
    scene = Scene.of(Sphere(pos=(2.0, 0, 1), radius=0.5), Cylinder(pos=(0, 3.0, 1), radius=1.0, height=2.0))
    pos, vel = np.array([[0.0, 0, 1], [0, 0, 1.7]]), np.array([[1.0, 0, 0], [0, 0, 0.5]])
    rows = observed(obstacles(4), pos, vel, scene).reshape(2, 4, 13)
    np.testing.assert_allclose(rows[0, :3, :3], [[0, 0, -1], [1.5, 0, 0], [0, 2, 0]], atol=1e-12)
    np.testing.assert_allclose(rows[0, :3, 3:6], np.tile(-vel[0], (3, 1)), atol=1e-12)
    assert np.all(np.linalg.norm(rows[:, 3, :3], axis=-1) == 20)
    others = np.concatenate([pos[:1], pos[:1] + rows[0, :3, :3]])
    seen = observed(encounters(3), others, np.concatenate([vel[:1], np.zeros((3, 3))])).reshape(4, 3, 13)
    order = np.argsort(np.linalg.norm(seen[0, :, :3], axis=1))
    np.testing.assert_allclose(rows[0, :3], seen[0][order], atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("n", [9, 64, 65])
def test_the_nearest_drones_are_found_in_their_order(n, dtype):
    pos = np.random.default_rng(n).uniform(0, 4, (n, 3)).astype(dtype)
    pos[3] = pos[5]  # two at one place see each other first
    found = np.asarray(jit_unoptimized(nearest, static_argnums=1)(jnp.asarray(pos), 8))
    away = np.linalg.norm(pos[None] - pos[:, None], axis=-1)
    assert found[3, 0] == 5 and found[5, 0] == 3 and np.all(found != np.arange(n)[:, None])
    assert all(len(set(row)) == 8 for row in found.tolist())
    np.fill_diagonal(away, np.inf)
    expected = np.sort(away, axis=1)[:, :8]
    np.testing.assert_allclose(np.take_along_axis(away, found, axis=1), expected, rtol=1e-4)


def test_a_missing_neighbor_is_far_away():
    rows = observed(neighbors(3), [[0.0, 0, 1], [1.0, 0, 1]], np.zeros((2, 3))).reshape(2, 3, 6)
    np.testing.assert_allclose(rows[0, 0], [1, 0, 0, 0, 0, 0])
    assert np.all(np.linalg.norm(rows[:, 1:, :3], axis=-1) > 30) and np.all(rows[:, 1:, 3:] == 0)


def test_a_learner_that_knows_of_no_sets_is_unchanged():
    env = envs.make("hover")
    assert env.sets == () and not hasattr(Policy.init(KEY, env, (4,)).network, "sets")
