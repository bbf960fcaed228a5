"""Policies with a memory: what they learn, when they forget, and that everything that flies a policy flies them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from double_integrator import SMALL, Cue
from helpers import jit_unoptimized

from jaxdrones import envs
from jaxdrones.learning import bptt, checkpoint, collect, evaluate, ppo, shac
from jaxdrones.learning.layers import GRU
from jaxdrones.learning.networks import Policy
from jaxdrones.training.episode import fly_episode

KEY = jax.random.key(0)
SETTINGS = {
    bptt: dict(updates=60, worlds=32, horizon=6, restart_fraction=1.0),
    shac: dict(updates=60, worlds=32, horizon=6, restart_fraction=1.0),
    ppo: dict(updates=150, worlds=64, horizon=15, gamma=0.9, minibatches=4, min_std=0.02),
}
BPTT_IS_QUICK = pytest.mark.parametrize(
    "learner",
    [pytest.param(module, marks=() if module is bptt else pytest.mark.slow) for module in SMALL],
    ids=lambda module: module.__name__.rpartition(".")[2],
)
FORGETFUL_COST = 0.25 * (Cue.steps - 1) / Cue.steps  # the least that a policy without memory pays in a step


def test_a_recurrent_unit_keeps_what_its_bias_says():
    """Without inputs and weights: between 73 and 95 % of the hidden state."""
    unit, state = GRU(3), jnp.array([1.0, -2.0, 3.0])
    start = unit.init(KEY, jnp.zeros(2))
    params = jax.tree.map(lambda x: x if x.ndim == 1 else 0 * x, start)
    np.testing.assert_allclose(unit.apply(params, jnp.zeros(2), state), state / (1 + np.exp([-1.0, -2, -3])), rtol=1e-6)


def test_a_memory_is_emptied_before_the_first_input_of_an_episode():
    """In the first of two worlds an episode starts with the second input."""
    unit, inputs = GRU(3), jnp.arange(12.0).reshape(3, 2, 2)
    starts = np.array([[False, False], [True, False], [False, False]])

    @jit_unoptimized
    def states():
        params = unit.init(KEY, inputs[0])
        alone = unit.apply(params, inputs[1:], jnp.zeros((2, 3)), starts[2:].repeat(2, 0))
        return unit.apply(params, inputs, jnp.ones((2, 3)), starts), alone

    states, alone = states()
    np.testing.assert_allclose(states[1:, 0], alone[:, 0], rtol=1e-6)
    assert np.all(states[1:, 1] != alone[:, 1])


def learnt_cost(learner, env, **changes):
    """Mean cost of a step of a trained policy, in three episodes that follow one another."""
    config = learner.Config(**dict(hidden_sizes=(16,)) | SETTINGS[learner] | changes)

    def cost(key):
        policy = learner.train(key, env, config).policy
        starts = collect.draw_starts(KEY, env, 64)
        worlds = collect.restart(KEY, collect.empty_worlds(env, 64, policy), starts)
        _, trajectory = collect.collect(KEY, env, collect.deterministic(policy), worlds, 3 * env.steps, starts=starts)
        return -jnp.mean(trajectory.reward)

    return jax.jit(cost)(KEY)


@pytest.mark.slow
@pytest.mark.float32
@BPTT_IS_QUICK
def test_a_recurrent_policy_remembers_what_it_saw_at_the_start_of_each_episode(learner):
    assert learnt_cost(learner, Cue(), recurrent_size=8) < 0.05 * FORGETFUL_COST


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.parametrize("learner", SMALL)
def test_without_a_memory_it_cannot(learner):
    assert learnt_cost(learner, Cue()) > 0.99 * FORGETFUL_COST


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.parametrize("learner", SMALL)
def test_every_learner_learns_from_images(learner):
    assert learnt_cost(learner, Cue(shown=Cue.steps, image=True)) < 0.01


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.parametrize("learner", [bptt, ppo])
def test_what_is_remembered_may_be_an_image(learner):
    changes = {} if learner is ppo else dict(updates=200, learning_rate=5e-3)
    assert learnt_cost(learner, Cue(image=True), recurrent_size=8, **changes) < 0.05 * FORGETFUL_COST


@pytest.mark.slow
@pytest.mark.parametrize("per_agent", [False, True])
def test_a_sequence_is_replayed_as_it_was_flown_with_an_empty_memory_where_episodes_start(per_agent):
    env = envs.make("leader-follower")
    policy = jax.jit(lambda: Policy.init(KEY, env, (8,), per_agent, recurrent_size=4))()
    rng = np.random.default_rng(0)
    obs, first = rng.normal(size=(5, 3, 2, env.observation_size)), rng.normal(size=(3, 2, 4))
    starts = np.zeros((5, 3), bool)
    starts[2, 0] = starts[0, 1] = True

    def step(memory, step):
        obs, start = step
        return policy.act(jnp.where(start[:, None, None], 0, memory), obs)

    @jax.jit
    def actions():
        fresh = policy.replay(policy.initial_hidden_state((3, 2)), obs[2:], np.zeros((3, 3), bool))
        return jax.lax.scan(step, first, (obs, starts))[1], policy.replay(first, obs, starts), fresh

    flown, replayed, fresh = actions()
    np.testing.assert_allclose(replayed, flown, rtol=1e-9)
    np.testing.assert_allclose(replayed[2:, 0], fresh[:, 0], rtol=1e-9)
    assert jnp.all(jnp.abs(replayed[2:, 2] - fresh[:, 2]) > 0)  # where no episode starts, the past matters


@pytest.mark.slow
def test_episodes_that_follow_one_another_are_flown_as_each_would_be_alone():
    env = Cue()

    @jax.jit
    def actions():
        """(steps, 6 episodes, 1, 1), flown in three worlds one after the other, and each alone."""
        policy = Policy.init(KEY, env, (8,), recurrent_size=4)
        starts = collect.draw_starts(KEY, env, 3)
        worlds = collect.restart(KEY, collect.empty_worlds(env, 3, policy), starts)
        _, flown = collect.collect(KEY, env, collect.deterministic(policy), worlds, 2 * env.steps, starts=starts)
        action, obs = (jnp.concatenate(jnp.split(x, 2), axis=1) for x in (flown.action, flown.obs))
        return action, policy.replay(policy.initial_hidden_state((6, 1)), obs, jnp.zeros((env.steps, 6), bool))

    np.testing.assert_allclose(*actions(), rtol=1e-9)


@pytest.mark.slow
def test_ppo_replays_the_probabilities_that_it_recorded():
    env = Cue()
    config = dataclasses.replace(SMALL[ppo], horizon=4, recurrent_size=4, epochs=1, minibatches=1)
    config = dataclasses.replace(config, learning_rate=1e-12, min_learning_rate=1e-12)
    update = jax.jit(lambda state: ppo.update(env, config, state))
    state = ppo.init(KEY, env, config)
    for _ in range(4):  # episodes of six steps end within trajectories of four
        state, metrics = update(state)
        assert metrics["kl"] < 1e-14  # as the policy remains
    assert jnp.any(state.worlds.hidden_state != 0)


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.parametrize("learner", SMALL)
def test_seeds_by_vmap_are_the_seeds_alone(learner):
    config = dataclasses.replace(SMALL[learner], recurrent_size=4)
    learn = jax.jit(lambda key: learner.train(key, Cue(), config).history["reward"])
    keys = jax.random.split(KEY, 2)
    together = jax.jit(jax.vmap(learn))(keys)
    for i, key in enumerate(keys):
        np.testing.assert_allclose(together[i], learn(key), rtol=1e-4, atol=1e-5)


class ThenFall:
    """Thrust for some steps, none afterwards: a policy of a user, whose memory is a count."""

    def initial_hidden_state(self, batch):
        return jnp.zeros(batch, jnp.int32)

    def act(self, count, obs):
        return count + 1, jnp.broadcast_to(jnp.where(count < 3, 0.5, -1.0)[:, None], (len(count), 4))


@pytest.mark.slow
def test_every_way_to_fly_a_policy_carries_its_memory():
    env = envs.make("hover", duration=0.1, tilt=0.0, omega=0.0)
    log = fly_episode(env, ThenFall(), jax.random.split(KEY, 1)[0])
    thrusts = np.diff(log.drones.vel[:, 0, 2]) > 0
    np.testing.assert_array_equal(thrusts, [True] * 2 + [False] * (env.steps - 3))
    report = evaluate(env, ThenFall(), KEY, episodes=1)
    np.testing.assert_allclose(report.mean_return, log.reward.sum(), rtol=1e-9)


@pytest.mark.slow
def test_a_policy_with_a_memory_is_saved_and_says_how_it_is_called(tmp_path):
    env = envs.make("hover")
    policy = jax.jit(lambda: Policy.init(KEY, env, (8,), recurrent_size=4))()
    checkpoint.save(tmp_path / "policy", policy)
    loaded = checkpoint.load(tmp_path / "policy")
    assert jax.tree.structure(loaded) == jax.tree.structure(policy)
    obs = jnp.ones((1, env.observation_size))
    for mine, theirs in zip(*(p.act(p.initial_hidden_state((1,)), obs) for p in (policy, loaded)), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert "GRU of 4" in repr(policy)
    with pytest.raises(ValueError, match=r"recurrent; call policy.act\(hidden_state, obs\)"):
        policy(obs)
