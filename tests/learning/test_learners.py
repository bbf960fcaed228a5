"""Learners on problems with a known answer, and what all of them promise."""

import dataclasses
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from double_integrator import SMALL, Clock, DoubleIntegrator, Point, PointWorld, dynamics
from helpers import assert_close, jit_unoptimized, mostly_slow, name_of

from jaxdrones import envs
from jaxdrones.envs.observations import PrivilegedObservation
from jaxdrones.envs.randomize import scaled
from jaxdrones.learning import bptt, collect, critic, ppo, shac
from jaxdrones.learning.critic import critic_observation
from jaxdrones.learning.exploration import sample
from jaxdrones.learning.metrics import measure
from jaxdrones.learning.networks import MLP, Policy
from jaxdrones.learning.normalize import RunningStatistics
from jaxdrones.learning.returns import discounted_rewards

LEARNERS = pytest.mark.parametrize("learner", SMALL, ids=lambda module: module.__name__.rpartition(".")[2])


def best_cost(starts):
    """Mean cost of an episode under the optimal gains of the finite problem, by the Riccati recursion."""
    a, b = dynamics()
    q, r, p = np.diag([100, 10]), np.array([[10.0]]), np.zeros((2, 2))
    for _ in range(DoubleIntegrator.steps):
        gain = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
        p = q + a.T @ p @ (a - b @ gain)
    return np.mean(np.einsum("wi,ij,wj->w", starts, p, starts))


def flown_cost(env, policy, starts):
    worlds = jax.vmap(lambda x: PointWorld(Point(x[None]), jnp.zeros((), jnp.int32)))(starts)

    def step(worlds, _):
        _, worlds, reward, *_ = jax.vmap(env.step, (None, 0, 0))(None, worlds, policy(worlds.drones.pos))
        return worlds, reward

    return -jnp.mean(jnp.sum(jax.lax.scan(step, worlds, length=env.steps)[1], axis=0))


TOY = {
    "bptt": (bptt, dict(updates=300, worlds=64, horizon=50, restart_fraction=1.0, learning_rate=1e-2), 1.02),
    "shac": (
        shac,
        dict(updates=300, worlds=64, horizon=10, terminal_value_warmup=0.3, gamma=0.99, learning_rate=5e-3),
        1.05,
    ),
    "ppo": (ppo, dict(updates=300, worlds=128, horizon=25, gamma=0.95, gae_lambda=0.95, min_std=0.02), 1.15),
}


@pytest.mark.float32
@pytest.mark.parametrize(
    "learner, settings, within",
    [pytest.param(*case, marks=() if name == "bptt" else pytest.mark.slow, id=name) for name, case in TOY.items()],
)
def test_a_double_integrator_is_flown_nearly_as_cheaply_as_by_lqr(learner, settings, within):
    env, config = DoubleIntegrator(), learner.Config(hidden_sizes=(16,), **settings)
    policy = jax.jit(lambda key: learner.train(key, env, config).policy)(jax.random.key(0))
    starts = jax.random.uniform(jax.random.key(1), (200, 2), minval=-0.1, maxval=0.1)
    best = best_cost(np.asarray(starts, float))
    assert 0.999 * best < jit_unoptimized(flown_cost, static_argnums=0)(env, policy, starts) < within * best


@pytest.mark.slow
@LEARNERS
@pytest.mark.float32
def test_the_same_key_gives_the_same_result_and_seeds_by_vmap_are_the_seeds_alone(learner):
    env = envs.make("hover")

    def learn(key):
        result = learner.train(key, env, SMALL[learner])
        return result.policy.params, result.history["reward"]

    keys = jax.random.split(jax.random.key(0), 2)
    train, together = jax.jit(learn), jax.jit(jax.vmap(learn))(keys)
    for i, key in enumerate(keys):
        alone = train(key)
        for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(train(key)), strict=True):
            np.testing.assert_array_equal(a, b)
        # Rewards, not parameters: Adam makes steps of full size out of gradients that are all rounding.
        np.testing.assert_allclose(together[1][i], alone[1], rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.float32
def test_learning_rates_can_be_mapped():
    env = envs.make("hover")

    def change(rate):
        config = dataclasses.replace(SMALL[bptt], learning_rate=rate)
        state = bptt.init(jax.random.key(0), env, config)
        after, _ = bptt.update(env, config, state)
        return optax_norm(jax.tree.map(jnp.subtract, after.policy.params, state.policy.params))

    small, large = jit_unoptimized(jax.vmap(change))(jnp.array([1e-3, 1e-2]))
    np.testing.assert_allclose(large, 10 * small, rtol=1e-2)


def test_a_world_whose_episode_ends_goes_on_from_the_start_of_another_world_a_different_one_in_every_step():
    env, key = DoubleIntegrator(), jax.random.key(0)
    env.steps = 1

    @jit_unoptimized
    def observed(key):
        starts = collect.draw_starts(key, env, 4)
        worlds = collect.restart(key, collect.empty_worlds(env, 4), starts)
        act = lambda noise, memory, obs: (memory, obs[..., :1], None)  # noqa: E731
        return starts[0], collect.collect(key, env, act, worlds, 3, starts=starts)[1].obs

    starts, obs = observed(key)
    np.testing.assert_array_equal(obs, [jnp.roll(starts, -t, axis=0) for t in range(3)])


def rest(noise, memory, obs):
    """Action of zero."""
    return memory, 0 * obs, None


@pytest.mark.float32
@pytest.mark.parametrize("reset", mostly_slow([True, False], [True]))
def test_the_mean_return_is_that_of_all_episodes_however_long_and_none_before_one_could_end(reset):
    """Half of the episodes fail after one step, the others last for 10, unless they are cut."""
    env, horizon, fraction = Clock(steps=10, drones=2), 4, 0.3
    config = ppo.Config(horizon=horizon, restart_fraction=fraction)

    def update(worlds, step):
        start_key, restart_key, key = jax.random.split(jax.random.fold_in(jax.random.key(0), step), 3)
        starts = collect.draw_starts(start_key, env, 1000)
        worlds = collect.restart(restart_key, worlds, starts, fraction)
        worlds, flown = collect.collect(key, env, rest, worlds, horizon, starts=starts if reset else None)
        worlds, metrics = measure(env, config, step, worlds, flown)
        return worlds, metrics["return"]

    worlds = collect.empty_worlds(env, 1000)
    returns = np.asarray(jit_unoptimized(lambda w: jax.lax.scan(update, w, jnp.arange(120)))(worlds)[1])
    assert np.all(np.isnan(returns[:2])) and np.all(np.isfinite(returns[2:]))
    mean, episodes = 1.5 * (1 + 10) / 2, 1000 * 80 / 20  # 20 updates until the last episodes of all worlds are others
    np.testing.assert_allclose(np.mean(returns[40:]), mean, atol=4 * 1.5 * 4.5 * 2 / np.sqrt(episodes))


@pytest.mark.float32
def test_an_episode_that_fails_at_its_time_limit_is_terminated_and_not_truncated():
    env = Clock(steps=1)

    @jit_unoptimized
    def flown(key):
        starts = collect.draw_starts(key, env, 16)
        worlds = collect.restart(key, collect.empty_worlds(env, 16), starts)
        return worlds.episodes.world.drones.pos, collect.collect(key, env, rest, worlds, 1)[1]

    fails, trajectory = flown(jax.random.key(0))
    np.testing.assert_array_equal(trajectory.terminated[0], fails[..., 0] > 0)
    np.testing.assert_array_equal(trajectory.truncated, ~trajectory.terminated)
    assert 0 < np.sum(trajectory.terminated) < 16


@pytest.mark.float32
def test_with_a_discount_of_zero_bptt_learns_from_the_first_reward_alone():
    def gradient(horizon, gamma):
        config = dataclasses.replace(SMALL[bptt], horizon=horizon, gamma=gamma)
        env = DoubleIntegrator()
        return horizon * bptt.update(env, config, bptt.init(jax.random.key(0), env, config))[1]["gradient_norm"]

    first, discounted = jit_unoptimized(lambda: (gradient(1, 1.0), gradient(2, 0.0)))()
    assert first > 0
    np.testing.assert_allclose(discounted, first, rtol=1e-5)


class Dice(Clock):
    """Rewards that are drawn in every step."""

    def step(self, key, world, action):
        obs, world, reward, *rest = super().step(key, world, action)
        return obs, world, jax.random.uniform(key, reward.shape), *rest


@pytest.mark.float32
def test_every_step_of_every_world_draws_anew_and_what_has_ended_waits_for_its_restart():
    env = Dice(steps=3)

    @jit_unoptimized
    def flown(key):
        starts = collect.draw_starts(key, env, 8)
        worlds = collect.restart(key, collect.empty_worlds(env, 8), starts)
        after, trajectory = collect.collect(key, env, rest, worlds, 5)
        return after, trajectory, collect.restart(key, after, starts)

    after, trajectory, again = flown(jax.random.key(0))
    valid = ~np.asarray(trajectory.was_done)
    assert len(np.unique(trajectory.reward[valid])) == valid.sum() > 8
    lengths = valid.sum(axis=0)[:, 0]
    assert set(lengths.tolist()) == {1, 3} and np.all(after.done)
    np.testing.assert_array_equal(after.obs[:, 0, 0], lengths)
    np.testing.assert_array_equal(trajectory.obs[-1, :, 0, 0], lengths)
    assert not np.any(again.done) and not np.any(again.obs) and not np.any(again.episodes.length)


def test_as_many_worlds_are_restarted_as_the_fraction_says_and_all_that_have_ended():
    env = Clock()

    @jit_unoptimized
    def restarted(key):
        starts = collect.draw_starts(key, env, 1000)
        worlds = collect.empty_worlds(env, 1000)
        flying = worlds.replace(done=jnp.arange(1000) < 100, obs=worlds.obs + 1)
        return collect.restart(key, flying, starts, 0.3).obs[:, 0, 0] == 0

    found = np.asarray(restarted(jax.random.key(0)))
    assert np.all(found[:100])
    assert np.mean(found[100:]) == pytest.approx(0.3, abs=4 * np.sqrt(0.3 * 0.7 / 900))


class Watched(Clock):
    """A team whose privileged observation is the time of its episode."""

    def privileged_observation(self, world):
        time = jnp.full((self.drones, 1), world.step, float)
        return PrivilegedObservation(time, 0 * time)


@pytest.mark.float32
def test_memory_begins_anew_with_every_episode_and_what_is_recorded_is_of_the_observations_before_and_after_a_step():
    """The memory counts observations; that of the first one of an episode is 1."""
    env = Watched(steps=3)

    def count(noise, memory, obs):
        return memory + 1, 0 * obs, None

    @jit_unoptimized
    def flown(key):
        starts = collect.draw_starts(key, env, 4)
        worlds = collect.empty_worlds(env, 4).replace(hidden_state=jnp.full((4, 1, 1), 7.0))
        worlds = collect.restart(key, worlds, starts)
        return collect.collect(key, env, count, worlds, 7, starts=starts, privileged=True)[1]

    trajectory = flown(jax.random.key(0))
    np.testing.assert_array_equal(trajectory.hidden_state, trajectory.obs + 1)
    np.testing.assert_array_equal(trajectory.privileged.obs, trajectory.obs)
    np.testing.assert_array_equal(trajectory.final_obs, trajectory.obs + 1)
    np.testing.assert_array_equal(trajectory.final_privileged.obs, trajectory.final_obs)
    assert np.sum(trajectory.done) > 4


@pytest.mark.float32
@pytest.mark.parametrize("learner", mostly_slow(SMALL, [bptt, ppo]), ids=name_of)
def test_a_fraction_of_the_worlds_starts_new_episodes_before_an_update_and_the_others_continue_theirs(learner):
    env = DoubleIntegrator()
    steps = jnp.array([11, 11, 12])  # after 12 updates no episode can have ended, after 13 one can

    def updated(restart_fraction, step):
        config = dataclasses.replace(SMALL[learner], restart_fraction=restart_fraction)
        state = learner.init(jax.random.key(0), env, config)
        worlds = state.worlds.replace(
            episodes=state.worlds.episodes.replace(length=jnp.full(4, 7, jnp.int32)), done=jnp.zeros(4, bool)
        )
        worlds = worlds.replace(last_weight=jnp.ones(4))
        after, metrics = learner.update(env, config, state.replace(worlds=worlds, step=step))
        counts = [count for _, count in optax.tree.get_all_with_path(after.opt_state, "count")]
        keys = jax.random.key_data(state.key), jax.random.key_data(after.key)
        return after.worlds.episodes.length, (keys, after.step, counts, metrics["return"])

    (none, all_worlds, _), rest = jit_unoptimized(jax.vmap(updated))(jnp.array([0.0, 1.0, 0.0]), steps)
    keys, step, counts, returns = rest
    np.testing.assert_array_equal(none, 7 + SMALL[learner].horizon)
    np.testing.assert_array_equal(all_worlds, SMALL[learner].horizon)
    assert not np.array_equal(*keys)  # the next update draws anew
    np.testing.assert_array_equal(step, steps + 1)
    np.testing.assert_array_equal(np.isnan(returns), [True, True, False])
    gradient_steps = SMALL[ppo].epochs * SMALL[ppo].minibatches if learner is ppo else 1
    np.testing.assert_array_equal(counts, np.full_like(counts, gradient_steps))


@pytest.mark.parametrize("learner", [bptt, shac], ids=name_of)
def test_the_learning_rate_falls_to_zero_by_a_cosine_over_all_gradient_steps_and_stays_there(learner):
    """With a constant gradient a step of Adam is as long as the learning rate."""
    config = dataclasses.replace(SMALL[learner], updates=3, learning_rate=0.5)
    optimizers = [(bptt.optimizer(config), 3, 0.5)]
    if learner is shac:
        optimizers += [(shac._critic_optimizer(config), 3 * config.critic_steps, config.critic_learning_rate)]
    for optimizer, count, rate in optimizers:
        params = jnp.zeros(1)
        state, steps = optimizer.init(params), []
        update = jit_unoptimized(optimizer.update)
        for _ in range(count + 2):
            step, state = update(params + 0.1, state)
            steps.append(-step.item())
        made = np.minimum(np.arange(count + 2), count)
        np.testing.assert_allclose(steps, rate * (1 + np.cos(np.pi * made / count)) / 2, rtol=1e-5)


@pytest.mark.parametrize("learner", SMALL, ids=name_of)
def test_an_optimizer_takes_a_gradient_of_any_length_as_one_of_the_largest_norm(learner):
    """After a shorter one, as the first step of Adam is the same for every length."""
    config = dataclasses.replace(SMALL[learner], max_grad_norm=0.5)
    optimizers = [ppo._optimizer(config)] if learner is ppo else [bptt.optimizer(config)]
    optimizers += [shac._critic_optimizer(config)] if learner is shac else []
    for optimizer in optimizers:
        params = jnp.zeros(2)
        update = jit_unoptimized(optimizer.update)
        state = update(params + 0.01, optimizer.init(params))[1]
        direction = jnp.array([0.6, -0.8])
        at_limit, beyond, below = (update(length * direction, state)[0] for length in (0.5, 500.0, 0.05))
        np.testing.assert_allclose(beyond, at_limit, rtol=1e-6)
        assert optax_norm(below - at_limit) > 0.01 * optax_norm(at_limit)


@pytest.mark.float32
def test_the_target_critic_of_shac_moves_a_part_of_the_way_to_the_critic_after_its_gradient_steps():
    env = DoubleIntegrator()
    config = dataclasses.replace(SMALL[shac], target_update_rate=0.25, critic_steps=3, horizon=2)

    @jit_unoptimized
    def update(key):
        before = shac.init(key, env, config)
        return before, shac.update(env, config, before)[0]

    before, after = update(jax.random.key(0))
    assert_close(after.target_critic, jax.tree.map(lambda x, y: x + (y - x) / 4, before.critic, after.critic), 1e-6)
    assert optax_norm(jax.tree.map(jnp.subtract, after.critic, before.critic)) > 3 * config.critic_learning_rate
    counts = optax.tree.get_all_with_path(after.critic_opt_state, "count")
    assert {int(count) for _, count in counts} == {3}
    assert before.key != after.key and after.step == 1  # the next update draws, and counts, anew


class Leaver(Clock):
    """The first of two drones leaves after two steps, and observes a number that means nothing from then on."""

    task = types.SimpleNamespace(**vars(Clock.task) | {"ends": "drone"})

    def __init__(self, meaningless):
        super().__init__(steps=4, drones=2)
        self.meaningless = meaningless

    def step(self, key, world, action):
        obs, world, _, _, truncated, info = super().step(key, world.replace(drones=Point(0 * world.drones.pos)), action)
        first = jnp.arange(2) == 0
        active = ~first | (world.step <= 2)
        info |= dict(active=active, terminated=first & (world.step == 2), truncated=truncated & active)
        obs = jnp.where((active & ~info["terminated"])[:, None], obs, self.meaningless)
        return obs, world, jnp.where(active, -(action[:, 0] ** 2), 0), jnp.zeros((), bool), truncated, info


@pytest.mark.float32
def test_ppo_learns_nothing_from_what_a_drone_observes_after_its_end():
    config = dataclasses.replace(SMALL[ppo], horizon=5, epochs=1, minibatches=1)

    def learnt(meaningless):
        env = Leaver(meaningless)
        after, metrics = ppo.update(env, config, ppo.init(jax.random.key(0), env, config))
        return after.policy, after.critic, after.log_std, metrics

    learnt = jit_unoptimized(jax.vmap(learnt))(jnp.array([0.0, 3.0]))
    for x in jax.tree.leaves(learnt):
        np.testing.assert_allclose(x[1], x[0], rtol=1e-4, atol=1e-6)


@pytest.mark.float32
@pytest.mark.parametrize("learner", mostly_slow([bptt, shac], [bptt]), ids=["bptt", "shac"])
def test_the_statistics_of_observations_are_those_of_the_steps_of_episodes(learner):
    """An episode observes 0, 1, 2; where nothing is reset, five more steps of the trajectory observe 3."""
    env = Clock(steps=3)
    config = dataclasses.replace(SMALL[learner], horizon=8, worlds=16)
    after, metrics = jit_unoptimized(lambda key: learner.update(env, config, learner.init(key, env, config)))(
        jax.random.key(0)
    )
    mean, count = float(after.policy.obs_stats.mean[0]), float(after.policy.obs_stats.count)
    lasting = (count - 16) / 2  # of episodes that fail only 0 is observed
    np.testing.assert_allclose(mean, 3 * lasting / count, rtol=1e-6)
    np.testing.assert_allclose(metrics["return"], (3 * lasting + (16 - lasting)) / 16, rtol=1e-6)


def test_statistics_forget_what_is_older_than_their_window_of_trajectories_and_are_frozen_in_the_end():
    config = types.SimpleNamespace(obs_stats_window=0.5, obs_stats_freeze=0.4, updates=10)
    obs, ended = jnp.ones((3, 4, 2, 5)), jnp.asarray(np.arange(4)[:, None] * np.ones((3, 1, 2)) > 2)
    trajectory = types.SimpleNamespace(obs=obs, was_done=ended)
    before = RunningStatistics(jnp.zeros(5), jnp.ones(5), jnp.asarray(100.0))
    updated = jit_unoptimized(lambda step: collect.update_obs_stats(before, trajectory, config, step))
    after, frozen = map(updated, (3, 4))
    np.testing.assert_allclose(
        [after.count, after.mean[0]], [12 + 18, 18 / 30]
    )  # half of 24 steps, and those that count
    np.testing.assert_array_equal([frozen.count, frozen.mean[0]], [100, 0])


def test_the_network_of_a_critic_has_outputs_of_the_size_of_a_reward(monkeypatch):
    monkeypatch.setattr(critic, "apply", lambda *_: (None, jnp.full((2, 3, 1), 4.0)))
    value = critic.discounted_value(ppo.Config(gamma=0.75), None, jnp.zeros((2, 3, 5)))
    np.testing.assert_array_equal(value, np.full((2, 3), 16.0))


@pytest.fixture
def three_worlds(monkeypatch):
    """Trajectory of worlds that go on, are truncated in step 0, and terminate in step 1; values are what is seen.

    This is the sum of observation, memory after it, and privileged observation: 8, 16 and 24 at the end of a step, 7,
    15 and 23 at its start. Critics are factors of it.
    """
    monkeypatch.setattr(shac, "critic_observation", lambda policy, *seen: sum(seen))
    monkeypatch.setattr(shac, "discounted_value", lambda config, critic, obs: critic * obs[..., 0])
    obs = jnp.broadcast_to(8.0 * jnp.arange(1, 4)[:, None, None, None], (3, 3, 1, 1))
    truncated, terminated, was_done = np.zeros((3, 3, 3, 1), bool)
    truncated[0, 1], terminated[1, 2], was_done[1:, 1], was_done[2:, 2] = True, True, True, True
    ends = dict(truncated=truncated, terminated=terminated, was_done=was_done)
    seen = dict(obs=obs - 1, hidden_state=0 * obs, privileged=0 * obs, final_obs=obs - 2, final_privileged=0 * obs + 1)
    own = {"reward": jnp.ones((3, 3, 1))} | seen | jax.tree.map(jnp.asarray, ends)
    return collect.Trajectory(**dict.fromkeys(collect.Trajectory.__dataclass_fields__) | own)


ACTS = types.SimpleNamespace(act=lambda hidden, obs: (hidden + 1, obs))


@pytest.mark.parametrize(("step", "weight"), [(3, 0.5), (9, 1.0)])
def test_the_cost_of_shac_is_that_of_the_discounted_rewards_and_of_the_value_after_them(
    step, weight, three_worlds, monkeypatch
):
    """Half of the value counts after half of the warmup, and all of it after the whole."""
    costs = []
    monkeypatch.setattr(bptt, "policy_step", lambda *args, **_: costs.append(args[-1]))
    state = types.SimpleNamespace(key=jax.random.key(0), step=step, target_critic=1.0)
    with pytest.raises(TypeError):  # as no step is made
        shac.update(None, shac.Config(gamma=0.5, horizon=3, updates=10, terminal_value_warmup=0.6), state)
    worth = [1 + 1 / 2 + 1 / 4 + weight * 24 / 8, 1 + weight * 8 / 2, 1 + 1 / 2]
    cost = jit_unoptimized(lambda trajectory: costs[0](ACTS, trajectory))
    np.testing.assert_allclose(cost(three_worlds), -np.mean(worth) / 3)
    failed = three_worlds.replace(terminated=three_worlds.terminated.at[-1, 0].set(True))
    np.testing.assert_allclose(cost(failed), -np.mean([1 + 1 / 2 + 1 / 4, *worth[1:]]) / 3)


def test_the_critic_of_shac_learns_the_values_of_the_target_critic_in_steps_that_count(three_worlds):
    config = shac.Config(gamma=0.5, gae_lambda=1.0, horizon=3, critic_steps=1)
    critic, optimizer = jnp.zeros(()), shac._critic_optimizer(config)
    state = types.SimpleNamespace(
        policy=ACTS, critic=critic, target_critic=jnp.asarray(2.0), critic_opt_state=optimizer.init(critic)
    )
    fit = jit_unoptimized(lambda key, trajectory: shac._fit_critic(config, key, state, trajectory)[2]["loss"])
    loss = fit(jax.random.key(0), three_worlds)
    now, later = 2 * np.array([7, 15, 23]), 2 * np.array([8, 16, 24])
    a, b, c = 1 + later / 2 - now  # errors of one step, and below those of all steps to the end
    goes_on, truncated, terminated = (a + b / 2 + c / 4, b + c / 2, c), (a,), (a + (1 - now[1]) / 2, 1 - now[1])
    targets = np.concatenate([error + now[: len(error)] for error in (goes_on, truncated, terminated)])
    np.testing.assert_allclose(loss, 0.5**2 * np.sum(np.square(targets)) / 9)


def test_the_critic_of_shac_learns_from_every_step_of_a_trajectory(three_worlds):
    """Also from the first and the last of five, of which each gradient step takes four."""
    config = shac.Config(gamma=0.5, gae_lambda=0.0, horizon=5, critic_steps=16)
    critic, optimizer = jnp.zeros(()), shac._critic_optimizer(config)
    state = types.SimpleNamespace(
        policy=ACTS, critic=critic, target_critic=critic, critic_opt_state=optimizer.init(critic)
    )

    def loss(rewarded):
        """Of a trajectory in which only one step has a reward, and so a value other than that of the critic."""
        reward = 1.0 * (jnp.arange(5) == rewarded)[:, None, None]
        never, obs = jnp.zeros((5, 1, 1), bool), jnp.zeros((5, 1, 1, 1))
        ends = dict(truncated=never, terminated=never, was_done=never)
        names = ("obs", "hidden_state", "privileged", "final_obs", "final_privileged")
        trajectory = three_worlds.replace(reward=reward, **dict.fromkeys(names, obs), **ends)
        return shac._fit_critic(config, jax.random.key(0), state, trajectory)[2]["loss"]

    losses = jit_unoptimized(jax.vmap(loss))(jnp.arange(5))
    np.testing.assert_allclose(losses[1:4], 0.5**2 / 4)
    np.testing.assert_allclose(losses[0] + losses[4], 0.5**2 / 4)
    assert losses[0] > 0 and losses[4] > 0


@pytest.mark.float32
@pytest.mark.parametrize("ends", mostly_slow(["truncated", "terminated"], ["truncated"]))
def test_an_episode_that_ends_inside_a_trajectory_of_shac_is_worth_the_same_as_one_that_ends_with_it(ends):
    """Without rewards the gradient is that of the terminal value, which a time limit and a cut have."""

    class Unrewarded(DoubleIntegrator):
        steps = 3

        def step(self, key, world, action):
            obs, world, reward, terminated, truncated, info = super().step(key, world, action)
            fails = truncated if ends == "terminated" else terminated
            return obs, world, 0 * reward, fails, truncated, info | {"terminated": fails[None]}

    def gradient(horizon):
        config = dataclasses.replace(SMALL[shac], horizon=horizon, gamma=0.9)
        state = shac.init(jax.random.key(0), Unrewarded(), config).replace(step=jnp.asarray(2))
        return horizon * shac.update(Unrewarded(), config, state)[1]["gradient_norm"]

    cut, alone, inside = jit_unoptimized(lambda: (gradient(2), gradient(3), gradient(8)))()
    assert cut > 0 and (alone > 0) == (ends == "truncated")
    np.testing.assert_allclose(inside, alone, rtol=1e-5)


@pytest.mark.float32
def test_a_centralized_critic_is_bootstrapped_with_the_actions_that_follow():
    """With lambda 0 a target is the reward and the value of what the critic takes in the next step."""
    env = Clock(steps=5, drones=2)
    config = dataclasses.replace(SMALL[ppo], horizon=12, gae_lambda=0.0, gamma=0.9, centralized_critic=True)

    @jit_unoptimized
    def batch_of(key):
        state = ppo.init(jax.random.key(0), env, config)
        state = state.replace(critic=jax.tree.map(lambda x: x + 0.3, state.critic))
        starts = collect.draw_starts(jax.random.key(1), env, config.worlds)
        worlds = collect.restart(jax.random.key(1), state.worlds, starts)
        act = jax.tree_util.Partial(ppo.explore, state.policy, state.log_std)
        shape = (config.horizon, config.worlds, 2, env.action_size)
        noise, later = jax.random.normal(jax.random.key(2), shape), jax.random.normal(key, shape)
        _, flown = collect.collect(jax.random.key(2), env, act, worlds, config.horizon, noise=noise, starts=starts)
        batch = ppo.batch_of(config, state, None, flown, later)
        value = ppo.discounted_value(config, state.critic, batch.critic_obs)
        return flown.terminated[..., 0], flown.done, batch, value

    terminated, done, batch, value = jax.tree.map(np.asarray, batch_of(jax.random.key(3)))
    within = ~done[:-1]
    reward = np.array([1.0, 2.0])
    np.testing.assert_allclose(batch.value_target[:-1][within], (reward + 0.9 * value[1:])[within], rtol=1e-5)
    np.testing.assert_allclose(batch.value_target[terminated], np.tile(reward, (int(terminated.sum()), 1)), rtol=1e-5)
    other = batch_of(jax.random.key(4))[2].value_target
    drawn = done & ~terminated
    drawn[-1] |= ~done[-1]
    np.testing.assert_array_equal(np.any(other != batch.value_target, axis=-1), drawn)


@pytest.mark.float32
@pytest.mark.parametrize("epochs, minibatches", [pytest.param(1, 1, marks=pytest.mark.slow), (3, 2)])
def test_the_learning_rate_of_ppo_moves_once_an_update_by_the_divergence_after_it(epochs, minibatches):
    env = DoubleIntegrator()
    config = dataclasses.replace(SMALL[ppo], epochs=epochs, minibatches=minibatches, max_learning_rate=10.0)
    rates, updates = jnp.array([1e-4, 3.0, 1e-4, 1e-4]), jnp.array([3, 3, 1, 2])
    std, anneal_fraction = jnp.array([0.4, 0.05, 0.4, 0.4]), jnp.array([0.3, 0.3, 0.3, 1.0])

    def update(rate, updates, std, anneal_fraction):
        own = dict(learning_rate=rate, updates=updates, init_std=std, anneal_fraction=anneal_fraction)
        own = dataclasses.replace(config, **own)
        after, metrics = ppo.update(env, own, ppo.init(jax.random.key(0), env, own))
        counts = after.policy.obs_stats.count, optax.tree.get(after.opt_state, "count")
        return metrics, after.learning_rate, *counts

    metrics, rate, observed, steps = jit_unoptimized(jax.vmap(update))(rates, updates, std, anneal_fraction)
    np.testing.assert_array_equal(observed, config.worlds * config.horizon)
    np.testing.assert_array_equal(steps, epochs * minibatches)
    assert 0 < metrics["kl"][0] < config.target_kl / 2 and metrics["kl"][1] > 2 * config.target_kl
    moved = [1.2e-4, 3 / 1.2, config.min_learning_rate]  # the last one after the last update
    np.testing.assert_allclose(rate[:3], moved, rtol=1e-6)
    np.testing.assert_array_equal(metrics["learning_rate"], rate)
    stds = [0.05, config.final_std, (0.4 * config.final_std) ** 0.5]  # below min_std; after the last update; halfway
    np.testing.assert_allclose(metrics["action_std"][1:], stds, rtol=1e-6)


@pytest.mark.float32
def test_policy_standard_deviation_and_critic_of_ppo_move_by_their_learning_rates():
    """The first step of Adam is as long as the learning rate in every parameter with a gradient.

    The entropy has such a weight that the standard deviation rises.
    """
    env, rates = DoubleIntegrator(), jnp.array([1e-4, 1e-2])
    config = dataclasses.replace(SMALL[ppo], epochs=1, minibatches=1, critic_learning_rate=1e-3, entropy_coef=10.0)

    def largest_steps(rate):
        before = ppo.init(jax.random.key(0), env, dataclasses.replace(config, learning_rate=rate))
        before = before.replace(log_std=before.log_std - 0.5)  # within its bounds
        after, _ = ppo.update(env, config, before)
        of = lambda state: (state.policy.params, state.critic)  # noqa: E731
        steps = jax.tree.map(lambda x, y: jnp.max(jnp.abs(y - x)), of(before), of(after))
        policy, critic = (jnp.max(jnp.stack(jax.tree.leaves(step))) for step in steps)
        return policy, (after.log_std - before.log_std)[0], critic

    policy, log_std, critic = jit_unoptimized(jax.vmap(largest_steps))(rates)
    np.testing.assert_allclose([policy, log_std], [rates, rates], rtol=0.01)  # the parameters are rounded
    np.testing.assert_allclose(critic, [1e-3, 1e-3], rtol=0.01)


class Drawn(Exception):
    """The end of what a test looks at."""


def are_different(keys):
    return len({jax.random.key_data(key).tobytes() for key in keys}) == len(keys)


@pytest.mark.parametrize("learner", [bptt, ppo, shac], ids=name_of)
def test_every_draw_of_an_update_has_a_key_of_its_own(learner, monkeypatch):
    keys = [jax.random.key(0)]

    def drawn(key, *_, **__):
        keys.append(key)
        return types.SimpleNamespace(hidden_state=None)

    def last(key, *_, **__):
        keys.append(key)
        raise Drawn

    for name, function in {"draw_starts": drawn, "restart": drawn, "collect": last}.items():
        monkeypatch.setattr(collect, name, function)
    policy = types.SimpleNamespace(params=0.0, replace=lambda **_: None)
    state = types.SimpleNamespace(key=keys[0], step=0, worlds=None, policy=policy, log_std=jnp.zeros(1))
    with pytest.raises(Drawn):
        learner.update(DoubleIntegrator(), SMALL[learner], state)
    assert len(keys) == 4 and are_different(keys)


@pytest.mark.parametrize("learner", [ppo, shac], ids=name_of)
def test_policy_and_critic_are_drawn_from_keys_of_their_own(learner, monkeypatch):
    keys = [jax.random.key(0)]

    def last(key, *_):
        keys.append(key)
        raise Drawn

    monkeypatch.setattr(learner.result, "init_policy", lambda key, *_: keys.append(key))
    monkeypatch.setattr(learner, "init_critic", last)
    with pytest.raises(Drawn):
        learner.init(keys[0], DoubleIntegrator(), SMALL[learner])
    assert len(keys) == 3 and are_different(keys)


def test_an_update_of_shac_has_a_key_for_its_critic_and_counts_the_gradients_of_policy_and_critic(monkeypatch):
    keys, fitted = [jax.random.key(0)], (jnp.ones(()), None, {"loss": 5.0, "nonfinite_gradients": 3})

    def policy_step(env, config, state, own, *_, **__):
        keys.extend(own)
        return state, None, {"nonfinite_gradients": 4}

    def fit(key, *_):
        keys.append(key)
        return fitted

    monkeypatch.setattr(bptt, "policy_step", policy_step)
    monkeypatch.setattr(shac.sharding, "map_worlds", lambda *_: fit)
    state = types.SimpleNamespace(key=keys[0], step=0, target_critic=jnp.zeros(()), replace=lambda **new: new)
    after, metrics = shac.update(None, SMALL[shac], state)
    keys.append(after["key"])
    assert len(keys) == 6 and are_different(keys)
    assert metrics == {"critic_loss": 5.0, "nonfinite_gradients": 7}


def optax_norm(tree):
    return jnp.sqrt(sum(jnp.sum(x**2) for x in jax.tree.leaves(tree)))


@pytest.mark.slow
@pytest.mark.float32
def test_a_centralized_critic_learns_with_a_policy_per_agent():
    env = envs.make("leader-follower")
    config = dataclasses.replace(SMALL[ppo], per_agent=True, centralized_critic=True)
    state = ppo.init(jax.random.key(0), env, config)
    kernel = state.critic["params"]["Dense_0"]["kernel"]
    assert kernel.shape == (2, 25, 8)
    after, metrics = jit_unoptimized(lambda state: ppo.update(env, config, state))(state)
    assert all(jnp.isfinite(x) for name, x in metrics.items() if name != "return")  # no episode has ended
    change = after.critic["params"]["Dense_0"]["kernel"] - kernel
    assert jnp.all(jnp.any(change != 0, axis=(1, 2)))


@pytest.mark.slow
@pytest.mark.float32
def test_a_privileged_critic_learns_the_value_of_drawn_parameters():
    """The reward is a parameter that is not observed: a privileged critic knows it, another one only its mean."""
    task = envs.make("hover").task
    gain = {"mass": (100.0, lambda task, world: world.params.mass - 0.027)}
    task = dataclasses.replace(task, rewards=gain, terminations={}, duration=1.0)
    env = envs.make(task, randomize=(scaled("mass", 0.5, 1.5),))

    def value_loss(privileged):
        config = dataclasses.replace(
            SMALL[ppo],
            updates=200,
            epochs=8,
            worlds=64,
            horizon=8,
            learning_rate=5e-3,
            privileged_critic=privileged,
            gamma=0.9,
        )
        history = jax.jit(lambda key: ppo.train(key, env, config))(jax.random.key(0)).history
        return jnp.mean(history["value_loss"][-10:])

    assert value_loss(True) < 0.2 * value_loss(False)


@pytest.mark.slow
@pytest.mark.float32
def test_episodes_that_ended_stay_as_they_are_and_do_not_count_until_they_are_restarted():
    env = envs.make("hover", duration=0.05)  # five steps
    starts = collect.draw_starts(jax.random.key(0), env, 2)
    worlds = collect.restart(jax.random.key(0), collect.empty_worlds(env, 2), starts)

    def hover(noise, memory, obs):
        return memory, jnp.zeros((2, 1, 4)), None

    worlds, trajectory = jit_unoptimized(lambda w: collect.collect(jax.random.key(1), env, hover, w, 7))(worlds)
    np.testing.assert_array_equal(trajectory.was_done[:, 0, 0], [False] * 5 + [True] * 2)
    assert jnp.all(worlds.done)
    np.testing.assert_array_equal(worlds.obs, trajectory.final_obs[4])
    assert jnp.all(discounted_rewards(trajectory, 1.0)[5:] == 0)
    again = collect.restart(jax.random.key(2), worlds, starts)
    assert jnp.all(again.episodes.length == 0) and not jnp.any(again.done)


def test_the_logarithm_of_a_probability_is_that_of_a_normal_distribution():
    rng = np.random.default_rng(0)
    action, mean, log_std = rng.normal(size=(5, 2, 3)), rng.normal(size=(5, 2, 3)), rng.normal(size=(3,))
    std = np.exp(log_std)
    density = np.exp(-((action - mean) ** 2) / (2 * std**2)) / (std * np.sqrt(2 * np.pi))
    np.testing.assert_allclose(ppo.log_prob(action, mean, jnp.asarray(log_std)), np.log(density).sum(-1), rtol=1e-12)
    noise = (action - mean) / std
    np.testing.assert_allclose(sample(noise, mean, jnp.asarray(log_std)), action, rtol=1e-12)


@pytest.mark.slow
def test_ppo_at_the_policy_that_flew_has_the_plain_policy_gradient():
    config = ppo.Config(value_coef=0.0, gamma=0.9)
    rng = np.random.default_rng(0)
    network = MLP((4,), 2)
    policy = Policy(network.init(jax.random.key(0), jnp.zeros(3)), RunningStatistics.empty(3), network)
    critic = MLP(config.critic_hidden_sizes, 1).init(jax.random.key(1), jnp.zeros(3))
    obs, action, advantage = rng.normal(size=(20, 1, 3)), rng.normal(size=(20, 1, 2)), rng.normal(size=(20, 1))
    log_std = jnp.zeros(2)
    behavior = ppo.log_prob(action, policy(obs), log_std)
    batch = ppo.Batch(obs, action, behavior, obs, advantage, jnp.zeros((20, 1)))

    def clipped(params):
        return ppo.loss(config, policy.replace(params=params), log_std, critic, batch)[0]

    def plain(params):
        return -jnp.mean(ppo.log_prob(action, policy.replace(params=params)(obs), log_std) * advantage)

    mine, theirs = jax.grad(clipped)(policy.params), jax.grad(plain)(policy.params)
    for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_deviations_of_parameters_of_any_vehicle_are_within_the_reach_of_a_critic():
    """They are up to 1,000 times the nominal ones, at which every unit of the network is saturated."""
    statistics = RunningStatistics(jnp.array([1.0, 2.0]), jnp.array([4.0, 9.0]), jnp.ones(()))
    policy: Any = types.SimpleNamespace(obs_stats=statistics)
    params = jnp.array([[0.5, -1.0, 1160.0, -1160.0, 0.0]])
    found = critic_observation(policy, jnp.full((1, 2), 7.0), None, PrivilegedObservation(jnp.zeros((1, 2)), params))
    np.testing.assert_allclose(found[0, :2], [-1 / 2, -2 / 3], rtol=1e-6)  # normalized like what a policy observes
    large = 1 + np.log(1160)
    np.testing.assert_allclose(found[0, 2:], [0.5, -1.0, large, -large, 0.0], rtol=1e-6)
