"""Environments on Bullet: the same contract, the same numbers in free flight, pictures, no gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, mostly_slow

from jaxdrones.envs import TASKS, check_env, make

KEY = jax.random.key(3)


@pytest.mark.needs("pybullet")
@pytest.mark.parametrize("task", mostly_slow(TASKS, ("hover",)))
def test_every_task_keeps_the_contract_on_bullet(task):
    with make(task, backend="bullet") as env:
        check_env(env, steps=2)


@pytest.mark.needs("pybullet")
@pytest.mark.parametrize("task", mostly_slow(["hover", "tracking", "swap-goals", "hover-2x"], []))
def test_in_free_flight_both_backends_see_and_reward_the_same(task):
    options = dict(effects=("drag",), pairs=("downwash",))
    explicit = make(task, **options)
    with make(task, backend="bullet", **options) as bullet:
        seen = [fly(env) for env in (explicit, bullet)]
    assert_close(*seen, 1e-9)


def fly(env):
    _, world = env.reset(KEY)
    rng, seen = np.random.default_rng(0), []
    for _ in range(20):
        action = rng.uniform(-0.1, 0.1, (env.drones, env.action_size))
        obs, world, reward, *_ = env.step(KEY, world, action)
        seen.append((np.asarray(obs), np.asarray(reward)))
    return seen


@pytest.mark.needs("pybullet")
def test_a_gradient_through_bullet_is_refused():
    with make("hover", backend="bullet") as env:
        _, world = env.reset(KEY)
        with pytest.raises(TypeError, match="the Bullet backend has no gradient"):
            jax.grad(lambda action: env.step(KEY, world, action)[2].sum())(jnp.zeros((1, 4)))


def test_an_integrator_is_refused_on_bullet():
    with pytest.raises(ValueError, match="the bullet backend integrates by itself"):
        make("hover", backend="bullet", integrator="rk4")


@pytest.mark.needs("pybullet")
def test_a_closed_environment_says_so():
    env = make("hover", backend="bullet")
    _, world = env.reset(KEY)
    env.close()
    with pytest.raises(ValueError, match="closed"):
        env.step(KEY, world, jnp.zeros((1, 4)))
