"""What the Bullet step shares with the explicit one beside free flight: rates, effects, what it refuses."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close

import jaxdrones as jd
from jaxdrones.engine import bullet
from jaxdrones.sensing import Box, Scene

pytestmark = pytest.mark.needs("pybullet")

TEAM = jd.repeat(jd.load_params("cf2x"), 2)
HIGH = jd.State.at_rest([[0.0, 0, 2], [1, 0, 2]])
HOVER = jnp.broadcast_to(TEAM.hover_rpm[:, None], (2, 4))


@pytest.fixture(scope="module")
def step():
    with bullet.make_step(rotors=jd.lagging_rotors) as step:
        yield step


@pytest.mark.slow
def test_the_rate_is_that_of_the_explicit_backend_in_free_flight(step):
    """To the order of a physics step."""
    state = HIGH.replace(vel=jnp.ones((2, 3)), omega=jnp.full((2, 3), 0.1), rpm=0.9 * HOVER)
    explicit = jd.make_step(rotors=jd.lagging_rotors).rate(TEAM, state, HOVER)
    rate = step.rate(TEAM, state, HOVER)
    assert_close(rate.replace(pos=explicit.pos, quat=explicit.quat), explicit, 1e-9)
    np.testing.assert_allclose(rate.pos, explicit.pos, atol=0.01)
    np.testing.assert_allclose(rate.quat, explicit.quat, atol=1e-3)
    assert_close(jax.jit(step.rate)(TEAM, state, HOVER), rate, 1e-12)


def test_rotors_that_take_their_speed_at_once_have_no_rate_on_either_backend():
    """Nor do they turn the body by a jump of their speed, whatever speed the state has."""
    team = TEAM.replace(rotor_inertia=jnp.full(2, 5e-8))
    state, command = (
        HIGH.replace(omega=jnp.full((2, 3), 0.1), rpm=0.5 * HOVER),
        HOVER * jnp.array([[1.0, 1.1, 0.9, 1.2]]),
    )
    explicit = jd.make_step().rate(team, state, command)
    with bullet.make_step() as step:
        for rate in step.rate(team, state, command), jax.jit(step.rate)(team, state, command):
            np.testing.assert_array_equal(rate.rpm, 0)
            np.testing.assert_array_equal(rate.rpm, explicit.rpm)
            assert_close((rate.vel, rate.omega), (explicit.vel, explicit.omega), 1e-9)


def test_the_rate_of_a_quaternion_does_not_jump_with_its_sign(step):
    """A quaternion and its negative are one attitude, and Bullet returns either."""
    quat = jnp.array([[0.6, 0.0, 0.0, 0.8], [0.0, 0.8, 0.0, -0.6]])
    rates = [step.rate(TEAM, HIGH.replace(quat=q, omega=jnp.ones((2, 3))), HOVER).quat for q in (quat, -quat)]
    np.testing.assert_allclose(rates[0], -rates[1], atol=1e-9)
    assert np.abs(rates[0]).max() < 1


def test_the_rate_of_a_drone_at_rest_on_the_ground_is_zero(step):
    """Gravity and the ground's push together, which the sum of wrenches does not know."""
    state, still = jd.State.at_rest([[0.0, 0, 0.05], [1, 0, 0.05]]), np.zeros((2, 4))
    state = jd.rollout(step, lambda params, memory, state, k: (memory, still), TEAM, state, None, 240)[0]
    rate = step.rate(TEAM, state, still)
    np.testing.assert_allclose(rate.vel, 0, atol=0.05)


@pytest.mark.parametrize(
    "contact",
    [
        dict(effects=(jd.ground_contact,)),
        dict(effects=(jd.obstacle_contact,)),
        dict(pairs=(jd.drone_contact,)),
        dict(effects=(functools.partial(jd.ground_contact),)),
    ],
)
def test_contact_as_an_effect_is_refused_as_bullet_resolves_it_already(contact):
    with pytest.raises(ValueError, match="contact is given and Bullet resolves contacts by itself"):
        bullet.make_step(**contact)


def test_a_checkpointed_rollout_is_refused_as_there_is_no_backward_pass(step):
    with pytest.raises(ValueError, match="checkpoint is given and the bullet backend has no backward pass"):
        jd.rollout(step, lambda params, memory, state, k: (memory, HOVER), TEAM, HIGH, None, 4, checkpoint=2)


@pytest.mark.slow
def test_an_effect_sees_the_scene_of_either_backend():
    """A fan at every box: it lifts a drone that is within a meter of one."""
    scene = Scene.of(Box(pos=(0.0, 0.0, 1.5), size=(0.1, 0.1, 0.1)))

    def fan(params, state, scene):
        return jd.Wrench.of_force(jd.vector.along_z(jnp.where(state.pos[0] < 0.5, 0.1, 0.0) * scene.has_obstacles))

    explicit = jd.make_step((fan,), scene=scene)(TEAM, HIGH, HOVER)
    assert explicit.vel[0, 2] > 0.01 and abs(float(explicit.vel[1, 2])) < 1e-12
    with bullet.make_step((fan,), scene=scene) as step:
        assert_close(step(TEAM, HIGH, HOVER), explicit, 1e-9)
        assert_close(step(TEAM, HIGH, HOVER, Scene()), jd.make_step()(TEAM, HIGH, HOVER), 1e-9)


def test_obstacles_that_nothing_honors_are_refused_by_the_explicit_backend():
    scene = Scene.of(Box(pos=(0.0, 0.0, 1.5), size=(0.1, 0.1, 0.1)))
    with pytest.raises(ValueError, match=r"scene has obstacles, but no effect uses it.*use the bullet backend"):
        jd.make_step(scene=scene)
    with pytest.raises(ValueError, match="scene has obstacles, but no effect uses it"):
        jd.make_step()(TEAM, HIGH, HOVER, scene)
