"""Obstacles in an environment: the task's or the caller's, the same in every episode or drawn anew."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

import jaxdrones as jd
from jaxdrones.envs import TASKS, AutoReset, check_env, make
from jaxdrones.sensing import Scene, Sensor, Sphere

KEY = jax.random.key(5)
ZERO = jnp.zeros((1, 4))
STILL = dict(tilt=0.0, speed=0.0, omega=0.0, reach=0.0)
BALL = Scene.of(Sphere(pos=(0.0, 0.0, 1.0), radius=0.5))


def repelled(params, state, scene):
    """Upward force of 0.1 N within 1 m of the sphere, the first of the scene."""
    near = jnp.sum((state.pos - scene.spheres.pos[0]) ** 2) < 1.1
    force = jd.rotation.rotate_inverse(state.quat, jd.vector.along_z(jnp.where(near, 0.1, 0.0)))
    return jd.Wrench.of_force(force)


def random_ball(key):
    return Scene.of(Sphere(pos=jax.random.uniform(key, (3,), minval=-1.0), radius=0.1), ground=False)


RANGE = Sensor("range", lambda key, params, state, rate, scene, memory: (None, scene.distance(state.pos)), bound=20.0)


def test_obstacles_are_solid_unless_the_task_ends_where_they_are_touched():
    ends = dataclasses.replace(TASKS["hover"](), scene=BALL, obstacles_terminate=True)
    touches = dataclasses.replace(ends, contact=("obstacles",))
    expected = [("hover", BALL, True), ("hover", random_ball, True), ("hover", Scene(ground=False), False)]
    for task, scene, solid in (*expected, (ends, None, False), (touches, None, True)):
        assert bool(make(task, scene=scene).physics.physics.contacts("obstacles")) == solid
    assert not make("hover", scene=BALL, effects=(repelled,)).physics.physics.contacts("obstacles")


@pytest.mark.parametrize("backend", ["explicit", pytest.param("bullet", marks=pytest.mark.needs("pybullet"))])
def test_a_scene_whose_obstacles_the_physics_does_not_have_replaces_no_other(backend):
    with make("hover", backend=backend) as env:
        dataclasses.replace(env, scene=Scene()).reset(KEY)
        with pytest.raises(ValueError, match="does not have the obstacles of its scene; make another environment"):
            dataclasses.replace(env, scene=BALL).reset(KEY)


@pytest.mark.parametrize("scene", [3, lambda key: 3])
def test_what_is_no_scene_is_refused(scene):
    with pytest.raises(ValueError, match=r"scene .* 3; (give|return) a"):
        make("hover", scene=scene)


@pytest.mark.slow
@pytest.mark.parametrize("scene", [BALL, lambda key: BALL], ids=["fixed", "drawn"])
def test_an_effect_is_given_the_scene_of_the_episode(scene):
    env = make("hover", scene=scene, effects=(repelled,), **STILL)
    _, world = env.reset(KEY)
    assert world.scene.spheres.pos.shape == (1, 3)
    change = env.step(KEY, world, ZERO)[1].drones.vel[0, 2]
    np.testing.assert_allclose(change, 0.1 / world.params.mass[0] * env.dt, rtol=1e-6)
    check_env(env)


@pytest.mark.slow
def test_a_drawn_scene_is_another_one_in_every_episode_and_the_same_within():
    env = make("hover", scene=random_ball, effects=(repelled,), sensors=(RANGE,), duration=0.02, observation=("range",))
    auto = AutoReset(env)
    keys = jax.random.split(KEY, 3)
    obs, episodes = jit_unoptimized(jax.vmap(auto.reset))(keys)
    step, first = jit_unoptimized(jax.vmap(auto.step)), episodes.world
    for _ in range(2):
        obs, episodes, *_, info = step(keys, episodes, jnp.zeros((3, 1, 4)))
    balls = [world.scene.spheres.pos[:, 0] for world in (first, info["final_world"], episodes.world)]
    np.testing.assert_array_equal(balls[0], balls[1])
    assert len(np.unique(np.concatenate([balls[0], balls[2]]), axis=0)) == 6
    away = np.linalg.norm(episodes.world.drones.pos[:, 0] - balls[2], axis=-1) - 0.1
    np.testing.assert_allclose(obs[:, 0, 0], away, rtol=1e-6)


@pytest.mark.slow
def test_a_start_may_depend_on_the_scene():
    """Above the ball, wherever that is."""
    plain = TASKS["hover"]()

    def start(key, params, scene):
        state, variables = plain.start(key, params)
        return state.replace(pos=scene.spheres.pos + jnp.array([[0.0, 0.0, 1.0]])), variables

    env = make(dataclasses.replace(plain, start=start), scene=random_ball, effects=(repelled,))
    _, worlds = jit_unoptimized(jax.vmap(env.reset))(jax.random.split(KEY, 3))
    np.testing.assert_allclose(worlds.drones.pos - worlds.scene.spheres.pos, np.tile([0, 0, 1], (3, 1, 1)), atol=1e-12)


def test_a_fixed_scene_is_not_copied_at_the_end_of_an_episode():
    fixed = make("hover", scene=BALL, effects=(repelled,))
    assert set(fixed.constant_fields) == {"params", "scene"}
    assert make("hover", scene=random_ball, effects=(repelled,)).constant_fields == ("params",)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["explicit", pytest.param("bullet", marks=pytest.mark.needs("pybullet"))])
def test_a_drone_rests_on_a_ball(backend):
    with make("hover", backend=backend, scene=BALL, sensors=(RANGE,), **STILL) as env:
        _, world = env.reset(KEY)
        np.testing.assert_allclose(world.readings["range"], [0.5], atol=1e-6)
        world = world.replace(drones=world.drones.replace(pos=jnp.array([[0.0, 0.0, 1.6]])))
        for _ in range(60):
            _, world, *_ = env.step(KEY, world, -jnp.ones((1, 4)))
        assert 1.5 < world.drones.pos[0, 2] < 1.6  # it rests on the ball
        assert env.scene == BALL
