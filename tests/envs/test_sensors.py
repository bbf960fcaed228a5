"""Models, effects on a team, sensors and scenes in an environment, on both backends."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close

import jaxdrones as jd
from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.fitting import fits_a_kernel
from jaxdrones.dynamics.model import Model
from jaxdrones.envs import AutoReset, check_env, make
from jaxdrones.envs.observations import reading
from jaxdrones.sensing.sensor import Sensor

KEY = jax.random.key(5)
ZERO = jnp.zeros((1, 4))
BACKENDS = ["explicit", pytest.param("bullet", marks=pytest.mark.needs("pybullet"))]


def specific_force(key, params, state, rate, scene, memory):
    """An accelerometer with a constant bias, in body axes; counts its measurements."""
    bias, count = memory
    force = jd.rotation.rotate_inverse(state.quat, rate.vel + jd.vector.along_z(params.gravity))
    return (bias, count + 1), {"force": force + bias, "count": count}


def bias_and_count(key, params):
    return 0.1 * jax.random.normal(key, (3,), params.mass.dtype), jnp.zeros((), jnp.int32)


IMU = Sensor("imu", specific_force, bias_and_count, bound=50.0)
NOISY = Sensor("noisy", lambda key, params, state, rate, scene, memory: (None, jax.random.normal(key)))


def battery():
    """A charge that is used up as the rotors turn, from 1 on."""
    return Model(
        "charge",
        lambda params: jnp.ones_like(params.mass),
        lambda params, state, command: -jnp.mean(state.rpm) / params.max_rpm,
    )


@pytest.mark.parametrize("rate", [101.0, 1000.0])
def test_a_rate_above_the_control_rate_is_refused(rate):
    """Also of a sensor that replaces those of an environment."""
    fast, made = dataclasses.replace(NOISY, rate=rate), make("hover")
    for with_sensors in functools.partial(make, "hover"), functools.partial(dataclasses.replace, made):
        with pytest.raises(ValueError, match=rf"'noisy' measures at {rate:g} Hz; give at most the control rate, 100"):
            with_sensors(sensors=(fast,))


@pytest.mark.parametrize("rate", [None, 100.0, 100 * (1 + 1e-7)])
def test_a_sensor_may_measure_in_every_control_step(rate):
    assert make("hover", sensors=(dataclasses.replace(NOISY, rate=rate),)).sensors[0].rate == rate


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
def test_an_environment_with_sensors_and_models_keeps_the_contract(backend):
    with make(
        "hover",
        backend=backend,
        drones=2,
        models=(battery(),),
        sensors=(IMU, NOISY),
        observation=("position_error", "imu", reading("noisy", 9.0)),
    ) as env:
        assert env.observation_size == 3 + 4 + 1
        np.testing.assert_array_equal(env.observation_bound[3:], [50] * 4 + [9])
        check_env(env, steps=2)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.slow
def test_an_accelerometer_in_free_flight_feels_the_thrust(backend):
    """Under gravity and rotors that hover the specific force is the thrust: along body z, as large as gravity."""
    with make("hover", backend=backend, sensors=(IMU,)) as env:
        _, world = env.reset(KEY)
        for count in range(3):
            assert world.readings["imu"]["count"] == count
            bias = world.sensors["imu"][0]
            expected = jnp.array([[0, 0, 1]]) * world.params.gravity[:, None] + bias
            np.testing.assert_allclose(
                world.readings["imu"]["force"], expected, atol=1e-6 if backend == "explicit" else 1e-3
            )
            _, world, *_ = env.step(KEY, world, ZERO)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.slow
def test_a_model_starts_anew_in_every_episode_and_is_integrated_in_between(backend):
    with make("hover", backend=backend, models=(battery(),), duration=0.05) as env:
        auto = AutoReset(env)
        _, episode = auto.reset(KEY)
        charges = [float(episode.world.drones.aux["charge"][0])]
        for k in range(5):
            _, episode, *_ = auto.step(jax.random.fold_in(KEY, k), episode, ZERO)
            charges.append(float(episode.world.drones.aux["charge"][0]))
        share = float(env.params.hover_rpm[0] / env.params.max_rpm[0])
        np.testing.assert_allclose(charges, [1 - 0.01 * share * k for k in range(5)] + [1], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_team_effect_acts_on_the_chosen_drones(backend):
    def pull_together(params, state):
        """A spring of 0.01 N/m between drones 0 and 1."""
        pull = 0.01 * (state.pos[1] - state.pos[0])
        force = jnp.zeros_like(state.pos).at[0].set(pull).at[1].set(-pull)
        return jd.Wrench(jax.vmap(jd.rotation.rotate_inverse)(state.quat, force), jnp.zeros_like(force))

    options = dict(drones=3, tilt=0.0, speed=0.0, omega=0.0, backend=backend)
    with make("hover", **options) as plain, make("hover", **options, team_effects=(pull_together,)) as pulled:
        zero = jnp.zeros((3, 4))
        _, world = plain.reset(KEY)
        change = pulled.step(KEY, world, zero)[1].drones.vel - plain.step(KEY, world, zero)[1].drones.vel
    expected = 0.01 * (world.drones.pos[1] - world.drones.pos[0]) / world.params.mass[0] * plain.dt
    np.testing.assert_allclose(change, [expected, -expected, np.zeros(3)], rtol=0.02, atol=1e-6)


@pytest.mark.slow
def test_noise_of_a_sensor_has_a_random_stream_of_its_own_in_every_step():
    env = make("hover", sensors=(NOISY,))
    _, world = env.reset(KEY)
    readings = [float(world.readings["noisy"][0])]
    for k in range(3):
        _, world, *_ = env.step(jax.random.fold_in(KEY, k), world, ZERO)
        readings.append(float(world.readings["noisy"][0]))
    assert len(set(readings)) == 4


@pytest.mark.slow
def test_readings_after_autoreset_are_those_of_the_new_episode():
    auto = AutoReset(make("hover", sensors=(IMU,), duration=0.01))
    _, episode = auto.reset(KEY)
    _, episode, *_, info = auto.step(KEY, episode, ZERO)
    assert info["final_world"].readings["imu"]["count"] == 1 and episode.world.readings["imu"]["count"] == 0


def test_an_unknown_reading_is_named():
    with pytest.raises(ValueError, match="unknown observation 'imi'; did you mean 'imu'"):
        make("hover", sensors=(IMU,), observation=("imi",))


def test_a_sensor_with_the_name_of_an_observation_term_is_refused():
    with pytest.raises(ValueError, match="a sensor is named 'position', like an observation term; give it another"):
        make("hover", sensors=(dataclasses.replace(IMU, name="position"),))


@pytest.mark.slow
def test_without_models_sensors_and_obstacles_a_world_has_nothing_more_and_a_step_is_one_kernel():
    env = make("hover")
    _, world = env.reset(KEY)
    assert not jax.tree.leaves((world.scene, world.sensors, world.readings, world.drones.aux))
    assert all(leaf.size for leaf in jax.tree.leaves(world))
    program = compiler.trace(lambda world, action: env.step(KEY, world, action)[:5], world, ZERO)[0]
    assert fits_a_kernel(program)
    worlds = jax.vmap(env.reset)(jax.random.split(KEY, 3))[1]

    def fly(world, action):
        return env.step(KEY, world, action)[1].drones

    actions = jnp.zeros((3, 1, 4))
    assert_close(jax.jit(jd.over_worlds(fly))(worlds, actions), jax.jit(jax.vmap(fly))(worlds, actions), 1e-9)
