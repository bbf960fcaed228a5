"""Loads along a curve: where drones and loads start, what a swing is, and when a flight is a success."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized, mostly_slow, mostly_slow_rows

import jaxdrones as jd
from jaxdrones.envs import make
from jaxdrones.envs.randomize import draw
from jaxdrones.learning import bptt, evaluate
from jaxdrones.training.presets import preset

KEYS = jax.random.split(jax.random.key(0), 50)
pytestmark = pytest.mark.float32


def load_of(worlds):
    return worlds.drones.aux["payload"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "task, drones",
    [
        ("sling", 1),
        ("sling", 2),
        ("transport", 2),
        ("transport", 4),
    ],
)
def test_loads_start_near_the_curve_below_their_drones_on_cables_that_are_not_stretched(task, drones):
    env = make(task, drones=drones)
    _, worlds = jit_unoptimized(jax.vmap(env.reset))(KEYS)
    pos, load = np.asarray(worlds.drones.pos), np.asarray(load_of(worlds).pos)
    away = np.linalg.norm(pos - load, axis=-1)
    assert away.max() < 0.501 and away.min() > (0.499 if task == "sling" else 0.4)
    error = jit_unoptimized(jax.vmap(env.task.measure))(worlds)["error"]
    assert 0.02 < np.median(error) and np.max(error) < 0.4
    target = jit_unoptimized(jax.vmap(env.task.target_now))(worlds)
    assert np.ptp(np.asarray(target.pos)[:, 0, 0]) > 1.5
    np.testing.assert_allclose(load_of(worlds).vel, target.vel, atol=1e-5)
    if task == "transport":
        for x in (load, target.pos, target.vel):
            np.testing.assert_array_equal(x, np.broadcast_to(x[:, :1], x.shape))
    elif drones == 2:
        np.testing.assert_allclose(target.pos[:, 1, 1] - target.pos[:, 0, 1], 4.0, rtol=1e-5)


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


@pytest.mark.slow
def test_the_swing_is_the_angle_from_the_vertical_to_the_middle_of_the_team():
    for task, drones in (("sling", 1), ("transport", 3)):
        env = make(task, drones=drones)
        _, world = jit_unoptimized(env.reset)(jax.random.key(0))
        middle = jnp.mean(world.drones.pos, axis=0)
        for degrees in (0.0, 20.0, 90.0, 135.0):
            angle = np.radians(degrees)
            offset = 0.4 * np.array([0.6 * np.sin(angle), 0.8 * np.sin(angle), -np.cos(angle)])
            pos = jnp.broadcast_to(middle + offset, world.drones.pos.shape)
            moved = world.replace(drones=world.drones.replace(aux={"payload": load_of(world).replace(pos=pos)}))
            np.testing.assert_allclose(env.task.measure(moved)["swing"], degrees, atol=0.01)


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
