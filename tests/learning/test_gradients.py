"""Gradient options change the gradient as they say, and never what is simulated."""

import dataclasses
import types
from collections.abc import Callable

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from double_integrator import DoubleIntegrator
from helpers import jit_unoptimized, mostly_slow

import jaxdrones as jd
from jaxdrones import envs
from jaxdrones.learning import bptt, collect
from jaxdrones.learning.gradients import (
    SurrogateStep,
    gradient_between_steps,
    limit_gradient,
    point_mass,
    scale_gradient,
    with_gradient,
)

CONFIG = bptt.Config(updates=2, worlds=2, horizon=6, hidden_sizes=(4,))


def test_scaling_a_gradient_keeps_the_value():
    value, gradient = jax.value_and_grad(lambda x: scale_gradient({"x": x}, 0.5)["x"] ** 2)(3.0)
    assert value == 9 and gradient == 3
    values = jnp.array([jnp.inf, -jnp.inf, 1.0])
    np.testing.assert_array_equal(scale_gradient(values, 0.5), values)


def test_a_surrogate_takes_as_long_as_the_physics():
    """By default `make_step` has another period; its derivatives would be of another flight."""
    config = bptt.Config(gradient="surrogate", surrogate=jd.make_step())
    with pytest.raises(
        ValueError, match=r"the surrogate takes 0.004167 s, and one of the physics 0.01 s; give .*=0.01"
    ):
        with_gradient(jd.make("hover"), config)
    with pytest.raises(ValueError, match="give for example surrogate="):  # also by an update
        env = jd.make("hover")
        config = bptt.Config(**vars(CONFIG) | dict(gradient="surrogate", surrogate=jd.make_step()))
        jax.eval_shape(lambda key: bptt.update(env, config, bptt.init(key, env, config)), jax.random.key(0))


@pytest.mark.parametrize("gradient", mostly_slow(["surrogate", "point_mass"], ["point_mass"]))
def test_the_physics_of_an_environment_has_the_derivative_of_the_setting(gradient):
    env = jd.make("hover", substeps=2)
    derivative = {"surrogate": jd.make_step(dt=env.dt), "point_mass": point_mass(env.dt)}[gradient]
    state, rpm = jd.State.at_rest(jnp.zeros((1, 3))), jnp.full((1, 4), 15000.0)

    def height(step):
        return lambda rpm: step(env.params, state, rpm).pos[0, 2]

    mixed = with_gradient(env, bptt.Config(gradient=gradient)).physics
    steps = [jax.value_and_grad(height(step)) for step in (mixed, derivative)]
    (value, slope), (_, expected) = jit_unoptimized(lambda rpm: [step(rpm) for step in steps])(rpm)
    np.testing.assert_allclose(slope, expected, rtol=1e-12)
    np.testing.assert_allclose(value, jit_unoptimized(height(env.physics))(rpm), rtol=1e-12)


def test_between_steps_gradients_decay_and_outliers_are_limited():
    slopes = jnp.array([1.0, 1.0, 100.0])

    def gradient(**options):
        between = gradient_between_steps(bptt.Config(**options))
        return jax.grad(lambda x: jnp.sum(slopes * between(x)))(jnp.ones(3))

    decay, limit = dict(gradient="decay", gradient_decay=0.5), dict(outlier_gradient=2.0)
    other = dict(gradient="surrogate", gradient_decay=0.5)
    found = jit_unoptimized(
        lambda: [gradient(**other), gradient(**decay), gradient(**limit), gradient(**decay, **limit)]
    )()
    np.testing.assert_allclose(found, [[1, 1, 100], [0.5, 0.5, 50], [1, 1, 2], [0.5, 0.5, 1]], rtol=1e-12)


class OfStates(DoubleIntegrator):
    """Rewards of the states before the steps, which actions change only by earlier steps."""

    def step(self, key, world, action):
        obs, after, _, *rest = super().step(key, world, action)
        return obs, after, -jnp.sum(world.drones.pos**2, axis=-1), *rest


@pytest.mark.float32
def test_a_gradient_that_decays_at_once_has_nothing_of_later_steps():
    def gradient(decay):
        config = dataclasses.replace(CONFIG, horizon=3, gradient="decay", gradient_decay=decay)
        return bptt.update(OfStates(), config, bptt.init(jax.random.key(0), OfStates(), config))[1]["gradient_norm"]

    none, exact = jit_unoptimized(jax.vmap(gradient))(jnp.array([0.0, 1.0]))
    assert none == 0 and exact > 0


@pytest.mark.slow
def test_a_surrogate_has_the_values_of_one_step_and_the_derivative_of_the_other():
    fine, coarse = jd.make_step(dt=1 / 500, substeps=5), jd.make_step(dt=1 / 100)
    params = jd.repeat(jd.load_params("cf2x"), 1)
    state, rpm = jd.State.at_rest(jnp.zeros((1, 3))), jnp.full((1, 4), 15000.0)

    def height(step, rpm):
        return step(params, state, rpm).pos[0, 2]

    mixed = SurrogateStep(fine, coarse)
    assert height(mixed, rpm) == height(fine, rpm)
    mine, theirs = (jax.grad(height, 1)(step, rpm) for step in (mixed, coarse))
    np.testing.assert_allclose(mine, theirs, rtol=1e-12)
    in_params = jax.grad(lambda params: mixed(params, state, rpm).pos[0, 2])(params)
    assert not any(np.any(x) for x in jax.tree.leaves(in_params))


@pytest.fixture(scope="module")
def flights():
    """Final mean reward and its gradient in the policy's parameters, for each option."""
    env = envs.make("hover")
    state = bptt.init(jax.random.key(0), env, CONFIG)
    starts = collect.draw_starts(jax.random.key(1), env, CONFIG.worlds)
    worlds = collect.restart(jax.random.key(1), state.worlds, starts)

    def flown(params, **options):
        config = bptt.Config(**vars(CONFIG) | options)
        policy = state.policy.replace(params=params)
        _, trajectory = collect.collect(
            jax.random.key(2),
            with_gradient(env, config),
            lambda key, memory, obs: (memory, policy(obs), None),
            worlds,
            config.horizon,
            between_steps=gradient_between_steps(config),
        )
        return jnp.mean(trajectory.reward[-1])

    def both(**options):
        value, gradient = jax.jit(jax.value_and_grad(lambda params: flown(params, **options)))(state.policy.params)
        return value, jax.flatten_util.ravel_pytree(gradient)[0]

    return {
        "exact": both(gradient="exact"),
        "no decay": both(gradient="decay", gradient_decay=1.0),
        "decay": both(gradient="decay", gradient_decay=0.5),
        "surrogate": both(gradient="surrogate"),
        "point mass": both(gradient="point_mass"),
        "limited": both(gradient="exact", outlier_gradient=0.1),
    }


@pytest.mark.slow
def test_no_option_changes_the_flight(flights):
    for name, (value, _) in flights.items():
        np.testing.assert_allclose(value, flights["exact"][0], rtol=1e-12, err_msg=name)


@pytest.mark.slow
def test_a_decay_of_one_is_exact_and_a_smaller_one_shrinks_what_is_long_ago(flights):
    np.testing.assert_allclose(flights["no decay"][1], flights["exact"][1], rtol=1e-9, atol=1e-12)
    assert jnp.linalg.norm(flights["decay"][1]) < 0.5 * jnp.linalg.norm(flights["exact"][1])


@pytest.mark.slow
def test_outliers_are_limited_with_every_kind_of_gradient(flights):
    assert 0 < jnp.linalg.norm(flights["limited"][1]) < 0.5 * jnp.linalg.norm(flights["exact"][1])


@pytest.mark.slow
def test_a_surrogate_points_nearly_where_the_exact_gradient_does(flights):
    a, b = flights["surrogate"][1], flights["exact"][1]
    cosine = a @ b / jnp.linalg.norm(a) / jnp.linalg.norm(b)
    assert 0.9 < cosine < 1 - 1e-9


def test_a_point_mass_is_pushed_by_thrust_and_by_turning_the_thrust_and_its_attitude_has_no_gradient():
    dt, response = 0.02, 0.1
    params = jd.repeat(jd.load_params("cf2x"), 1)
    limit = params.max_rpm[0]
    rpm = params.hover_rpm[0] * jnp.array([[1.1, 0.9, 1.0, 0.0]]) + jnp.array([[0.0, 0.0, 0.0, 2 * limit]])
    state = jd.State.at_rest(jnp.zeros((1, 3)))
    derivatives = jax.jacrev(lambda state, rpm: point_mass(dt, response)(params, state, rpm), (0, 1))
    after = jit_unoptimized(derivatives)(state, rpm)
    (pos_of_state, pos_of_rpm), (vel_of_state, vel_of_rpm) = after.pos, after.vel
    limited = jnp.minimum(rpm[0], limit)
    thrust = 2 * params.kf[0] * limited * (rpm[0] < limit)  # of each rotor per RPM
    acc = jnp.sum(params.kf[0] * limited**2) / params.mass[0]
    np.testing.assert_allclose(vel_of_rpm[0, 2, 0], thrust / params.mass[0] * dt, rtol=1e-9)
    pitch_acc = -params.rotor_pos[0, :, 0] * thrust / params.inertia[0, 1]  # about y
    np.testing.assert_allclose(vel_of_rpm[0, 0, 0], pitch_acc * dt * response * acc * dt, rtol=1e-9)
    np.testing.assert_allclose(pos_of_rpm, vel_of_rpm * dt, rtol=1e-12)
    np.testing.assert_allclose(pos_of_state.vel[0, :, 0], dt * np.eye(3))
    assert not jnp.any(vel_of_state.quat) and not jnp.any(vel_of_state.omega) and not jnp.any(after.quat[1])


def test_sensors_measure_the_physics_and_not_its_surrogate():
    physics = types.SimpleNamespace(physics=None, period=None, rate=lambda *inputs: inputs)
    assert SurrogateStep(physics, point_mass(0.01)).rate(1, 2, 3, 4) == (1, 2, 3, 4)


@dataclasses.dataclass
class Eye:
    render: Callable


@dataclasses.dataclass
class Seeing:
    vision: Eye


@pytest.mark.parametrize(("image_gradient", "slope"), [(True, 6.0), (False, 0.0)])
def test_what_is_rendered_is_a_constant_for_the_gradient_if_the_setting_says_so(image_gradient, slope):
    seeing = with_gradient(Seeing(Eye(jnp.square)), bptt.Config(image_gradient=image_gradient))
    assert jax.value_and_grad(seeing.vision.render)(3.0) == (9.0, slope)


@pytest.mark.slow
def test_images_may_be_constants_for_the_gradient_and_are_the_same():
    down = jd.Camera(resolution=(3, 3), orientation=(0.0, 0.5**0.5, 0.0, 0.5**0.5))
    env = envs.make("hover", tilt=0.0, omega=0.0, vision=("depth",), camera=down)
    _, world = env.reset(jax.random.key(0))

    def depth(pos, image_gradient):
        drones = world.drones.replace(pos=pos)
        seeing = with_gradient(env, bptt.Config(image_gradient=image_gradient))
        obs, *_ = seeing.step(jax.random.key(0), world.replace(drones=drones), jnp.zeros((1, 4)))
        return obs["depth"][0, 1, 1]

    both = jax.jit(lambda pos: [jax.value_and_grad(depth)(pos, switch) for switch in (True, False)])
    (seen, slope), (same, none) = both(jnp.array([[0.0, 0.0, 1.0]]))
    assert seen == same and not jnp.any(none)
    np.testing.assert_allclose(slope, [[0, 0, 1]], atol=1e-6)  # of the ground below


def test_unknown_options_are_named():
    with pytest.raises(ValueError, match="surrogate"):
        bptt.Config(gradient="surogate")


def test_the_gradient_of_a_chaotic_world_is_shortened_to_a_multiple_of_the_median_and_keeps_its_direction():
    worlds = {"x": jnp.ones((5, 3)), "step": jnp.arange(5), "key": jax.random.split(jax.random.key(0), 5)}
    slopes = jnp.array([1.0, 2.0, 3.0, 100.0, -50.0])[:, None] * jnp.array([[1.0, 2.0, -2.0]])

    def gradient(slopes, limit):
        def loss(worlds):
            return jnp.sum(slopes * limit_gradient(worlds, limit)["x"])

        return np.asarray(jax.jit(jax.grad(loss, allow_int=True))(worlds)["x"])

    expected = np.array(slopes)
    expected[3:] *= np.array([[12 / 100], [12 / 50]])  # four times the median, that of the third world
    np.testing.assert_allclose(gradient(slopes, 4.0), expected, rtol=1e-6)
    np.testing.assert_array_equal(gradient(slopes, 100.0), slopes)
    np.testing.assert_array_equal(gradient(jnp.zeros((5, 3)), 4.0), np.zeros((5, 3)))
    broken = gradient(slopes.at[3, 0].set(jnp.inf), 4.0)
    assert np.all(broken[3] == 0) and np.all(broken[:3] == slopes[:3])


def test_worlds_without_a_gradient_do_not_count_for_the_limit_of_the_others():
    """One world with NaN lifted the limit, and half of the worlds at their ends made it zero."""
    slopes = jnp.array([[1, 1, 2, 100, jnp.nan], [0, 0, 0, 1, 100], [0, 0, 0, 0, 0], [jnp.inf, 0, 3, 0, 0]])
    limited = jax.jit(jax.vmap(jax.grad(lambda x, slopes: jnp.sum(slopes * limit_gradient(x, 10.0))), (None, 0)))
    expected = [[1, 1, 2, 15, 0], [0, 0, 0, 1, 100], [0, 0, 0, 0, 0], [0, 0, 3, 0, 0]]
    np.testing.assert_allclose(limited(jnp.zeros(5), slopes), expected, rtol=1e-6)
