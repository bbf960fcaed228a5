"""Recorded episodes of gym-pybullet-drones: our environment, fed the recorded states, observes and rewards the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from golden_data import explicit_params, load, names
from helpers import mostly_slow

import jaxdrones
from jaxdrones import State, rotation
from jaxdrones.engine.physics import Physics
from jaxdrones.engine.step import Step
from jaxdrones.envs import TASKS
from jaxdrones.envs.actions import ACTIONS, rpm
from jaxdrones.envs.env import Env
from jaxdrones.envs.observations import OBSERVATIONS

TASK = {
    ("paper", "HoverAviary"): "hover-2021",
    ("paper", "TakeoffAviary"): "takeoff",
    ("paper", "FlyThruGateAviary"): "fly-through-gate",
    ("paper", "TuneAviary"): "tune",
    ("paper", "LeaderFollowerAviary"): "leader-follower",
    ("paper", "FlockAviary"): "flock",
    ("paper", "MeetupAviary"): "meetup",
    ("main", "HoverAviary"): "hover-2x",
    ("main", "MultiHoverAviary"): "multi-hover",
}
ACTION = {
    "one_d_rpm": ACTIONS["one_d_rpm"](),
    "rpm": rpm(near_hover=0.05),
    "dyn": ACTIONS["thrust_and_torques"](),
    "one_d_dyn": ACTIONS["one_d_thrust"](),
    "vel": ACTIONS["velocity"](),
    "pid": ACTIONS["position"](),
    "one_d_pid": ACTIONS["one_d_position"](),
    "tun": ACTIONS["pid_gains"](),
}


class Replay(Step):
    """A step that hands out recorded states one after the other and keeps what was commanded."""

    def __init__(self, states: np.ndarray):
        self.states, self.k, self.commands, self.physics = states, 0, [], Physics()

    def rate(self, params, state, rpm, scene=None):
        raise NotImplementedError("nothing asks for it")

    def __call__(self, params, state, rpm, scene=None):
        self.k += 1
        self.commands.append(np.asarray(rpm))
        return to_state(self.states[self.k])


def to_state(row: np.ndarray) -> State:
    """From a recorded row (n, 20), whose angular velocity is in the world frame."""
    row = jnp.asarray(row)
    quat = row[:, 3:7]
    omega = jax.vmap(rotation.rotate_inverse)(quat, row[:, 13:16])
    return State(pos=row[:, :3], quat=quat, vel=row[:, 10:13], omega=omega, rpm=row[:, 16:])


def replayed(name: str):
    """The environment's answers to a recorded episode, and the commands it gave."""
    case = load(name)
    about, arrays = case.about, case.arrays
    main = about["variant"] == "main"
    task = TASKS[TASK[about["variant"], about["task"]]](drones=about["num_drones"])
    action = ACTIONS["destination"]() if main and about["action_type"] == "pid" else ACTION[about["action_type"]]
    params = jaxdrones.repeat(explicit_params(case._replace(about=about | {"vehicle": "cf2x"})), task.drones)
    step = Replay(arrays["state"])
    terms = [OBSERVATIONS[name] for name in task.observation]
    dt = about["physics_steps_per_record"] / about["physics_freq_hz"]
    env = Env(task, params, step, dt=dt, action=action.fitted(params), terms=tuple(terms))
    obs, world = env.reset(jax.random.key(0))
    answers = [(obs,)]
    for row in arrays["action"]:
        obs, world, reward, terminated, truncated, _ = env.step(jax.random.key(0), world, row)
        answers.append((obs, reward, terminated, truncated))
    return case, answers, np.array(step.commands)


EPISODES = mostly_slow(
    names(kind="rl_episode"),
    quick=[
        "rl_main_HoverAviary_pid_121",
        "rl_paper_FlyThruGateAviary_vel_11",  # a moving target, whose reward lags behind
    ],
)


def rows_kept(case) -> np.ndarray:
    """Indices of the recorded observations: those that the case names, or else the first ones."""
    first = np.arange(len(case.arrays["obs"]))
    kept = np.asarray(case.arrays.get("keep", case.about.get("keep", first)))
    return kept if len(np.shape(kept)) and len(kept) == len(first) else first


@pytest.fixture(scope="module", params=EPISODES)
def episode(request):
    with jax.enable_x64():
        return replayed(request.param)


@pytest.mark.slow
def test_the_start_is_the_recorded_one(episode):
    case, answers, _ = episode
    width = min(case.arrays["obs"].shape[-1], answers[0][0].shape[-1])
    np.testing.assert_allclose(answers[0][0][:, :width], case.arrays["obs"][0][:, :width], atol=1e-7)


def test_observations_are_the_recorded_ones(episode):
    case, answers, _ = episode
    recorded = case.arrays["obs"]
    width = min(recorded.shape[-1], answers[0][0].shape[-1])
    ours = np.array([answer[0] for answer in answers])[rows_kept(case), :, :width]
    rounding = 1e-6 if case.about["variant"] == "main" else 1e-12  # main rounds to float32
    np.testing.assert_allclose(ours, recorded[..., :width], rtol=rounding, atol=rounding / 10)


def test_rewards_are_the_recorded_ones(episode):
    case, answers, _ = episode
    recorded = case.arrays["reward"]
    ours = np.array([answer[1] for answer in answers[1:]])
    if recorded.ndim == 1:
        ours = ours.sum(axis=-1)
    np.testing.assert_allclose(ours, recorded, rtol=1e-9, atol=1e-12)


def test_terminations_and_truncations_are_the_recorded_ones(episode):
    case, answers, _ = episode
    terminated, truncated = (np.array([answer[i] for answer in answers[1:]]) for i in (2, 3))
    if "done" in case.arrays:
        np.testing.assert_array_equal(terminated | truncated, case.arrays["done"])
    else:
        np.testing.assert_array_equal(terminated, case.arrays["terminated"])
        np.testing.assert_array_equal(truncated, case.arrays["truncated"])


def test_actions_command_the_recorded_rotor_speeds(episode):
    case, _, commands = episode
    np.testing.assert_allclose(commands, case.arrays["state"][1:, :, 16:], rtol=0, atol=1e-6)
