"""A drone's episode may end before that of its team: it leaves the world, and what remains is that of the others."""

import dataclasses
import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

import jaxdrones as jd
from jaxdrones import envs
from jaxdrones.control import Setpoint
from jaxdrones.envs import episode
from jaxdrones.learning import bptt, collect, ppo, shac
from jaxdrones.learning.batch import batch_of
from jaxdrones.learning.evaluation import evaluate, wilson_interval
from jaxdrones.learning.returns import discounted_rewards
from jaxdrones.pytree import PyTreeNode
from jaxdrones.tasks.shaping import alive
from jaxdrones.tasks.starts import hovering
from jaxdrones.tasks.task import Task
from jaxdrones.training.episode import fly_episode

KEY = jax.random.key(0)
STEPS = 12
ABOVE = 0.4  # m


def column(drones=2, ends="drone", **changes):
    """Drones in a column whose episodes end below 0.8 times their initial height, or above 1.5 times it."""

    def start(key, params):
        height = 1.0 + ABOVE * jnp.arange(drones, dtype=float)
        return hovering(params, jnp.stack([0 * height, 0 * height, height], axis=-1)), {"height": height}

    def out(low, high):
        return lambda task, world: (
            (world.drones.pos[:, 2] < low * world.variables["height"])
            | (world.drones.pos[:, 2] > high * world.variables["height"])
        )

    task = Task(
        name="column",
        summary="a column of drones",
        drones=drones,
        duration=STEPS * 0.05,
        control_hz=20.0,
        start=start,
        target=lambda variables, t: Setpoint.at(jnp.zeros((drones, 3)).at[:, 2].set(variables["height"])),
        rewards={"alive": (1.0, alive)},
        terminations={"fell": out(0.8, jnp.inf)},
        truncations={"rose": out(-jnp.inf, 1.5)},
        success=lambda metrics, dt: metrics["error"][-1] < 0.1,
        observation=("position_error", "velocity"),
        ends=ends,
    )
    return envs.make(dataclasses.replace(task, **changes))


class Fixed(PyTreeNode):
    """The same action (n,) of all rotors in every step."""

    action: jax.Array

    def __call__(self, obs):
        return jnp.broadcast_to(self.action[:, None], (*self.action.shape, 4))


@functools.lru_cache(maxsize=1)
def _programs(env):
    return jit_unoptimized(env.reset), jit_unoptimized(env.step)


def flown(env, action, steps=STEPS):
    """Worlds and answers of an episode, the drones' actions being constant."""
    reset, step = _programs(env)
    _, world = reset(KEY)
    answers = []
    for _ in range(steps):
        _, world, *answer = step(KEY, world, Fixed(jnp.asarray(action, float))(None))
        answers.append((world, *answer))
    return answers


def test_the_others_fly_on_and_the_team_ends_with_the_last():
    env = column()
    answers = flown(env, [-1.0, 0.0])
    worlds, rewards, terminated, truncated, infos = zip(*answers, strict=True)
    ended = np.array([info["terminated"] for info in infos])
    last = int(np.argmax(ended[:, 0]))
    assert 0 < last < STEPS - 1 and ended.sum() == 1
    np.testing.assert_array_equal([info["active"] for info in infos], [[k <= last, True] for k in range(STEPS)])
    np.testing.assert_array_equal(rewards, [[k <= last, True] for k in range(STEPS)])
    np.testing.assert_array_equal([world.active for world in worlds], [[k < last, True] for k in range(STEPS)])
    assert not any(terminated) and [bool(x) for x in truncated] == [False] * (STEPS - 1) + [True]
    assert not infos[-1]["truncated"][0] and infos[-1]["truncated"][1]
    both = flown(env, [-1.0, -1.0])
    ends = [bool(answer[2]) for answer in both]
    assert not any(answer[3] for answer in both[:-1])
    assert ends.index(True) == max(int(np.argmax([x[4]["terminated"][i] for x in both])) for i in range(2))


def test_rewards_and_metrics_of_a_step_are_those_of_the_same_drones():
    """A drone whose episode ends in a step is among them; a metric of its last step may not miss it."""

    def present(task, world):
        """1 for drones in the world."""
        return world.active.astype(float)

    *_, infos = zip(
        *flown(column(rewards={"present": (1.0, present)}, metrics={"present": present}), [-1.0, 0.0]), strict=True
    )
    assert sum(info["terminated"][0] for info in infos) == 1
    for info in infos:
        np.testing.assert_array_equal(info["metrics"]["present"], info["active"])
        np.testing.assert_array_equal(info["rewards"]["present"], info["active"])


def test_a_team_whose_last_drone_is_cut_is_cut_and_not_terminated():
    """A learner goes on from the value there; so it does where the others had ended before."""
    env = column()
    for actions, cut in ([1.0, 1.0], True), ([-1.0, 1.0], True), ([-1.0, -1.0], False):
        answers = flown(env, actions)
        last = next(k for k, answer in enumerate(answers) if answer[2] or answer[3])
        assert last < STEPS - 1 and not np.any(answers[last][0].active)
        assert [bool(x) for x in answers[last][2:4]] == [not cut, cut]


def test_by_default_the_end_of_a_drone_is_that_of_its_team():
    *_, terminated, _, info = zip(*flown(column(ends="team"), [-1.0, 0.0]), strict=True)
    first = int(np.argmax(terminated))
    np.testing.assert_array_equal(info[first]["terminations"]["fell"], [True, False])
    np.testing.assert_array_equal(info[first]["terminated"], [True, True])


@pytest.mark.parametrize("ends", ["team", "drone"])
def test_who_flies_on_after_the_time_limit_can_still_fail(ends):
    """As brax does, whose episodes have a length of their own."""
    env = column(ends=ends, terminations={"late": lambda task, world: (world.step > STEPS + 1) & jnp.ones(2, bool)})
    answers = flown(env, [0.0, 0.0], STEPS + 2)
    assert [bool(x[2]) for x in answers] == [False] * (STEPS + 1) + [ends == "team"]
    assert all(np.all(x[4]["terminated"]) == (k == STEPS + 1) for k, x in enumerate(answers))
    assert [bool(x[3]) for x in answers] == [False] * (STEPS - 1) + [True] * 3


def test_drones_that_left_are_far_from_the_others_and_from_each_other():
    env = SimpleNamespace(physics=SimpleNamespace(init=lambda params, state: state))
    active, drones = jnp.array([False, True, False]), jd.State.at_rest(jnp.ones((3, 3)))
    pos = episode._without_ended(env, SimpleNamespace(active=active, drones=drones, params=None)).pos
    apart = np.linalg.norm(pos[:, None] - pos[None], axis=-1)
    assert pos[1].tolist() == [1, 1, 1] and apart[0, 2] >= 100 and np.all(apart[1, ::2] > 1e4)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["explicit", pytest.param("bullet", marks=pytest.mark.slow)])
def test_a_drone_that_left_acts_on_no_other(backend):
    """The upper drone ends in the first step; from the next one on the lower one flies as if it were alone."""
    over = {"over": lambda task, world: (world.step >= 1) & (jnp.arange(2) == 1)}
    task = column(terminations=over, contact=("drones",), control_hz=50.0).task
    options = dict(backend=backend, pairs=("downwash",))
    with (
        envs.make(task, **options) as pair,
        envs.make(column(1, terminations={}, control_hz=50.0).task, **options) as single,
    ):
        compiled = jit_unoptimized if backend == "explicit" else lambda function: function
        step, step_alone = compiled(pair.step), compiled(single.step)
        _, world = compiled(pair.reset)(KEY)
        _, alone = compiled(single.reset)(KEY)
        _, world, *_ = step(KEY, world, jnp.zeros((2, 4)))
        _, alone, *_ = step_alone(KEY, alone, jnp.zeros((1, 4)))
        assert world.drones.vel[0, 2] < alone.drones.vel[0, 2] - 1e-3  # in the wake
        alone = alone.replace(drones=jax.tree.map(lambda x: x[:1], world.drones))
        for _ in range(3):
            _, world, *_ = step(KEY, world, jnp.zeros((2, 4)))
            _, alone, *_ = step_alone(KEY, alone, jnp.zeros((1, 4)))
            np.testing.assert_allclose(world.drones.pos[0], alone.drones.pos[0], atol=1e-6)
            np.testing.assert_allclose(world.drones.vel[0], alone.drones.vel[0], atol=1e-5)


def test_a_drone_that_left_takes_its_load_with_it():
    """A load left behind pulled it back at 50 km/s, which rewards for the approach of others counted."""
    task = dataclasses.replace(column().task, effects=(jd.cable,), models=(jd.payload(),))
    env = envs.make(task, vehicle=jd.with_payload(jd.load_params("cf2x"), 0.005), substeps=10)
    _, world = env.reset(KEY)
    world = world.replace(active=jnp.array([True, False]))
    after = jit_unoptimized(env.step)(KEY, world, jnp.zeros((2, 4)))[1].drones
    hangs = after.aux["payload"].pos - after.pos
    np.testing.assert_allclose(hangs, jnp.broadcast_to(jnp.array([0, 0, -0.5]), (2, 3)), atol=0.01)
    assert jnp.max(jnp.abs(after.vel)) < 1.0  # after a control period of 0.05 s, in which the second drone falls


def test_a_state_that_is_not_finite_stays_with_its_drone():
    env = column(terminations={"over": lambda task, world: ~jnp.isfinite(world.drones.pos[:, 2])})
    step = jit_unoptimized(env.step)
    _, world = jit_unoptimized(env.reset)(KEY)
    broken = world.replace(drones=world.drones.replace(vel=world.drones.vel.at[0].set(jnp.nan)))
    _, world, *_, info = step(KEY, broken, jnp.zeros((2, 4)))
    assert list(np.asarray(info["terminated"])) == [True, False]
    _, world, reward, *_ = step(KEY, world, jnp.zeros((2, 4)))
    assert np.all(np.isfinite(world.drones.pos)) and list(np.asarray(reward)) == [0, 1]


def collected(env, horizon=STEPS, starts=False):
    count = 2
    drawn = collect.draw_starts(KEY, env, count)
    worlds = collect.restart(KEY, collect.empty_worlds(env, count), drawn)

    def act(noise, memory, obs):
        return memory, jnp.broadcast_to(jnp.array([-1.0, 0.0])[None, :, None], (count, 2, 4)), None

    def trajectory(worlds):
        return collect.collect(KEY, env, act, worlds, horizon, starts=drawn if starts else None)[1]

    return jit_unoptimized(trajectory)(worlds)


@pytest.mark.slow
@pytest.mark.float32
def test_rewards_and_statistics_of_learners_are_those_of_the_drones_that_fly():
    trajectory = collected(column())
    flown = ~np.asarray(trajectory.was_done)
    assert flown[:, :, 1].all() and 0 < flown[:, 0, 0].sum() < STEPS
    np.testing.assert_array_equal(discounted_rewards(trajectory, 1.0), flown)
    np.testing.assert_array_equal(trajectory.done.sum(axis=0), 1)
    assert trajectory.terminated[:, :, 0].sum() == 2 and trajectory.truncated[:, :, 1].sum() == 2


@pytest.mark.slow  # the quick one of tests/learning/test_learners.py asks the same of a whole update
@pytest.mark.float32
def test_ppo_does_not_learn_from_steps_after_the_end_of_a_drone():
    """Whatever the numbers of those steps are, the advantages and the loss are the same."""
    env = column()
    config = ppo.Config(worlds=2, horizon=STEPS + 3, minibatches=1, hidden_sizes=(4,), critic_hidden_sizes=(4,))
    state = ppo.init(KEY, env, config)
    trajectory = collected(env, STEPS + 3, starts=True)
    trajectory = trajectory.replace(extras=jnp.zeros_like(trajectory.reward))
    gone = np.asarray(trajectory.was_done)
    assert 0 < gone.sum() < gone.size / 2

    @jit_unoptimized
    def of(trajectory):
        batch = batch_of(config, state, None, trajectory, jnp.zeros((2, 2, 2, 4)), ends_alone=True)
        return batch, ppo.loss(config, state.policy, state.log_std, state.critic, batch)[0]

    other = trajectory.replace(action=jnp.where(gone[..., None], 0.7, trajectory.action))
    (batch, loss), (again, same) = of(trajectory), of(other)
    np.testing.assert_array_equal(batch.valid, ~gone)
    assert loss == same
    np.testing.assert_allclose(np.mean(np.asarray(again.advantage)[~gone]), 0, atol=1e-5)
    np.testing.assert_allclose(np.std(np.asarray(again.advantage)[~gone]), 1, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.parametrize("learner", [bptt, shac, ppo])
def test_every_learner_learns_in_a_team_whose_drones_end_alone(learner):
    small = dict(updates=2, worlds=8, horizon=STEPS, hidden_sizes=(8,))
    result = learner.train(KEY, column(), learner.Config(**small))
    assert np.all(np.isfinite(result.history["reward"])) and np.all(result.history["nonfinite_gradients"] == 0)


@pytest.mark.slow
def test_success_and_ends_are_counted_by_drone():
    report = evaluate(column(), Fixed(jnp.array([-1.0, 0.0])), KEY, 3)
    assert report.success == 0.5 and report.end_rates == {"fell": 0.5, "rose": 0}
    team = evaluate(column(ends="team"), Fixed(jnp.array([-1.0, 0.0])), KEY, 3)
    assert team.success == 0 and team.end_rates == {"fell": 1, "rose": 0}
    assert report.mean_length > team.mean_length
    ended = int(np.argmax([answer[4]["terminated"][0] for answer in flown(column(), [-1.0, 0.0])])) + 1
    np.testing.assert_allclose(report.mean_length, 0.05 * (ended + STEPS) / 2, rtol=1e-6)
    np.testing.assert_allclose(report.mean_return, (ended + STEPS) / 2, rtol=1e-6)


def test_drones_of_an_episode_are_as_many_trials_as_they_are_independent():
    from jaxdrones.learning.evaluation import _interval

    rng = np.random.default_rng(0)
    alone = rng.random((200, 8)) < 0.9
    together = np.repeat(rng.random((200, 1)) < 0.9, 8, axis=1)
    width = [np.diff(_interval(x, 200))[0] for x in (alone, together)]
    assert width[0] < 0.5 * width[1]
    p = together.mean()
    np.testing.assert_allclose(_interval(together, 200), wilson_interval(200 * p, 200))
    np.testing.assert_allclose(_interval(np.ones((200, 8), bool), 200), wilson_interval(200, 200))


@pytest.mark.slow
def test_the_log_of_an_episode_holds_the_last_state_of_a_drone_that_left():
    env = column()
    log = fly_episode(env, Fixed(jnp.array([-1.0, 0.0])), KEY)
    assert len(log.t) == STEPS and log.ended_by == ("fell",) and log.success is False
    ended = int(np.argmax(np.diff(log.drones.pos[:, 0, 2]) == 0))
    assert 0 < ended < STEPS - 1
    np.testing.assert_array_equal(
        log.drones.pos[ended:, 0], np.repeat(log.drones.pos[ended : ended + 1, 0], STEPS - ended, 0)
    )
    assert (
        np.all(log.metrics["error"][ended:, 0] == log.metrics["error"][ended, 0]) and np.abs(log.drones.pos).max() < 5
    )
    np.testing.assert_array_equal(log.reward, np.stack([np.arange(STEPS) <= ended, np.ones(STEPS)], axis=1))
