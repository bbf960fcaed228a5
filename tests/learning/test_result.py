"""What `train` does beside updates: it compiles itself once, and tells of gradients that are not finite."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from double_integrator import SMALL, DoubleIntegrator

from jaxdrones import envs, learning
from jaxdrones.learning import Diverged, Policy, bptt, evaluate, ppo, shac
from jaxdrones.learning.result import (
    PATIENCE,
    adapted_learning_rate,
    check_gradients,
    clip_gradient,
    count_nonfinite,
    make_train,
)

LEARNERS = {"bptt": bptt, "shac": shac, "ppo": ppo}
KEY = jax.random.key(0)
pytestmark = pytest.mark.float32


class Counted(DoubleIntegrator):
    """Counts how often its step is traced."""

    def __init__(self):
        self.traced = []

    def step(self, key, world, action):
        self.traced.append(True)
        return super().step(key, world, action)


class Steep(DoubleIntegrator):
    """Rewards so large that the norm of their gradient overflows, while they do not."""

    def step(self, key, world, action):
        obs, world, reward, *rest = super().step(key, world, action)
        return obs, world, 1e22 * reward, *rest


def same(a, b, **tolerance):
    for x, y in zip(jax.tree.leaves(a.history), jax.tree.leaves(b.history), strict=True):
        np.testing.assert_allclose(x, y, **tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("name", LEARNERS)
def test_gradients_that_are_not_finite_are_counted_and_stop_training_when_they_repeat(name):
    learner, env = LEARNERS[name], Steep()
    config = dataclasses.replace(SMALL[learner], updates=PATIENCE)
    with pytest.raises(
        Diverged, match=f"gradients were not finite in {PATIENCE} updates in a row; no update had finite"
    ):
        learner.train(KEY, env, config)
    history = jax.jit(lambda key: learner.train(key, env, config).history)(KEY)  # where nothing can be raised
    assert np.all(np.isfinite(history["reward"])) and np.all(history["nonfinite_gradients"] >= 1)


@pytest.mark.slow
def test_a_healthy_training_runs_where_jax_finds_nan_and_has_no_return_before_an_episode_ended():
    seen = []
    with jax.debug_nans(True):
        result = bptt.train(
            KEY, DoubleIntegrator(), SMALL[bptt], callback=lambda _, now, __: seen.append(now["return"])
        )
    assert np.all(np.isnan(seen)) and np.all(np.isnan(result.history["return"])) and len(seen) == 3


@pytest.mark.slow
def test_finite_gradients_are_counted_as_none():
    assert np.all(bptt.train(KEY, DoubleIntegrator(), SMALL[bptt]).history["nonfinite_gradients"] == 0)


def test_training_goes_on_after_gradients_that_are_not_finite_unless_they_repeat():
    bad, good = [1] * (PATIENCE - 1), [0]
    assert check_gradients(bad + good + bad) == PATIENCE - 1
    assert check_gradients(bad, before=0) == PATIENCE - 1
    for counts, before in ([*good, *bad, 3], 0), (bad, 1), ([2], PATIENCE - 1):
        with pytest.raises(Diverged, match=f"not finite in {PATIENCE} updates in a row"):
            check_gradients(counts, before=before)
    with pytest.raises(Diverged, match="not finite in 2 updates in a row"):
        check_gradients([1, 1], patience=2)


def test_gradients_that_are_not_finite_are_counted_over_all_calls_of_the_program():
    """A callback makes one call of every update; the schedules know the number of all updates."""
    totals = []
    env, config = DoubleIntegrator(), dataclasses.replace(SMALL[bptt], updates=2 * PATIENCE)

    def update(env, config, state):
        return state.replace(step=state.step + 1), {"nonfinite_gradients": jnp.ones((), int), "updates": config.updates}

    train = make_train(bptt.Config, bptt.init, update)
    with pytest.raises(Diverged, match=f"not finite in {PATIENCE} updates in a row; no update had finite"):
        train(KEY, env, config, callback=lambda update, metrics, state: totals.append(metrics["updates"]))
    assert totals == [2 * PATIENCE] * (PATIENCE - 1)


@pytest.mark.parametrize(("before", "made", "advice"), [(0, 3, "try a smaller"), (1, 1, "learning rate is not the")])
def test_the_learning_rate_is_no_cause_of_gradients_that_never_were_finite(before, made, advice):
    with pytest.raises(Diverged, match=advice):
        check_gradients([1] * (PATIENCE - before), before=before, made=made)


def test_a_gradient_that_is_not_finite_is_replaced_by_zero_and_counted():
    transformation = clip_gradient(1.0)
    clip = jax.jit(
        lambda bad: transformation.update({"a": jnp.array([1.0, 0]).at[1].set(bad), "b": 2.0 + 0 * bad}, None)[0]
    )
    for bad in (np.nan, np.inf, 1e30):
        assert not any(np.any(x) for x in jax.tree.leaves(clip(bad)))
    np.testing.assert_array_equal(count_nonfinite(jnp.array([[1.0, jnp.nan], [jnp.inf, 0.0]])), 2)


def test_only_a_gradient_longer_than_the_limit_is_shortened():
    clip = jax.jit(lambda x: clip_gradient(0.5).update({"x": x}, None)[0]["x"])
    np.testing.assert_allclose(clip(jnp.array([0.15, 0.2])), [0.15, 0.2])
    np.testing.assert_allclose(clip(jnp.array([3.0, 4.0])), [0.3, 0.4])


def test_adam_averages_squared_gradients_over_as_many_updates_as_its_setting_says():
    optimizer = bptt.optimizer(bptt.Config(adam_b2=0.75))
    after = jax.jit(lambda x: optimizer.update(x, optimizer.init(x))[1])(jnp.array([0.1, 0.2]))
    np.testing.assert_allclose(optax.tree.get(after, "nu"), [0.25 * 0.01, 0.25 * 0.04], rtol=1e-5)


def test_the_learning_rate_follows_the_divergence_within_bounds_that_are_annealed():
    config = ppo.Config(updates=100, target_kl=0.02, max_learning_rate=6e-3, anneal_fraction=0.4)

    def adapted(*numbers, config=config):
        return float(adapted_learning_rate(config, *numbers))

    assert adapted(0, 1e-3, 0.009) == pytest.approx(1.2e-3) and adapted(0, 1e-3, 0.041) == pytest.approx(1e-3 / 1.2)
    assert adapted(0, 1e-3, 0.011) == adapted(0, 1e-3, 0.039) == pytest.approx(1e-3)
    assert adapted(60, 6e-3, 0.0) == pytest.approx(6e-3)
    assert adapted(80, 6e-3, 0.0) == pytest.approx((6e-3 * 1e-5) ** 0.5)
    assert adapted(100, 6e-3, 0.0) == adapted(0, 1e-5, 1.0) == pytest.approx(1e-5)
    never = dataclasses.replace(config, anneal_fraction=0.0)
    assert adapted(99, 6e-3, 0.0, config=never) == pytest.approx(6e-3) and adapted(100, 6e-3, 0.0, config=never) > 0


def test_nobody_is_asked_about_compilers():
    assert not [name for name in dir(learning) if "compiler" in name.lower()]


@pytest.mark.slow
def test_train_compiles_itself_once_for_all_keys_and_equal_settings():
    env = Counted()
    first = bptt.train(KEY, env, SMALL[bptt])
    traced = len(env.traced)
    other = bptt.train(jax.random.key(1), env, dataclasses.replace(SMALL[bptt]))
    assert len(env.traced) == traced and not np.array_equal(first.history["reward"], other.history["reward"])
    bptt.train(KEY, env, dataclasses.replace(SMALL[bptt], learning_rate=1e-3))
    assert len(env.traced) > traced


@pytest.mark.slow
def test_evaluate_notices_that_a_field_of_the_environment_was_replaced():
    env = envs.make("hover")
    policy = Policy.init(KEY, env, (4,))
    for steps in (20, 10):
        env = dataclasses.replace(env, steps=steps)
        np.testing.assert_allclose(evaluate(env, policy, KEY, episodes=2).mean_length, steps * env.dt, rtol=1e-6)


@pytest.mark.slow
def test_train_in_a_program_of_the_user_does_what_it_does_alone():
    env = DoubleIntegrator()
    alone = bptt.train(KEY, env, SMALL[bptt])
    same(jax.jit(lambda key: bptt.train(key, env, SMALL[bptt]))(KEY), alone, rtol=1e-5)
    same(jax.jit(lambda: bptt.train(KEY, env, SMALL[bptt]))(), alone, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("compiled", [True, False])
def test_seeds_and_settings_can_be_mapped_inside_and_outside_of_a_program(compiled):
    env, config = DoubleIntegrator(), SMALL[bptt]

    def train(key, learning_rate):
        return bptt.train(key, env, dataclasses.replace(config, learning_rate=learning_rate)).history["reward"]

    keys, rates = jax.random.split(KEY, 2), jnp.array([1e-3, 1e-2])
    many = jax.vmap(train)
    together = (jax.jit(many) if compiled else many)(keys, rates)
    np.testing.assert_allclose(together[1], train(keys[1], float(rates[1])), rtol=1e-4)


@pytest.mark.slow
def test_settings_that_are_arrays_and_environments_that_are_mapped_train_too():
    config = dataclasses.replace(SMALL[bptt], learning_rate=jnp.asarray(1e-2))
    same(bptt.train(KEY, DoubleIntegrator(), config), bptt.train(KEY, DoubleIntegrator(), config), rtol=1e-6)

    class Scaled(DoubleIntegrator):
        def __init__(self, scale):
            self.scale = scale

        def step(self, key, world, action):
            obs, world, reward, *rest = super().step(key, world, action)
            return obs, world, self.scale * reward, *rest

    def first_reward(scale):
        return bptt.train(KEY, Scaled(scale), SMALL[bptt]).history["reward"][0]

    one, two = jax.vmap(first_reward)(jnp.array([1.0, 2.0]))
    np.testing.assert_allclose(two, 2 * one, rtol=1e-5)
