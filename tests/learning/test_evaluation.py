"""Episodes are counted as the task says, and the interval is the known one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones import envs
from jaxdrones.learning import evaluate
from jaxdrones.learning.evaluation import wilson_interval


def test_wilson_interval_against_known_numbers():
    # statsmodels.stats.proportion.proportion_confint(count, nobs, method="wilson")
    np.testing.assert_allclose(wilson_interval(10, 100), (0.0552292, 0.1743657), atol=1e-6)
    np.testing.assert_allclose(wilson_interval(10_000, 10_000), (0.9996160, 1.0), atol=1e-6)
    np.testing.assert_allclose(wilson_interval(0, 50), (0.0, 0.0713476), atol=1e-6)


@pytest.fixture(scope="module")
def env():
    return envs.make("hover", reach=0.0, speed=0.0, omega=0.0, tilt=0.0)


def hovering(obs):
    return jnp.zeros((1, 4))


def falling(obs):
    return -jnp.ones((1, 4))


@pytest.mark.slow
def test_a_drone_that_stays_succeeds_in_every_episode(env):
    report = evaluate(env, hovering, jax.random.key(0), episodes=20)
    assert report.success == 1 and report.episodes == 20
    assert report.final_error < 1e-6 and report.end_rates["lost"] == 0
    np.testing.assert_allclose(report.mean_length, 5.0)


@pytest.mark.slow
def test_a_drone_that_falls_is_lost_and_its_metrics_stay_what_they_were_then(env):
    report = evaluate(env, falling, jax.random.key(0), episodes=20)
    assert report.success == 0 and report.end_rates["lost"] == 1
    seconds = np.sqrt(2 * 8 / 9.8)  # 8 m of free fall
    np.testing.assert_allclose(report.mean_length, seconds, atol=0.01)
    np.testing.assert_allclose(report.final_error, 8.0, atol=0.2)


@pytest.mark.slow
def test_an_episode_of_a_team_succeeds_when_all_of_it_does():
    env = envs.make("hover", drones=2, reach=0.0, speed=0.0, omega=0.0, tilt=0.0)

    def one_stays(obs):
        return jnp.array([[0.0], [-1.0]]) * jnp.ones((1, 4))

    assert evaluate(env, lambda obs: jnp.zeros((2, 4)), jax.random.key(0), episodes=3).success == 1
    assert evaluate(env, one_stays, jax.random.key(0), episodes=3).success == 0


def test_episodes_must_be_a_whole_number(env):
    with pytest.raises(ValueError, match="episodes is 0"):
        evaluate(env, hovering, jax.random.key(0), episodes=0)
