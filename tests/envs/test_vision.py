"""Cameras in environments: the same on both backends, at their rate and latency, in worlds of different ages."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones as jd
from jaxdrones.envs import TASKS, AutoReset, check_env, make
from jaxdrones.envs.episode import RESET
from jaxdrones.envs.vision import Vision
from jaxdrones.sensing import Box, Scene, Sphere
from jaxdrones.tasks.task import World

KEY = jax.random.key(4)
CAMERA = jd.Camera(resolution=(8, 6), far=20.0)


def obstacles(key):
    """A wall in front and a ball in the air at random places."""
    ahead, aside = jax.random.uniform(key, (2,), float, 1.0, 2.0)
    wall = Box(pos=jnp.stack([ahead + 1, 0 * ahead, 1.5 + 0 * ahead]), size=(0.5, 3.0, 1.0))
    return Scene.of(wall, Sphere(pos=jnp.stack([-ahead, aside, 1 + 0 * ahead]), radius=0.4))


TASK = dataclasses.replace(
    TASKS["hover"](tilt=0.3, reach=0.3, duration=0.2, height=2.0), scene=obstacles, obstacles_terminate=True
)


def sees(backend="explicit", vision=("depth",), task=TASK, **camera):
    return make(task, vision=vision, backend=backend, camera=dataclasses.replace(CAMERA, **camera))


@pytest.fixture(scope="module")
def env():
    """10 images per second of 0.03 s age at 100 control steps per second."""
    return sees(rate=100 / 3, latency=0.04)


@pytest.mark.parametrize(("delay", "dt"), [(0, 0.01), (1, 0.02), (3, 0.01)])
def test_an_image_is_of_the_pose_some_control_steps_ago(delay, dt):
    """Of the start until then. The latency is in seconds, the control period that of the world."""

    def render(params, drones, scene):
        return jd.sensing.Images(None, drones.pos[:, 2], None)

    vision = Vision(("depth",), dataclasses.replace(CAMERA, latency=dt * delay), render, False)
    at = [jd.State.at_rest([[0.0, 0, z]]) for z in range(6)]
    world = World(None, at[0], None, None, None, jnp.asarray(0), jnp.ones(1, bool), dt)
    world = vision.first(None, world)
    for k in range(1, 6):
        world = vision.next(None, world.replace(drones=at[k], step=jnp.asarray(k)))
        assert world.images["depth"].tolist() == [max(0, k - delay)]


def episode(env, key, tape):
    """Observations and worlds of an episode, from the start on."""
    obs, world = env.reset(key)

    def control_step(world, action):
        obs, world, *_ = env.step(key, world, action)
        return world, (obs, world)

    _, later = jax.lax.scan(control_step, world, tape)
    return jax.tree.map(lambda first, x: jnp.concatenate([first[None], x]), (obs, world), later)


def short_repr(t):
    """The step whose state is seen at step t: every third one, 4 steps later, and the start until then."""
    return max(0, (t - 4) // 3 * 3)


TAPE = jax.random.uniform(jax.random.key(1), (12, 1, 4), float, -0.5, 0.5)


@pytest.mark.slow
def test_an_image_shows_the_state_of_its_time_until_the_next_one_comes(env):
    obs, worlds = jax.jit(functools.partial(episode, env))(KEY, TAPE)
    at = np.array([short_repr(t) for t in range(len(TAPE) + 1)])
    expected = jax.vmap(lambda world: jd.render(world.scene, world.params, world.drones, env.vision.camera).depth)(
        worlds
    )
    np.testing.assert_allclose(obs["depth"], expected[at], rtol=1e-9)
    assert len(np.unique(np.asarray(expected), axis=0)) == len(at)


def test_a_rate_that_does_not_divide_the_control_rate_is_kept():
    """Of 30 images per second at 100 Hz, the k-th one is from the first step at or after k / 30 s."""
    vision = sees(rate=30.0, latency=0.02).vision
    seen = np.flatnonzero(vision.is_due(jnp.arange(1003), 0.01))
    np.testing.assert_array_equal(seen - 2, np.ceil(100 * np.arange(1, 301) / 30 - 1e-9))


def test_a_camera_that_is_too_fast_for_a_replaced_control_period_is_refused(env):
    np.testing.assert_array_equal(np.flatnonzero(env.vision.is_due(jnp.arange(9), 0.02)), [4, 5, 7, 8])
    with pytest.raises(ValueError, match=r"rate of the camera is 33.3333 images/s; give at most the control rate, 25,"):
        dataclasses.replace(env, dt=0.04, physics=jd.make_step(dt=0.04))


@pytest.mark.slow  # its quick sibling is in test_exposures.py
def test_the_gradient_of_a_held_image_is_that_of_the_state_that_it_shows(env):
    blind = make(TASK, vision=())

    def seen(tape, key):
        return jnp.sum(jnp.log(episode(env, key, tape)[0]["depth"][8:]))

    def rendered(tape, key):
        _, worlds = episode(blind, key, tape)
        at = np.array([short_repr(t) for t in range(8, len(TAPE) + 1)])
        worlds = jax.tree.map(lambda x: x[at], worlds)
        return jnp.sum(
            jnp.log(jax.vmap(lambda w: jd.render(w.scene, w.params, w.drones, env.vision.camera).depth)(worlds))
        )

    keys = jax.random.split(KEY, 2)
    actual = jax.jit(jax.vmap(jax.grad(seen), (None, 0)))(TAPE, keys)
    expected = jax.jit(jax.vmap(jax.grad(rendered), (None, 0)))(TAPE, keys)
    assert np.abs(expected).max() > 1e-3
    np.testing.assert_allclose(actual, expected, rtol=1e-7, atol=1e-10)


@pytest.mark.slow
def test_worlds_of_different_ages_see_what_each_sees_alone_and_start_anew(env):
    auto = AutoReset(env)
    keys = jax.random.split(KEY, 5)
    _, episodes = jax.vmap(auto.reset)(keys)
    ages = jnp.array([0, 2, 3, 5, 19], episodes.world.step.dtype)  # the last one ends: an episode has 20 steps
    episodes = episodes.replace(world=episodes.world.replace(step=ages))
    action = jnp.zeros((5, 1, 4))
    obs, after, *_, info = jax.jit(jax.vmap(auto.step))(keys, episodes, action)
    fresh, start = env.reset(jax.random.fold_in(keys[4], RESET))
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-9), obs["depth"][4], fresh["depth"])
    np.testing.assert_allclose(after.world.poses[4], start.poses, rtol=1e-9)
    for i in range(5):
        alone, *_ = env.step(keys[i], jax.tree.map(lambda x, i=i: x[i], episodes.world), action[i])
        np.testing.assert_allclose(info["final_obs"]["depth"][i], alone["depth"], rtol=1e-9)


@pytest.mark.slow
def test_the_contract_holds_with_images(env):
    check_env(env, steps=3)
    assert "depth of 8 x 6 pixels at 33.3333 images/s, 0.04 s late" in repr(env)


@pytest.mark.slow
@pytest.mark.needs("pybullet")
def test_both_backends_see_the_same_drawn_scene_at_the_same_times():
    names = ("rgb", "depth", "segmentation")
    options = dict(vision=names, rate=50.0, latency=0.01, principal_point=(0.0, 0.0))
    explicit = sees(**options)
    with sees("bullet", **options) as bullet:
        for key in jax.random.split(KEY, 2):
            obs, worlds = zip(*(env.reset(key) for env in (explicit, bullet)), strict=True)
            for action in TAPE[:4]:
                for image in names:
                    assert obs[0][image].shape == obs[1][image].shape and obs[0][image].dtype == obs[1][image].dtype
                same = obs[0]["segmentation"] == obs[1]["segmentation"]
                assert np.mean(same) > 0.85  # 48 pixels: one column is 12 % of them
                ratio = obs[0]["depth"][same] / obs[1]["depth"][same]
                assert np.mean(np.abs(ratio - 1) < 0.01) > 0.95
                obs, worlds = zip(
                    *(env.step(key, world, action)[:2] for env, world in zip((explicit, bullet), worlds, strict=True)),
                    strict=True,
                )


@pytest.mark.slow
@pytest.mark.needs("pybullet")
def test_bullet_takes_pictures_only_where_one_is_due(monkeypatch):
    with sees("bullet", rate=25.0) as env:
        _, worlds = jax.vmap(env.reset)(jax.random.split(KEY, 4))
        worlds = worlds.replace(step=jnp.arange(4, dtype=worlds.step.dtype))
        taken = []
        take = env.physics.client.p.getCameraImage
        monkeypatch.setattr(env.physics.client.p, "getCameraImage", lambda *a, **k: taken.append(1) or take(*a, **k))
        step = jax.jit(jax.vmap(env.step, (None, 0, 0)))
        for _ in range(4):
            before, (obs, worlds, *_) = worlds.images["depth"], step(KEY, worlds, jnp.full((4, 1, 4), -0.5))
            changed = jnp.any(obs["depth"] != before, axis=(1, 2, 3))
            np.testing.assert_array_equal(changed, worlds.step % 4 == 0)
        assert len(taken) == 4


@pytest.mark.slow
@pytest.mark.needs("pybullet")
def test_bullet_shows_the_same_in_a_compiled_program():
    with sees("bullet", rate=50.0, vision=("segmentation",)) as env:
        _, world = env.reset(KEY)
        step = jax.jit(env.step)
        for action in TAPE[:2]:
            plain, compiled = env.step(KEY, world, action), step(KEY, world, action)
            np.testing.assert_array_equal(plain[0]["segmentation"], compiled[0]["segmentation"])
            world = plain[1]
