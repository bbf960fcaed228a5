import types

import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones.learning.collect import Worlds
from jaxdrones.learning.metrics import mean_return, measure, with_returns, with_unknown, without_unknown
from jaxdrones.learning.returns import advantages, discounted_rewards

T, W = 12, 5


@pytest.fixture(scope="module")
def flight():
    rng = np.random.default_rng(0)
    return dict(
        reward=rng.normal(size=(T, W)),
        value=rng.normal(size=(T, W)),
        next_value=rng.normal(size=(T, W)),
        terminated=rng.random((T, W)) < 0.15,
        truncated=rng.random((T, W)) < 0.15,
    )


def flown(value, next_value, gamma, gae_lambda, **trajectory):
    """Advantages of a trajectory of these arrays."""
    return advantages(types.SimpleNamespace(**trajectory), value, next_value, gamma, gae_lambda)


def by_hand(reward, value, next_value, terminated, truncated, gamma, gae_lambda):
    """One world after the other, the sum written out."""
    result = np.zeros((T, W))
    for w in range(W):
        for t in range(T):
            weight = 1.0
            for k in range(t, T):
                ahead = 0.0 if terminated[k, w] else next_value[k, w]
                result[t, w] += weight * (reward[k, w] + gamma * ahead - value[k, w])
                weight *= gamma * gae_lambda
                if terminated[k, w] or truncated[k, w]:
                    break
    return result


@pytest.mark.parametrize("gae_lambda", [0.0, 0.9, 1.0])
def test_advantages_are_the_sums_of_their_definition(flight, gae_lambda):
    expected = by_hand(**flight, gamma=0.97, gae_lambda=gae_lambda)
    np.testing.assert_allclose(flown(**flight, gamma=0.97, gae_lambda=gae_lambda), expected, atol=1e-12)


def test_a_time_limit_is_bootstrapped_and_a_crash_is_not():
    one = np.ones((1, 1))
    no, yes = np.zeros((1, 1), bool), np.ones((1, 1), bool)
    common = dict(reward=one, value=0 * one, next_value=10 * one, gamma=0.5, gae_lambda=0.9)
    assert flown(**common, terminated=no, truncated=yes) == 1 + 0.5 * 10
    assert flown(**common, terminated=yes, truncated=no) == 1


def test_with_lambda_one_values_cancel_and_the_target_is_the_discounted_return():
    rng = np.random.default_rng(1)
    reward, value = rng.normal(size=(T, 1)), rng.normal(size=(T, 1))
    next_value = np.concatenate([value[1:], [[3.0]]])
    never = np.zeros((T, 1), bool)
    target = value + flown(
        value, next_value, gamma=0.9, gae_lambda=1.0, reward=reward, terminated=never, truncated=never
    )
    expected = np.sum(reward[:, 0] * 0.9 ** np.arange(T)) + 0.9**T * 3.0
    np.testing.assert_allclose(target[0, 0], expected, rtol=1e-12)


def test_rewards_after_the_end_of_an_episode_do_not_count():
    reward, was_done = np.array([[1.0, 2.0], [4.0, 8.0], [16.0, 32.0]])[..., None], np.zeros((3, 2, 1), bool)
    was_done[1:, 1] = True
    found = discounted_rewards(types.SimpleNamespace(reward=reward, was_done=was_done), 0.5)
    np.testing.assert_array_equal(found[..., 0], [[1, 2], [2, 0], [4, 0]])


def test_the_metrics_of_an_update_are_means_over_the_steps_of_episodes():
    was_done = np.array([[False, False], [False, True], [True, True]])[..., None]
    numbers = np.where(was_done, 100.0, np.arange(6.0).reshape(3, 2, 1))
    trajectory = types.SimpleNamespace(
        reward=numbers,
        error=2 * numbers,
        terminated=was_done | (numbers == 2),
        **dict(was_done=was_done, done=np.zeros((3, 2), bool), length=np.ones((3, 2)), episode_return=numbers),
    )
    worlds = Worlds(None, None, None, last_return=jnp.array([3.0, 5.0]), last_weight=jnp.array([3.0, 1.0]))
    config, env = types.SimpleNamespace(restart_fraction=0.5, horizon=3), types.SimpleNamespace(steps=6)
    found = [measure(env, config, jnp.asarray(step), worlds, trajectory)[1] for step in (0, 1)]
    for metrics in found:
        assert metrics["reward"] == 1 and metrics["error"] == 2  # of 0, 1, and 2
        np.testing.assert_allclose(metrics["termination_rate"], 1 / 3)
    np.testing.assert_array_equal([metrics["return"] for metrics in found], [np.nan, 3.5])  # whole episodes take 2
    config.restart_fraction = 1.0  # then an episode is whole only within a trajectory
    for horizon, mean in (3, np.nan), (6, 3.5):
        config.horizon = horizon
        np.testing.assert_array_equal(measure(env, config, jnp.asarray(9), worlds, trajectory)[1]["return"], mean)


def test_a_return_before_the_first_is_no_number_only_outside_of_a_program():
    metrics = {"reward": jnp.ones(2), "return": jnp.array([jnp.nan, 3.0])}
    inside = without_unknown(metrics)
    assert all(np.all(np.isfinite(x)) for x in inside.values())
    outside = with_unknown(inside)
    assert outside.keys() == metrics.keys()
    np.testing.assert_array_equal(outside["return"], metrics["return"])


def test_an_episode_weighs_as_many_as_were_restarted_before_their_ends():
    """Trajectories of 4 steps: an episode of 4 that ends in the last one began in this one, one of 5 before it."""
    ends, length = np.array([3, 3, 0, 0, 1, -1]), np.array([4, 5, 1, 6, 2, 0])
    t = np.arange(4)[:, None]
    done = t == ends[None]
    trajectory = types.SimpleNamespace(
        done=done,
        was_done=(t[..., None] + np.arange(2) > ends[:, None]) & (ends[:, None] >= 0),  # a drone ends a step earlier
        length=np.where(done, length, 100),
        episode_return=np.where(done, np.arange(6.0), 50.0)[..., None] * np.ones(2),
        reward=np.zeros((4, 6, 2)),
    )
    before = Worlds(None, None, None, last_return=jnp.full(6, 7.0), last_weight=jnp.full(6, 3.0))
    after = with_returns(before, trajectory, 0.2)
    np.testing.assert_allclose(after.last_weight, [1, 1 / 0.8, 1, 1 / 0.8**2, 1, 3])
    np.testing.assert_array_equal(after.last_return, [0, 1, 2, 3, 4, 7])
    np.testing.assert_allclose(mean_return(after), np.average(after.last_return, weights=after.last_weight))
