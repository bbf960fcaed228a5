"""Episodes are counted as the task says, nothing after their end counts, and the interval is the known one."""

import dataclasses
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones import envs
from jaxdrones.cli.report import success as described_success
from jaxdrones.control import Setpoint
from jaxdrones.engine.physics import Physics
from jaxdrones.engine.step import Step
from jaxdrones.envs.actions import ACTIONS
from jaxdrones.envs.env import Env
from jaxdrones.envs.observations import OBSERVATIONS
from jaxdrones.learning import evaluate, evaluation
from jaxdrones.learning.evaluation import wilson_interval
from jaxdrones.pytree import PyTreeNode
from jaxdrones.tasks.shaping import alive
from jaxdrones.tasks.starts import hovering
from jaxdrones.tasks.task import Task
from jaxdrones.training.run import report_as_dict


def test_wilson_interval_against_known_numbers():
    # statsmodels.stats.proportion.proportion_confint(count, nobs, method="wilson")
    np.testing.assert_allclose(wilson_interval(10, 100), (0.0552292, 0.1743657), atol=1e-6)
    np.testing.assert_allclose(wilson_interval(10_000, 10_000), (0.9996160, 1.0), atol=1e-6)
    np.testing.assert_allclose(wilson_interval(0, 50), (0.0, 0.0713476), atol=1e-6)


def test_drones_of_an_episode_are_as_many_trials_as_the_variance_of_its_successes_says():
    together, opposed = np.array([[1, 1], [0, 0]] * 5), np.array([[1, 0]] * 8 + [[1, 1], [0, 0]])
    assert evaluation._interval(together, 10) == wilson_interval(5, 10)
    assert evaluation._interval(opposed, 10) == wilson_interval(10, 20)


def test_a_zero_has_no_sign_in_a_start():
    both = [evaluation._fingerprint(jnp.array(x)) for x in (0.0, -0.0)]
    np.testing.assert_array_equal(*both)


def test_devices_share_only_as_many_episodes_as_they_can_share_equally(monkeypatch):
    counts = []

    def make_mesh(episodes, devices):
        counts.append(len(devices))
        raise InterruptedError

    monkeypatch.setattr(evaluation.sharding, "make_mesh", make_mesh)
    for episodes in (4, 5):
        with pytest.raises(InterruptedError):
            evaluation.compile_evaluation(LIFT, None, episodes, 2 * jax.devices())
    assert counts == [2, 1]


class Lift(Step):
    """Every drone is lifted by 10 cm in a step, times the excess of its rotor speed as a share of the hover speed."""

    def __init__(self):
        self.physics = Physics()

    def rate(self, params, state, rpm, scene=None):
        raise NotImplementedError("nothing asks for it")

    def __call__(self, params, state, rpm, scene=None):
        climb = rpm[:, 0] / params.hover_rpm - 1
        return state.replace(pos=state.pos.at[:, 2].add(0.1 * climb))


class UntilTheEnd(PyTreeNode):
    """One action as long as the first drone is between 0.55 and 1.1 m, and another one from then on."""

    before: jax.Array  # of every drone
    after: jax.Array

    def __call__(self, obs):
        over = (obs[:1, 2] < 0.55) | (obs[:1, 2] > 1.1)
        return jnp.where(over, self.after, self.before)[:, None] * jnp.ones((1, 4))


def lift(starts=(0.0,), drones=1, noise=None, **changes):
    """An environment of 12 steps from 1 m plus one of the offsets, which fails below 0.55 m and is done above 1.1 m.

    Above 1.05 m it is cut after 9 steps.
    """

    def start(key, params):
        chosen, unused = jax.random.split(key)
        offset = jax.random.choice(chosen, jnp.array(starts))
        pos = jnp.array([[3.0 * i, 0, 1] for i in range(drones)]).at[:, 2].add(offset)
        return hovering(params, pos), {"unused": jax.random.uniform(unused)}

    task = Task(
        name="lift",
        summary="lifted by its rotors",
        drones=drones,
        duration=1.2,
        start=start,
        target=lambda variables, t: Setpoint.at(jnp.array([[3.0 * i, 0, 1] for i in range(drones)])),
        rewards={"alive": (1.0, alive)},
        terminations={
            "fell": lambda task, world: world.drones.pos[:, 2] < 0.55,
            "done": lambda task, world: world.drones.pos[:, 2] > 1.1,
        },
        truncations={"late": lambda task, world: (world.step == 9) & (world.drones.pos[:, 2] > 1.05)},
        success=lambda metrics, dt: metrics["error"][-1] < 2,
        success_terminations=("done",),
    )
    nominal = envs.make("hover", drones=drones).params
    terms = dict(terms=(OBSERVATIONS["position"],), action=ACTIONS["rpm"]())
    return Env(dataclasses.replace(task, **changes), nominal, Lift(), dt=0.1, noise=noise, **terms)


KEY = jax.random.key(0)
LIFT = lift()


def flown(before, after=0.0, env=LIFT, episodes=3):
    actions = (jnp.broadcast_to(jnp.asarray(x, float), (env.drones,)) for x in (before, after))
    return evaluate(env, UntilTheEnd(*actions), KEY, episodes)


@pytest.mark.parametrize(
    ("before", "succeeds", "ended", "steps"),
    [(-1, 0, "fell", 5), (-0.3, 1, None, 12), (1, 1, "done", 3), (0.15, 0, "late", 9)],
)
def test_an_episode_is_what_it_was_at_its_end_whatever_comes_after(before, succeeds, ended, steps):
    """A failure is none of the successes, though the criterion holds; nor does a later failure undo a success."""
    reports = [flown(before, after) for after in (-1, 0, 1, jnp.nan)] if ended else [flown(before)]
    assert all(report == reports[0] for report in reports)
    report = reports[0]
    assert report.success == succeeds and report.mean_return == steps
    assert report.end_rates == {name: ended == name for name in ("fell", "done", "late")}
    assert report.distinct_episodes == 1 and report.success_interval is None  # all flew alike
    np.testing.assert_allclose(report.mean_length, 0.1 * steps, rtol=1e-6)
    climb = 0.1 * before * (1 if before < 0 else float(LIFT.params.max_rpm[0] / LIFT.params.hover_rpm[0]) - 1)
    errors = np.abs(climb) * np.arange(1, steps + 1)
    np.testing.assert_allclose(report.final_error, errors[-1], atol=1e-6)
    np.testing.assert_allclose(report.rms_error, np.sqrt(np.mean(errors[steps // 5 :] ** 2)), atol=1e-6)


@pytest.mark.parametrize(("ends", "successes", "trials"), [("team", 0, 3), ("drone", 3, 6)])
def test_successes_are_counted_in_episodes_or_in_drones_that_end_alone(ends, successes, trials):
    """One of two drones falls in each of three episodes."""
    env = lift(drones=2, ends=ends)
    report = report_as_dict(flown(jnp.array([-1.0, 0.0]), env=env))
    assert (report["episodes"], report["successes"], report["trials"]) == (3, successes, trials)
    assert f", {successes} of {trials}{' drones' * (ends == 'drone')}, " in described_success(report)
    steps = 5 if ends == "team" else (5 + 12) / 2  # to the end of the team, or mean of those to the ends of the drones
    np.testing.assert_allclose([report["mean_length"], report["mean_return"]], [0.1 * steps, steps], rtol=1e-6)
    np.testing.assert_allclose(report["final_error"], 0.5 / 2, atol=1e-6)
    assert report["end_rates"] == {"fell": 1 if ends == "team" else 0.5, "done": 0, "late": 0}


def test_errors_of_a_report_are_those_of_all_drones():
    """One of two drones stays at its target, and the other one climbs by as much in each of 12 steps."""
    near = dict(success=lambda metrics, dt: metrics["error"][-1] < 1e-3, success_terminations=())
    near |= dict(terminations={}, truncations={})
    report = flown(jnp.array([0.0, 0.2]), env=lift(drones=2, **near))
    assert report.success == 0  # as that of a team is that of all of it
    error = 2 * report.final_error
    assert error > 0.01
    np.testing.assert_allclose(list(report.final_error_percentiles.values()), [error / 2, error, error], rtol=1e-6)
    later = error * np.arange(3, 13) / 12  # in the last four fifths
    np.testing.assert_allclose(report.rms_error, np.sqrt(np.mean(later**2) / 2), rtol=1e-6)


class YawTorque(PyTreeNode):
    """A yaw torque for some steps, then none."""

    steps: jax.Array

    def initial_hidden_state(self, batch):
        return jnp.zeros(())

    def act(self, memory, obs):
        return memory + 1, jnp.where(memory < self.steps, 1.0, 0.0) * jnp.array([[0.0, 0, 0, 1]])


@pytest.mark.slow
def test_a_drone_that_spins_at_its_goal_fails_whether_it_is_turned_on_or_coasts_after_the_end():
    torques = ACTIONS["thrust_and_torques"](torque_share=0.6)
    env = envs.make("hover", reach=0, speed=0, omega=0, tilt=0, action=torques)
    report = evaluate(env, YawTorque(jnp.array(jnp.inf)), KEY, 3)
    assert report.success == 0 and report.end_rates == {"lost": 0, "spinning": 1} and report.final_error < 0.01
    assert report == evaluate(env, YawTorque(jnp.array(report.mean_length / env.dt)), KEY, 3)


def test_a_failure_counts_where_the_goal_is_reached_in_the_same_step_and_any_other_end_is_one():
    metrics = {"error": jnp.zeros((10, 1))}
    ends = {"fell": (0, 1, 0, 1, 0), "done": (0, 0, 1, 1, 0), "cut": (0, 0, 0, 0, 1)}
    found = [
        LIFT.task.succeeded(metrics, {name: jnp.array(bool(x[k])) for name, x in ends.items()}, 0.1) for k in range(5)
    ]
    assert [bool(x) for x in found] == [True, False, True, False, False]
    assert not LIFT.task.succeeded({"error": jnp.full((10, 1), 3.0)}, {}, 0.1)
    with pytest.raises(ValueError, match="unknown success termination 'cut'"):
        dataclasses.replace(LIFT.task, success_terminations=("cut",))


def test_an_episode_with_a_position_that_is_not_finite_is_no_success():
    env = lift(drones=2, success=lambda metrics, dt: jnp.ones(2, bool))  # nor one with such a position of one drone
    assert [flown(jnp.array([0.1, x]), env=env).success for x in (0.1, jnp.nan)] == [1, 0]


@pytest.mark.slow
def test_an_episode_of_a_team_succeeds_when_all_of_it_does():
    team = lift(drones=2)
    assert flown([0, 0], env=team).success == 1 and flown([0, -1], env=team).success == 0


@pytest.mark.parametrize(
    ("changes", "distinct"),
    [
        pytest.param({}, lambda n: 1, marks=pytest.mark.slow),  # what is drawn has no effect
        (dict(starts=(0.0, 0.01, 0.02, 0.03)), lambda n: 4),
        pytest.param(
            dict(noise=lambda key, state: state.replace(pos=state.pos + jax.random.uniform(key, (1, 3)))),
            lambda n: n,
            marks=pytest.mark.slow,
        ),
    ],
    ids=["one start", "four starts", "noise"],
)
def test_the_interval_is_that_of_the_distinct_episodes(changes, distinct):
    report = evaluate(lift(**changes), lambda obs: 0.1 * jnp.tanh(obs[:, :1]) * jnp.ones((1, 4)), KEY, 50)
    n = distinct(50)
    assert report.episodes == 50 and report.distinct_episodes == n and report.success == 1
    assert report.success_interval == (None if n == 1 else wilson_interval(n, n))


def test_every_step_of_an_episode_has_noise_of_its_own():
    """The drone falls by 3 cm in the steps before which it sees itself on one side: about half of 12."""
    env = lift(noise=lambda key, state: state.replace(pos=state.pos + jax.random.normal(key, (1, 3))))
    report = evaluate(env, lambda obs: jnp.where(obs[:, :1] > 0, 0.0, -0.3) * jnp.ones((1, 4)), KEY, 5)
    assert 0.03 * 2 < report.final_error_percentiles[50] < 0.03 * 10 and report.distinct_episodes == 5


def test_the_start_and_the_steps_of_an_episode_draw_from_keys_of_their_own():
    """A key that is split and folded makes the same keys twice."""
    seen, task = [], LIFT.task

    def note(key):
        jax.debug.callback(lambda data: seen.append(tuple(data.tolist())), jax.random.key_data(key))

    def noise(key, state):
        note(key)
        return state

    def start(key, params):
        for own in jax.random.split(key):
            note(own)
        return task.start(key, params)

    env = lift(noise=noise, start=start)
    jax.eval_shape(env.reset, KEY)
    jax.effects_barrier()
    seen.clear()  # keys of the starts with which the environment was checked
    evaluate(env, lambda obs: 0 * obs[:, :1] * jnp.ones((1, 4)), KEY, 2)
    jax.effects_barrier()
    assert len(seen) == len(set(seen)) == 2 * (2 + 1 + 12)  # starts, first observations, and steps


def test_a_task_without_a_criterion_has_no_success():
    report = flown(0, env=lift(success=None))
    assert report.success is None and report.success_interval is None and report.success_lower_bound == 0
    assert report.replace(success=0.5).success_lower_bound == 0.5  # of a single flight


def test_episodes_must_be_a_whole_number():
    with pytest.raises(ValueError, match="episodes is 0"):
        flown(0, episodes=0)


TWO_DEVICES = """
import jax, jaxdrones as jd
from jaxdrones.learning import bptt
from jaxdrones.learning.evaluation import compile_evaluation
jax.config.update("jax_num_cpu_devices", 2)
env = jd.make("hover", duration=0.3)
policy = bptt.init(jax.random.key(0), env, bptt.Config(worlds=1, hidden_sizes=(4,))).policy
for episodes in (6, 3):
    reports = [compile_evaluation(env, policy, episodes, jax.devices()[:n])(policy, jax.random.key(1)) for n in (1, 2)]
    one, two = map(vars, reports)
    assert one["distinct_episodes"] == episodes
    for name in one:
        assert jax.tree.all(jax.tree.map(lambda a, b: abs(a - b) <= 1e-5 * (1 + abs(a)), one[name], two[name])), name
"""


@pytest.mark.slow
def test_devices_that_share_the_episodes_report_what_one_reports():
    done = subprocess.run([sys.executable, "-c", TWO_DEVICES], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
