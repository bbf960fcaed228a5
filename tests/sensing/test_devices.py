"""IMU, motion capture, barometer and magnetometer measure what they stand for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sensing.estimates import along, few, flights

import jaxdrones as jd
from jaxdrones.sensing import EUROPE, PERFECT, MotionCaptureSystem, Noise, barometer, imu, magnetometer, motion_capture
from jaxdrones.sensing.inertial import mean_motion

KEY = jax.random.key(1)


@pytest.fixture(scope="module")
def flown():
    with jax.enable_x64(True):
        return few(flights(100, 100, 4), 2, 100)


def each(function, *arrays):
    return jax.vmap(jax.vmap(function))(*arrays)


@pytest.mark.slow
def test_an_imu_feels_thrust_and_drag_and_the_turn_at_its_place(flown):
    params, states, rates = flown
    _, read = along(imu(PERFECT), params, states, rates, KEY)
    gravity = jnp.array([0, 0, float(params.gravity[0])])
    force = each(jd.rotation.rotate_inverse, states.quat, rates.vel + gravity[None, None])
    np.testing.assert_allclose(read["acc"], force, atol=1e-12)
    np.testing.assert_allclose(read["gyro"], states.omega)
    offset = np.array([0.02, -0.01, 0.03])
    _, away = along(imu(PERFECT, offset=tuple(offset)), params, states, rates, KEY)
    omega, turn = np.asarray(states.omega), np.asarray(rates.omega)
    expected = np.cross(turn, offset) + np.cross(omega, np.cross(omega, offset))
    np.testing.assert_allclose(away["acc"] - read["acc"], expected, atol=1e-9)


@pytest.mark.slow
def test_means_over_a_step_lead_from_one_state_to_the_next(flown):
    params, states, _ = flown
    one, before, after = (jax.tree.map(lambda x, k=k: x[k, 0], states) for k in (60, 60, 61))
    mean = mean_motion(jax.tree.map(lambda x: x[0], params), before.quat, before.vel, after, 0.01)
    turned = jd.rotation.multiply(one.quat, jd.rotation.exp(mean["gyro"] * 0.01))
    np.testing.assert_allclose(abs(turned @ after.quat), 1, atol=1e-12)
    middle = jd.rotation.multiply(one.quat, jd.rotation.exp(mean["gyro"] * 0.005))
    gained = jd.rotation.rotate(middle, mean["acc"]) * 0.01 - jnp.array([0, 0, float(params.gravity[0])]) * 0.01
    np.testing.assert_allclose(one.vel + gained, after.vel, atol=1e-12)


@pytest.mark.parametrize(("delay", "samples"), [(0.0, 0), (0.03, 3), (0.025, 2.5)])
@pytest.mark.slow
def test_poses_are_as_old_as_the_delay(flown, delay, samples):
    params, states, rates = flown
    _, read = along(motion_capture(MotionCaptureSystem(delay=delay)), params, states, rates, KEY)
    late, early = int(np.ceil(samples)), int(samples)
    pos = np.asarray(states.pos)
    old = (pos[3 - late : -late or None][:90] + pos[3 - early : -early or None][:90]) / 2
    np.testing.assert_allclose(read["pos"][3:93], old, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(read["quat"], axis=-1), 1)


@pytest.mark.slow
def test_poses_are_missing_and_noisy_as_often_as_asked():
    params = jd.repeat(jd.load_params("cf2x"), 50)
    states = jax.tree.map(lambda x: jnp.tile(x[None], (100, 1, 1)), jd.State.at_rest(jnp.ones((50, 3))))
    rates = jax.tree.map(jnp.zeros_like, states)
    system = MotionCaptureSystem(dropout=0.3, pos_noise=0.01, angle_noise=0.02)
    _, read = along(motion_capture(system), params, states, rates, KEY)
    fresh = np.asarray(read["fresh"])
    np.testing.assert_allclose(fresh[1:].mean(), 0.7, atol=0.02)
    assert fresh[0].all()
    lost = ~fresh[1:]
    np.testing.assert_array_equal(np.asarray(read["pos"])[1:][lost], np.asarray(read["pos"])[:-1][lost])
    np.testing.assert_allclose(np.std((read["pos"] - states.pos)[fresh]), 0.01, rtol=0.03)
    turn = each(
        lambda a, b: jd.rotation.log(jd.rotation.multiply(jd.rotation.conjugate(a), b)), states.quat, read["quat"]
    )
    np.testing.assert_allclose(np.std(turn[fresh]), 0.02, rtol=0.03)


@pytest.mark.slow
def test_height_and_magnetic_field_are_those_of_the_pose(flown):
    params, states, rates = flown
    np.testing.assert_allclose(along(barometer(Noise()), params, states, rates, KEY)[1], states.pos[..., 2:])
    _, read = along(magnetometer(Noise()), params, states, rates, KEY)
    np.testing.assert_allclose(
        each(jd.rotation.rotate, states.quat, read), np.broadcast_to(EUROPE, read.shape), atol=1e-9
    )
