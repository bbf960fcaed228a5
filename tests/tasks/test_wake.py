"""Drones that cross below each other meet at one axis, in each other's downwash, and their altitude is measured."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

import jaxdrones as jd
from jaxdrones.envs import make
from jaxdrones.tasks import wake
from jaxdrones.tasks.wake import HEIGHT

KEY = jax.random.key(0)


@pytest.mark.parametrize("drones", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_all_cross_the_axis_at_once_at_their_altitudes(drones):
    env = make("wake", drones=drones, spacing=0.4, amplitude=0.7, period=4.0)
    _, world = jit_unoptimized(env.reset)(KEY)
    times = np.linspace(0, 4, 4001)
    target = jit_unoptimized(jax.vmap(lambda t: env.task.target(world.variables, t)))(jnp.asarray(times))
    away = np.linalg.norm(target.pos[..., :2], axis=-1)
    np.testing.assert_allclose(away, away[:, :1] * np.ones(drones), atol=1e-6)
    assert away.max() == pytest.approx(0.7, abs=1e-4) and away.min() < 1e-3
    crossings = np.sum((away[1:-1, 0] < away[:-2, 0]) & (away[1:-1, 0] <= away[2:, 0]))
    assert crossings == 2
    np.testing.assert_allclose(target.pos[:, :, 2], np.broadcast_to(HEIGHT + 0.4 * np.arange(drones), (4001, drones)))
    slope = np.gradient(np.asarray(target.pos), times, axis=0)
    np.testing.assert_allclose(slope[1:-1], target.vel[1:-1], atol=1e-4)
    directions = np.asarray(target.pos[500, :, :2]) / away[500, :, None]
    assert np.all(np.abs(world.drones.vel - target.vel[0]) <= 0.05)  # of the first target
    cosines = np.abs(directions @ directions.T) - np.eye(drones)
    assert cosines.max() < 0.99  # no two lines are the same


@pytest.mark.slow
def test_the_drones_fly_in_the_wakes_of_each_other_unless_told_otherwise():
    """Two drones above each other: the lower one sinks."""
    falls = []
    for options in ({}, {"pairs": ()}):
        env = make("wake", **options)
        _, world = env.reset(KEY)
        still = jd.State.at_rest(jnp.array([[0.0, 0, 1.0], [0, 0, 1.5]]))
        still = still.replace(rpm=jnp.broadcast_to(world.params.hover_rpm[:, None], (2, 4)))
        _, world, *_ = env.step(KEY, world.replace(drones=still), jnp.zeros((2, 4)))
        falls.append(np.asarray(world.drones.vel[:, 2]))
    assert falls[0][0] < -0.01 and abs(falls[1][0]) < 1e-3
    np.testing.assert_allclose(falls[0][1], falls[1][1], atol=1e-6)


def test_the_deviation_counts_the_steps_after_the_first_second():
    """As the criterion of success does, without a flight."""
    errors, squares = np.random.default_rng(0).normal(size=(30, 2)), jnp.zeros(2)
    for step, z in enumerate(errors, 1):
        drones = SimpleNamespace(pos=jnp.asarray(z)[:, None] * jnp.array([[0, 0, 1]]))
        variables = {"altitude": jnp.zeros(2), "squares": squares}
        world = SimpleNamespace(step=step, dt=0.04, drones=drones, variables=variables)
        squares = wake._advance(None, world)["squares"]
    world.variables = variables | {"squares": squares}
    expected = np.sqrt(np.mean(errors[25:] ** 2, axis=0))
    np.testing.assert_allclose(wake._altitude_deviation(None, world), expected)


def test_success_is_every_altitude_after_the_first_second():
    errors = jnp.zeros((50, 4)).at[24, 1].set(1.0).at[25, 2].set(0.06).at[49, 3].set(0.06)
    assert wake.wake().success({"altitude_error": errors}, 0.04).tolist() == [True, True, False, False]


@pytest.mark.slow
@pytest.mark.float32
def test_the_deviation_is_the_root_mean_square_after_the_first_second():
    """At 93 Hz, as 1 / (1 / 93) is a little less than 93."""
    env = make("wake", duration=1.2, control_hz=93)
    step = jit_unoptimized(env.step)
    _, world = jit_unoptimized(env.reset)(KEY)
    errors = []
    for _ in range(env.steps):
        _, world, *_, info = step(KEY, world, jnp.full((2, 4), 0.05))
        errors.append(np.asarray(info["metrics"]["altitude_error"]))
    expected = np.sqrt(np.mean(np.square(errors[93:]), axis=0))
    np.testing.assert_allclose(info["metrics"]["altitude_deviation"], expected, rtol=1e-5)
    metrics = {"altitude_error": jnp.asarray(errors)}
    np.testing.assert_array_equal(env.task.success(metrics, env.dt), np.max(errors[93:], axis=0) < 0.05)
