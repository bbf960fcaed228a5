import contextlib
import dataclasses
import functools
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized, mostly_slow

pytest.importorskip("brax")
from jaxdrones.adapters import brax
from jaxdrones.envs import TASKS, make
from jaxdrones.tasks.hover import hover

with contextlib.redirect_stdout(sys.stderr):
    from brax.envs.wrappers import training

pytestmark = pytest.mark.float32


@pytest.mark.slow
@pytest.mark.parametrize("task", mostly_slow(TASKS, ["swap-goals"]))
def test_a_step_returns_what_it_was_given_as_the_trainers_scan_over_it(task, env_of):
    env = brax.wrap(env_of(task))
    batch = training.EvalWrapper(brax.wrap_for_training(env, episode_length=5))
    keys = jax.ShapeDtypeStruct((3, 2), jnp.uint32)
    start = jax.eval_shape(batch.reset, keys)
    after = jax.eval_shape(batch.step, start, jax.ShapeDtypeStruct((3, env.action_size), jnp.float32))
    sizes = jax.tree.leaves(env.observation_size, is_leaf=lambda x: isinstance(x, tuple))
    assert [x.shape[1:] for x in jax.tree.leaves(start.obs)] == [np.shape(np.empty(size)) for size in sizes]
    assert jax.tree.structure(start) == jax.tree.structure(after)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), start) == jax.tree.map(lambda x: (x.shape, x.dtype), after)
    assert all(x.shape == (3,) and x.dtype == jnp.float32 for x in (after.reward, after.done))


def test_the_reward_of_a_team_is_the_sum_of_its_drones_unless_the_mean_is_asked_for(env_of):
    plain = env_of("hover", drones=2, duration=0.02)

    @jit_unoptimized
    def step(key):
        state = brax.wrap(plain).reset(key)
        world, step_key = state.pipeline_state
        rewards = plain.step(jax.random.fold_in(step_key, world.step), world, jnp.full((2, 4), 0.1))[2]
        action = jnp.full(8, 0.1)
        return rewards, brax.wrap(plain).step(state, action), brax.wrap(plain, team_reward="mean").step(state, action)

    rewards, *states = step(jax.random.key(0))
    for state, expected in zip(states, (rewards.sum(), rewards.mean()), strict=True):
        np.testing.assert_allclose(state.reward, expected, rtol=1e-6)
        terms = sum(x for name, x in state.metrics.items() if name.startswith("reward_"))
        np.testing.assert_allclose(terms, expected, rtol=1e-5)


@functools.cache
def two_ends():
    """Above 2.2 m the episode is terminated, below 1.8 m it is cut."""
    plain = hover(reach=0.0, speed=0.0, omega=0.0, tilt=0.0)
    return make(
        dataclasses.replace(
            plain,
            terminations={"high": lambda task, world: world.drones.pos[:, 2] > 2.2},
            truncations={"low": lambda task, world: world.drones.pos[:, 2] < 1.8},
        )
    )


def flown(env, wrapped, actions, steps):
    """What brax sees over some steps, each world with a constant action for all motors."""
    state = jit_unoptimized(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), len(actions)))
    held = jnp.broadcast_to(jnp.asarray(actions)[:, None], (len(actions), env.action_size))

    def step(state, _):
        state = wrapped.step(state, held)
        return state, (state.done, state.info["truncation"], state.info["time_out"], state.info["steps"], state.obs)

    return [np.asarray(x) for x in jit_unoptimized(lambda s: jax.lax.scan(step, s, length=steps))(state)[1]]


@pytest.mark.slow
def test_a_cut_is_told_from_an_end():
    env = brax.wrap(two_ends())
    wrapped = brax.wrap_for_training(env, episode_length=60)
    done, truncation, time_out, steps, _ = flown(env, wrapped, [1.0, -1.0, 0.0], 60)
    first = done.argmax(axis=0)
    assert done.max() == 1 and first[0] < 59 and first[1] < 59 and first[2] == 59
    assert truncation[first, [0, 1, 2]].tolist() == [0, 1, 1]
    np.testing.assert_array_equal(truncation, time_out)
    assert steps[first[0] + 1, 0] == 1  # of the next episode


@pytest.mark.slow
def test_a_team_whose_drones_end_alone_goes_on_until_its_last_is_cut():
    """Also beyond its own time limit; a drone that left, and was moved far away, is not counted in its metrics."""
    late = {"late": lambda task, world: world.step >= jnp.array([2, 6])}
    plain = make(dataclasses.replace(hover(drones=2, duration=0.04), ends="drone", terminations={}, truncations=late))
    env = brax.wrap(plain)
    state = jit_unoptimized(env.reset)(jax.random.PRNGKey(0))
    step, after = jit_unoptimized(env.step), []
    for _ in range(6):
        state = step(state, jnp.zeros(8))
        after.append(state)
    done = [float(x.done) for x in after]
    assert done.index(1) > plain.steps and done == [float(x.info["time_out"]) for x in after]
    assert not np.any(after[-1].pipeline_state[0].active) and max(x.metrics["error"] for x in after) < 10


@pytest.mark.parametrize(
    ("ends", "terminated", "cut", "active", "done", "time_out"),
    [
        ("team", [0, 0], [0, 0], [1, 1], 0, 0),
        ("team", [1, 0], [0, 0], [1, 0], 1, 0),
        ("team", [0, 0], [0, 1], [1, 0], 1, 1),
        ("team", [1, 0], [0, 1], [1, 0], 1, 0),
        ("drone", [1, 0], [0, 0], [0, 1], 0, 0),
        ("drone", [0, 0], [1, 1], [0, 0], 1, 1),
        ("drone", [1, 1], [1, 0], [0, 0], 1, 0),
    ],
)
def test_a_time_out_is_a_cut_without_a_termination(ends, terminated, cut, active, done, time_out, env_of):
    """Of any drone of a team, or of the last of drones that end one by one; those that left have no metrics."""
    terminated, cut, active = (np.array(x, bool) for x in (terminated, cut, active))
    info = {"terminated": terminated, "truncations": {"cut": cut}, "rewards": {}, "active": active}
    info["metrics"] = {"error": jnp.array([2.0, 2.0]) / active}
    outcome = np.zeros((2, 1)), SimpleNamespace(active=active), jnp.zeros(2), terminated.any(), None, info
    env, keys = brax.wrap(env_of("hover")), []
    task = SimpleNamespace(ends=ends)
    step = lambda key, world, action: keys.append(key.tolist()) or outcome  # noqa: E731
    env.env = SimpleNamespace(drones=2, action_size=1, task=task, step=step)
    for k in range(2):
        place = SimpleNamespace(step=k), jax.random.PRNGKey(0)
        state = env.step(brax.base.State(place, 0, 0, 0, {}, {}), jnp.zeros(2))
    assert keys[0] != keys[1]
    assert (state.done, state.info["time_out"]) == (done, time_out)
    assert state.metrics["error"] == (2 if active.any() else 0)


def test_the_drones_of_a_team_follow_each_other_in_the_channels_of_an_image():
    images = jnp.arange(6).reshape(2, 1, 1, 3)
    np.testing.assert_array_equal(brax._channels(images), [[range(6)]])


class Counting:
    """An environment whose reward is the number of steps, and which terminates where that times the action is 3."""

    def reset(self, rng):
        zero = jnp.zeros((), jnp.float32)
        return brax.base.State((zero, rng), zero, zero, zero, {}, {"time_out": zero})

    def step(self, state, action):
        count = state.pipeline_state[0] + 1
        done = (action * count >= 3).astype(jnp.float32)
        info = state.info | {"time_out": jnp.zeros((), jnp.float32)}
        place = count, state.pipeline_state[1]
        return state.replace(pipeline_state=place, obs=count, reward=count, done=done, info=info)


def test_steps_and_sums_begin_anew_with_every_episode():
    wrapped = brax._Training(Counting(), 4)
    state, seen = wrapped.reset(jax.random.split(jax.random.PRNGKey(0), 3)), []
    first = state.pipeline_state[1]
    for _ in range(8):
        state = wrapped.step(state, jnp.array([0.0, 1.0, 0.75]))
        info = state.info | state.info["episode_metrics"]
        seen.append([info["steps"], state.done, info["truncation"], info["sum_reward"], info["length"], state.obs])
    steps, done, truncation, sums, length, obs = np.array(seen).transpose(1, 2, 0)
    np.testing.assert_array_equal(steps, [[1, 2, 3, 4] * 2, [1, 2, 3, 1, 2, 3, 1, 2], [1, 2, 3, 4] * 2])
    np.testing.assert_array_equal(length, steps)
    np.testing.assert_array_equal(done, steps == [[4], [3], [4]])
    np.testing.assert_array_equal(truncation, done * [[1], [0], [0]])  # the last one terminates at its limit
    np.testing.assert_array_equal(sums, steps * (steps + 1) / 2)
    np.testing.assert_array_equal(obs, np.where(done, 0, steps))
    assert (state.pipeline_state[1] != first).any(axis=1).all()  # the keys of the next episodes


@pytest.mark.slow
def test_every_episode_starts_anew(env_of):
    env = brax.wrap(env_of("hover"))
    done, truncation, _, _, obs = flown(env, brax.wrap_for_training(env, episode_length=4), [0.0, 0.0], 12)
    np.testing.assert_array_equal(done, np.tile([[0], [0], [0], [1]], (3, 2)))
    np.testing.assert_array_equal(done, truncation)
    starts = np.concatenate(obs[3::4])  # what is seen after the last step is the next episode
    assert len(np.unique(starts, axis=0)) == len(starts)


@pytest.mark.slow
def test_episode_metrics_are_sums_over_the_episode(env_of):
    env = brax.wrap(env_of("hover"))
    wrapped = brax.wrap_for_training(env, episode_length=4)
    state = jit_unoptimized(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), 2))
    step, rewards = jit_unoptimized(wrapped.step), []
    for _ in range(6):
        state = step(state, jnp.zeros((2, 4)))
        rewards.append(state.reward)
    metrics = state.info["episode_metrics"]
    np.testing.assert_allclose(metrics["sum_reward"], rewards[4] + rewards[5], rtol=1e-5)
    np.testing.assert_array_equal(metrics["length"], 2)
    diverged = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), metrics)
    ended = state.replace(done=jnp.ones(2, jnp.float32), info=state.info | {"episode_metrics": diverged})
    after = step(ended, jnp.zeros((2, 4)))  # the NaN of one episode is not in the next one
    np.testing.assert_allclose(after.info["episode_metrics"]["sum_reward"], after.reward, rtol=1e-5)


@pytest.mark.slow
def test_braxs_own_wrappers_and_statistics_run(env_of):
    """Each episode of a world begins at its first start again, as brax's wrapper has it."""
    from brax.training.acme import running_statistics, specs

    env = brax.wrap(env_of("hover"))
    wrapped = training.EvalWrapper(training.wrap(env, episode_length=4))
    start = state = jit_unoptimized(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), 2))
    statistics = running_statistics.init_state(specs.Array((env.observation_size,), jnp.dtype("float32")))
    step = jit_unoptimized(wrapped.step)
    for k in range(4):
        state = step(state, jnp.full((2, 4), 0.1))
        with jax.numpy_rank_promotion("allow"):  # which brax relies on
            statistics = running_statistics.update(statistics, state.obs)
            normalized = running_statistics.normalize(state.obs, statistics)
        assert state.done.tolist() == state.info["truncation"].tolist() == [float(k == 3)] * 2
    np.testing.assert_array_equal(state.obs, start.obs)
    assert np.isfinite(normalized).all() and statistics.count.lo == 8
    metrics = state.info["eval_metrics"]
    np.testing.assert_array_equal(metrics.episode_steps, 4)


def test_a_team_acts_and_sees_as_one(env_of):
    plain = env_of("leader-follower")
    env = brax.wrap(plain)
    assert (env.observation_size, env.action_size) == (2 * plain.observation_size, 2 * plain.action_size)


def test_the_name_of_a_task_is_an_environment():
    assert brax.wrap("hover").env.task.name == "hover"
    with pytest.raises(ValueError, match="unknown task 'hoover'"):
        brax.wrap("hoover")


def test_arguments_that_the_environment_takes_instead_are_refused(env_of):
    env = brax.wrap(env_of("hover"))
    with pytest.raises(ValueError, match="action_repeat is 2"):
        brax.wrap_for_training(env, episode_length=5, action_repeat=2)
    with pytest.raises(ValueError, match="make the environment with randomize"):
        brax.wrap_for_training(env, episode_length=5, randomization_fn=lambda sys: sys)


def test_what_the_trainers_miss_is_there_for_a_while():
    assert not hasattr(jax, "device_put_replicated")
    with pytest.raises(KeyError), brax.trainers():
        copies = jax.device_put_replicated({"a": jnp.arange(3.0)}, jax.local_devices()[:1])
        np.testing.assert_array_equal(copies["a"], [[0, 1, 2]])
        raise KeyError
    assert not hasattr(jax, "device_put_replicated")


@pytest.mark.slow
def test_importing_it_prints_nothing_to_stdout():
    done = subprocess.run(
        [sys.executable, "-c", "import jaxdrones.adapters.brax"], capture_output=True, text=True, check=True
    )
    assert done.stdout == ""


@pytest.mark.slow
def test_braxs_ppo_learns_to_hover():
    from brax.training.agents.ppo import networks
    from brax.training.agents.ppo import train as ppo

    env = make("hover", action="thrust_and_rates", reach=0.5, speed=0.3, omega=0.3, tilt=15.0)
    returns = []
    with brax.trainers(), jax.numpy_rank_promotion("allow"):  # which brax relies on
        ppo.train(
            brax.wrap(env),
            num_timesteps=4_000_000,
            episode_length=env.steps,
            wrap_env_fn=brax.wrap_for_training,
            use_pmap_on_reset=True,
            num_envs=256,
            unroll_length=20,
            batch_size=256,
            num_minibatches=8,
            num_updates_per_batch=4,
            learning_rate=1e-3,
            entropy_cost=1e-3,
            discounting=0.98,
            reward_scaling=0.1,
            normalize_observations=True,
            num_evals=2,
            num_eval_envs=32,
            network_factory=functools.partial(
                networks.make_ppo_networks, policy_hidden_layer_sizes=(64, 64), value_hidden_layer_sizes=(64, 64)
            ),
            progress_fn=lambda steps, metrics: returns.append(float(metrics["eval/episode_reward"])),
        )
    before, after = returns
    assert after > before + 300, returns  # of at most 1,000
