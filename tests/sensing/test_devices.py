"""IMU, motion capture, barometer and magnetometer measure what they stand for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized, mostly_slow, mostly_slow_rows
from sensing.estimates import along, few, flights

import jaxdrones as jd
from jaxdrones.dynamics.rigid_body import quat_rate
from jaxdrones.sensing import (
    EUROPE,
    PERFECT,
    ImuPart,
    MotionCaptureSystem,
    Noise,
    barometer,
    downward_range,
    imu,
    magnetometer,
    motion_capture,
)
from jaxdrones.sensing.inertial import mean_motion, motion

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


def random_state(seed):
    """State of one drone, any attitude, and a time derivative of it."""
    rng = np.random.default_rng(seed)
    quat, vel, omega, acc, omega_rate = (jnp.asarray(rng.normal(size=n)) for n in (4, 3, 3, 3, 3))
    state = jd.State(jnp.zeros(3), jd.rotation.normalize(quat), vel, 3 * omega, jnp.zeros(4))
    rate = jax.tree.map(jnp.zeros_like, state).replace(vel=acc, omega=5 * omega_rate, quat=quat_rate(state))
    return state, rate


def test_an_imu_off_the_center_feels_the_acceleration_of_its_place():
    params, (state, rate), offset = jd.load_params("cf2x"), random_state(2), jnp.array([0.02, -0.01, 0.03])

    def velocity_there(state):
        return state.vel + jd.rotation.rotate(state.quat, jd.vector.cross(state.omega, offset))

    _, acc = jax.jvp(velocity_there, (state,), (rate,))
    felt = jd.rotation.rotate_inverse(state.quat, acc + jd.vector.along_z(params.gravity))
    np.testing.assert_allclose(motion(params, state, rate, offset)["acc"], felt, rtol=1e-12)


def test_the_mean_acceleration_of_a_step_is_in_the_axes_of_its_middle():
    params, (state, _), turn = jd.load_params("cf2x"), random_state(3), jnp.array([0.4, -0.2, 0.3])
    force, dt = jnp.array([1.0, -2.0, 9.0]), 0.1
    middle = jd.rotation.multiply(state.quat, jd.rotation.exp(turn / 2))
    gained = (jd.rotation.rotate(middle, force) - jd.vector.along_z(params.gravity)) * dt
    after = state.replace(quat=jd.rotation.multiply(state.quat, jd.rotation.exp(turn)), vel=state.vel + gained)
    mean = mean_motion(params, state.quat, state.vel, after, dt)
    np.testing.assert_allclose(mean["acc"], force, rtol=1e-12)
    np.testing.assert_allclose(mean["gyro"], turn / dt, rtol=1e-12)


@pytest.mark.parametrize("delay", mostly_slow([0.0, 0.004, 0.0125, 0.03], [0.004, 0.0125]))
def test_a_pose_of_a_steady_motion_is_as_old_as_the_delay(delay):
    sensor, params = motion_capture(MotionCaptureSystem(delay=delay)), jd.load_params("cf2x")
    rate = jax.tree.map(lambda x: x[0], jd.State.at_rest(jnp.zeros((1, 3))))
    memory, vel, measure = sensor.init(KEY, params), np.array([1.0, -2.0, 0.5]), jit_unoptimized(sensor.measure)
    for k in range(7):  # of quaternions whose sign changes at every measurement
        state = rate.replace(pos=0.01 * k * vel, quat=(-1) ** k * jd.rotation.exp(0.01 * k * vel))
        memory, read = measure(KEY, params, state, rate, jd.Scene(), memory)
    np.testing.assert_allclose(read["pos"], (0.06 - delay) * vel, rtol=1e-12)
    np.testing.assert_allclose(read["quat"] @ read["quat"], 1, rtol=1e-12)
    np.testing.assert_allclose(jd.rotation.log(read["quat"]), (0.06 - delay) * vel, rtol=1e-6)


def test_the_first_pose_arrives_also_where_all_are_lost():
    sensor, params, (state, rate) = (
        motion_capture(MotionCaptureSystem(dropout=1.0)),
        jd.load_params("cf2x"),
        random_state(5),
    )
    memory, read = sensor.measure(KEY, params, state, rate, jd.Scene(), sensor.init(KEY, params))
    assert read["fresh"] and np.allclose(read["quat"], state.quat, rtol=1e-12)
    moved = state.replace(pos=state.pos + 1)
    _, again = sensor.measure(KEY, params, moved, rate, jd.Scene(), memory)
    assert not again["fresh"] and np.array_equal(again["pos"], read["pos"])


@pytest.mark.parametrize(
    "device",
    [lambda e, rate: imu(ImuPart(e, e), rate), barometer, lambda e, rate: magnetometer(e, rate=rate)],
    ids=["imu", "barometer", "magnetometer"],
)
def test_the_bias_of_a_device_walks_with_the_root_of_its_period(device):
    params, (state, rate) = jd.load_params("cf2x"), random_state(6)
    slow, fast = (device(Noise(random_walk=1.0), rate) for rate in (25.0, 100.0))
    walked = [s.measure(KEY, params, state, rate, jd.Scene(), s.init(KEY, params))[0] for s in (slow, fast)]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, 2 * b, rtol=1e-12), *walked)


def test_no_reading_of_an_imu_exceeds_its_bound():
    sensor, params, (state, rate) = imu(), jd.load_params("cf2x"), random_state(7)
    state, rate = (s.replace(vel=1e4 * s.vel, omega=1e4 * s.omega) for s in (state, rate))
    _, read = sensor.measure(KEY, params, state, rate, jd.Scene(), sensor.init(KEY, params))
    assert max(np.abs(x).max() for x in read.values()) == sensor.bound


def test_the_field_that_a_magnetometer_feels_is_that_of_the_world_in_body_axes():
    sensor, params, (state, rate) = magnetometer(Noise()), jd.load_params("cf2x"), random_state(4)
    _, read = sensor.measure(KEY, params, state, rate, jd.Scene(), sensor.init(KEY, params))
    np.testing.assert_allclose(jd.rotation.rotate(state.quat, read), EUROPE, rtol=1e-12, atol=1e-12)


def test_a_barometer_without_errors_reads_the_height():
    sensor, params, (state, rate) = barometer(Noise()), jd.load_params("cf2x"), random_state(4)
    state = state.replace(pos=jnp.array([1.0, 2.0, 3.0]))
    _, read = sensor.measure(KEY, params, state, rate, jd.Scene(), sensor.init(KEY, params))
    assert read.tolist() == [3.0]


@pytest.mark.parametrize(
    ("delay", "age"), mostly_slow_rows([(0.0, 0.0), (0.03, 3.0), (0.025, 2.5)], [(0.0, 0.0), (0.025, 2.5)])
)
def test_a_pose_is_as_old_as_the_delay(delay, age):
    sensor = motion_capture(MotionCaptureSystem(rate=100.0, delay=delay))
    params, measure = jd.load_params("cf2x"), jit_unoptimized(sensor.measure)
    memory = sensor.init(KEY, params)
    for k in range(6):
        state = jax.tree.map(lambda x: x[0], jd.State.at_rest(jnp.array([[1.0 * k, 0, 1]])))
        memory, pose = measure(KEY, params, state, state, None, memory)
    np.testing.assert_allclose(pose["pos"][0], 5 - age, atol=1e-9)


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


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: imu(offset=(0, np.nan, 0)), "offset of an imu is not finite"),
        (lambda: imu(offset=(1, 2)), r"offset of an imu has shape \(2,\); expected \(3,\)"),
        (lambda: magnetometer(field=(np.nan, 0, 0)), "field of a magnetometer is not finite"),
        (lambda: magnetometer(field=(1, 2)), r"field of a magnetometer has shape \(2,\)"),
        (lambda: downward_range(offset=(np.nan, 0, 0)), "offset of a range finder is not finite"),
        (lambda: jd.Camera(principal_point=(np.nan, 0)), "principal_point of a camera is .*nan.*; give 2 numbers"),
        (lambda: jd.Camera(offset=(np.inf, 0, 0)), "offset of a camera is .*inf.*; give 3 numbers"),
    ],
)
def test_places_and_fields_that_are_none_are_refused(make, message):
    """With them readings were NaN, and ranges and depths zero or empty."""
    with pytest.raises(ValueError, match=message):
        make()
