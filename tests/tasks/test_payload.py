"""Loads along a curve: where drones and loads start, what a swing is, and when a flight is a success."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized, mostly_slow, mostly_slow_rows

import jaxdrones as jd
from jaxdrones.envs import TASKS, make
from jaxdrones.envs.randomize import draw
from jaxdrones.learning import bptt, evaluate
from jaxdrones.sensing import Scene
from jaxdrones.training.presets import preset

KEYS = jax.random.split(jax.random.key(0), 50)
pytestmark = pytest.mark.float32


def carrying(pos, load, vel=0.0, load_vel=0.0):
    """A world of drones at these positions with these loads, after a second."""
    pos, vel, load, load_vel = (jnp.broadcast_to(x, pos.shape).astype(float) for x in (pos, vel, load, load_vel))
    aux = {"payload": SimpleNamespace(pos=load, vel=load_vel)}
    return SimpleNamespace(drones=SimpleNamespace(pos=pos, vel=vel, aux=aux), variables=None, time=1.0)


def load_of(worlds):
    return worlds.drones.aux["payload"]


@pytest.mark.parametrize(
    "task, drones",
    mostly_slow_rows(
        [("sling", 1), ("sling", 2), ("transport", 2), ("transport", 4)], [("sling", 2), ("transport", 4)]
    ),
)
def test_loads_start_near_the_curve_below_their_drones_on_cables_that_are_not_stretched(task, drones):
    made = TASKS[task](drones=drones)
    params = made.equip(jd.repeat(jd.load_params("cf2x"), drones))

    @jit_unoptimized
    @jax.vmap
    def starts(key):
        state, variables = made.begin(key, params, Scene())
        return state, made.target(variables, jnp.zeros(()))

    state, target = starts(KEYS)
    load = state.aux["payload"]
    hanging = np.asarray(load.pos - state.pos)
    away = np.linalg.norm(hanging, axis=-1)
    assert away.max() < 0.501 and away.min() > (0.499 if task == "sling" else 0.4)
    error = np.linalg.norm(load.pos - target.pos, axis=-1)
    assert 0.02 < np.median(error) and np.max(error) < 0.4
    assert np.ptp(np.asarray(target.pos)[:, 0, 0]) > 1.5
    np.testing.assert_allclose(load.vel, target.vel, atol=1e-5)
    assert np.max(np.abs(state.vel - target.vel)) < 0.1 + 1e-5
    if task == "transport":
        for x in (load.pos, target.pos, target.vel):
            np.testing.assert_array_equal(x, np.broadcast_to(x[:, :1], x.shape))
    else:
        assert 0.08 < np.abs(hanging[..., :2]).max() < 0.1  # it swings
        np.testing.assert_allclose(target.pos[:, -1, 1] - target.pos[:, 0, 1], 4.0 * (drones - 1), rtol=1e-5)


@pytest.mark.parametrize(
    "task, drones, mass", mostly_slow_rows([("sling", 2, 0.5), ("transport", 4, 2.0)], [("transport", 4, 2.0)])
)
def test_the_mass_of_a_load_is_the_share_of_its_drones(task, drones, mass):
    env = make(task, drones=drones, load=0.5, length=0.7)
    load = env.params.aux["payload"]
    np.testing.assert_allclose(load.mass, mass * env.params.mass[0], rtol=1e-6)
    np.testing.assert_allclose(load.length, 0.7, rtol=1e-6)
    np.testing.assert_allclose(load.stiffness * load.onset, 0.5 * env.params.mass * 9.8, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("task", mostly_slow(["sling", "transport"], ["sling"]))
def test_a_load_is_the_same_whatever_the_random_mass_of_its_drones(task):
    env = make(task, load=0.5, realistic=True)
    params = jit_unoptimized(jax.vmap(lambda key: draw(env.draws, key, env.params)))(KEYS)
    assert np.ptp(np.asarray(params.mass)) > 0.1 * float(env.params.mass[0])
    load = np.asarray(params.aux["payload"].mass)
    np.testing.assert_allclose(load, np.broadcast_to(env.params.aux["payload"].mass, load.shape))


@pytest.mark.parametrize(("task", "drones"), [("sling", 1), ("transport", 3)])
def test_the_swing_is_the_angle_from_the_vertical_to_the_middle_of_the_team(task, drones):
    swing = TASKS[task](drones=drones).metrics["swing"]
    pos = np.random.default_rng(0).normal(size=(drones, 3))
    for degrees in (0.0, 20.0, 90.0, 135.0):
        angle = np.radians(degrees)
        offset = 0.4 * np.array([0.6 * np.sin(angle), 0.8 * np.sin(angle), -np.cos(angle)])
        world = carrying(pos, load=np.mean(pos, axis=0) + offset)
        np.testing.assert_allclose(swing(None, world), degrees, atol=0.01)


def test_loads_are_seen_from_the_drone_and_targets_from_the_load():
    task = TASKS["sling"](drones=2)
    target = SimpleNamespace(pos=jnp.full((2, 3), 4.0), vel=jnp.full((2, 3), 6.0))
    asked = SimpleNamespace(target_now=lambda world: target, target=lambda v, t: SimpleNamespace(pos=target.pos + t))
    world = carrying(np.full((2, 3), 1.0), 0.5, vel=np.full((2, 3), 2.0), load_vel=3.0)
    for name, expected in {
        "load": [-0.5] * 3 + [1] * 3,
        "load_error": [3.5] * 3,
        "load_velocity_error": [3] * 3,
        "load_preview": [4.5 + t for t in (0.1, 0.2, 0.4, 0.6) for _ in range(3)],
    }.items():
        found = task.observations[name].observe(asked, world)
        np.testing.assert_allclose(found, np.tile(expected, (2, 1)), rtol=1e-6)


def test_drones_at_their_places_have_no_penalty_and_carry_the_load_at_rest():
    """The places of a team are equal cables apart from the load, and its thrust holds a load where it is."""
    env = make("transport", drones=3)

    @jit_unoptimized
    def at_their_places(key):
        _, world = env.reset(key)
        places = world.drones.pos + env.task.observations["place"].observe(env.task, world)
        there = world.replace(drones=world.drones.replace(pos=places))
        return places - load_of(world).pos, env.task.rewards["place"][1](env.task, there)

    apart, penalty = at_their_places(jax.random.key(0))
    np.testing.assert_allclose(np.linalg.norm(apart, axis=-1), 0.5, rtol=1e-5)
    np.testing.assert_allclose(np.mean(apart, axis=0)[:2], 0, atol=1e-6)
    np.testing.assert_allclose(penalty, 0, atol=1e-4)


def test_success_is_an_rms_error_below_10_cm_and_a_largest_swing_below_15_degrees_after_a_second():
    env = make("sling")
    steps = np.ones((500, 1))
    late = np.arange(500)[:, None] >= 50

    def succeeds(error, swing):
        return env.task.success({"error": jnp.asarray(error), "swing": jnp.asarray(swing)}, 0.02).tolist() == [True]

    assert succeeds(0.099 * steps, 14.9 * steps)
    assert succeeds(np.where(late, 0.09, 1.0), np.where(late, 10.0, 40.0))
    assert not succeeds(0.101 * steps, 10 * steps) and not succeeds(0.05 * steps, 15.1 * steps)
    assert not succeeds(0.05 * steps, np.where(np.arange(500)[:, None] == 300, 16.0, 1.0))
    assert make("sling", duration=1.0).task.success is None


@pytest.mark.slow
def test_a_shared_load_is_refused_where_drones_leave_the_world_one_by_one():
    """The first to leave would tear the load and all others away."""
    carriers = dict(drones=3, vehicle=jd.with_payload(jd.load_params("cf2x"), 0.005, cables=3), effects=(jd.cable,))
    with pytest.raises(ValueError, match="'payload' has a state of the whole team, and drones leave crowd one by one"):
        make("crowd", models=(jd.payload(shared=True),), **carriers)


def test_a_load_weighs_on_the_drone_of_a_task_and_any_task_takes_one():
    """The action 0 is the weight of the drone alone: drone and load sink by the share of the load."""
    params = jd.with_payload(jd.load_params("cf2x"), 0.009)
    hover = make(
        "hover", vehicle=params, effects=(jd.cable,), models=(jd.payload(),), reach=0.0, speed=0.0, omega=0.0, tilt=0.0
    )
    _, world = hover.reset(jax.random.key(0))
    start = world.drones.pos[0, 2]
    for _ in range(30):
        _, world, *_ = hover.step(jax.random.key(1), world, jnp.zeros((1, 4)))
    share = 0.009 / (0.009 + float(params.mass))
    np.testing.assert_allclose(start - world.drones.pos[0, 2], share * 9.8 * 0.3**2 / 2, rtol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["sling", "transport"])
def test_bptt_learns_to_carry_a_load(task):
    env, config = preset(task, "bptt", practice=True)
    result = bptt.train(jax.random.key(0), env, config)
    report = evaluate(make(task), result.policy, jax.random.key(1), 100)
    assert report.success_lower_bound > 0.9 and report.rms_error < 0.05
