"""The state estimate errs as much as it says, on the IMU and the poses that it is given."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_finite
from scipy.stats import chi2
from sensing.estimates import along, errors, few, flights, normalized

import jaxdrones as jd
from jaxdrones.control import geometric
from jaxdrones.control.setpoint import Setpoint
from jaxdrones.sensing import (
    BMI088,
    EUROPE,
    MPU9250,
    PERFECT,
    VICON,
    ImuPart,
    MotionCaptureSystem,
    Noise,
    Scene,
    barometer,
    imu,
    kalman,
    magnetometer,
    motion_capture,
    state_estimate,
)
from jaxdrones.sensing.estimator import imu_noise

KEY = jax.random.key(5)
N = 100
CALM = ImuPart(acc=dataclasses.replace(BMI088.acc, turn_on=0.02), gyro=dataclasses.replace(BMI088.gyro, turn_on=1e-3))


@pytest.fixture(scope="module")
def flown():
    with jax.enable_x64(True):
        return flights(N, 100, 4)


def assert_chi_square(square, dimensions):
    """The mean of the flights is within the 95 % band at most instants; neighboring ones are not independent."""
    low, high = chi2.ppf([0.025, 0.975], dimensions * N) / N
    mean = square.mean(axis=1)
    assert np.mean((mean > low) & (mean < high)) > 0.8, f"{low:.2f} to {high:.2f}: {mean}"
    assert low < mean.mean() < high


@pytest.mark.slow
def test_errors_normalized_by_their_covariance_are_chi_square(flown):
    params, states, rates = flown
    memories, _ = along(state_estimate(), params, states, rates, KEY)
    error, cov = errors(memories, states, late=1)
    assert_chi_square(normalized(error, cov), 15)
    low, high = chi2.ppf([0.001, 0.999], 3 * N) / N
    for part in kalman.POS, kalman.VEL, kalman.ANGLE, kalman.GYRO_BIAS, kalman.ACC_BIAS:
        assert low < normalized(error[..., part], cov[..., part, part]).mean() < high


@pytest.mark.slow
@pytest.mark.parametrize("lag", [False, True])
@pytest.mark.parametrize(
    ("part", "system", "hz", "attitude"),
    [
        (MPU9250, dataclasses.replace(VICON, delay=0.02, dropout=0.3), 500, True),
        (BMI088, MotionCaptureSystem(rate=20.0, pos_noise=0.002, angle_noise=0.02), 100, True),
        (CALM, MotionCaptureSystem(rate=100.0, pos_noise=0.001), 100, False),
    ],
)
def test_they_are_with_other_parts_lags_gaps_and_without_attitude(part, system, hz, attitude, lag):
    params, states, rates = flights(N, 500, 6, lag=lag)
    states, rates = jax.tree.map(lambda x: x[:: 500 // hz], (states, rates))
    memories, _ = along(state_estimate(part, system, hz, attitude=attitude), params, states, rates, KEY)
    error, cov = errors(memories, states, late=round(system.delay * hz))
    assert_chi_square(normalized(error, cov), 15)


@pytest.mark.slow
def test_a_reading_is_the_present_state_in_spite_of_the_delay(flown):
    """Without noise to speak of the reading is the truth, also where poses are 50 ms old; the drones fly at 1 m/s."""
    params, states, rates = few(flown, 2)
    exact = MotionCaptureSystem(rate=50.0, delay=0.05, pos_noise=1e-5, angle_noise=1e-5)
    sensor = state_estimate(PERFECT, exact, start=(1e-5, 1e-5, 1e-5))
    _, read = along(sensor, params, states, rates, KEY)
    np.testing.assert_allclose(read.pos, states.pos, atol=1e-3)
    np.testing.assert_allclose(read.vel, states.vel, atol=1e-3)
    angle = jax.vmap(jax.vmap(kalman.angle))(read.quat, states.quat)
    np.testing.assert_allclose(angle, 0, atol=1e-4)
    np.testing.assert_allclose(read.omega, states.omega, atol=1e-3)
    np.testing.assert_array_equal(read.rpm, states.rpm)
    assert np.linalg.norm(states.vel, axis=-1).mean() > 0.5


@pytest.mark.slow
def test_a_controller_flies_on_the_estimate():
    """A hover of 3 s by what the sensor reads: the drone stays within a centimeter, as far as its estimate errs."""
    params, step = jd.load_params("cf2x"), jd.make_step(effects=(jd.drag,), dt=0.01)
    sensor, gains, here = state_estimate(), geometric.gains(), jnp.array([0.0, 0, 1])
    start = jax.tree.map(lambda x: x[0], jd.State.at_rest(here[None]))

    def control(carry, key):
        state, rate, memory = carry
        memory, seen = sensor.measure(key, params, state, rate, Scene(), memory)
        rpm = geometric.control(gains, params, None, seen, Setpoint.at(here), dt=0.01)[1]
        team = [jax.tree.map(lambda x: x[None], tree) for tree in (params, state, rpm)]
        after = step(*team)
        rate = step.rate(team[0], after, team[2])
        state, rate = (jax.tree.map(lambda x: x[0], tree) for tree in (after, rate))
        return (state, rate, memory), (state.pos, seen.pos)

    begun = start, jax.tree.map(jnp.zeros_like, start), sensor.init(KEY, params)
    pos, seen = jax.jit(lambda c: jax.lax.scan(control, c, jax.random.split(KEY, 300))[1])(begun)
    np.testing.assert_allclose(pos[100:], np.broadcast_to(here, (200, 3)), atol=0.01)
    assert 0 < np.abs(pos - seen).max() < 0.05


@pytest.mark.slow
def test_the_barometer_and_the_magnetic_field_correct_height_and_heading():
    quat = jd.rotation.from_rpy(jnp.array([0.1, -0.2, 0.3]))
    wrong = jd.rotation.multiply(quat, jd.rotation.exp(jnp.array([0.02, 0.03, -0.05])))
    estimate = kalman.init(jnp.array([0, 0, 1.0]), jnp.zeros(3), wrong, jnp.repeat(jnp.array([0.5] * 5), 3))
    field = jnp.array(EUROPE)
    after = kalman.update_height(estimate, jnp.array(1.3), 1e-3)
    np.testing.assert_allclose(after.pos, [0, 0, 1.3], atol=1e-4)
    for _ in range(3):
        after = kalman.update_direction(after, jd.rotation.rotate_inverse(quat, field), field, 0.01)
        after = kalman.update_direction(after, jd.rotation.rotate_inverse(quat, field[::-1]), field[::-1], 0.01)
    np.testing.assert_allclose(kalman.angle(after.quat, quat), 0, atol=1e-3)  # half the square of 0.06 rad
    assert np.all(np.linalg.eigvalsh(after.cov) > 0)


@pytest.mark.slow
def test_a_point_away_from_the_imu_is_measured_where_it_is():
    """The estimate is at the truth already, and a measurement of the point leaves it there."""
    quat = jd.rotation.from_rpy(jnp.array([0.4, -0.2, 0.3]))
    estimate = kalman.init(jnp.zeros(3), jnp.zeros(3), quat, jnp.full(15, 0.1))
    offset = jnp.array([0.01, 0.02, 0.05])
    after = kalman.update_position(estimate, jd.rotation.rotate(quat, offset), 0.01, offset)
    np.testing.assert_allclose(after.pos, 0, atol=1e-12)
    tipped = estimate.replace(quat=jd.rotation.multiply(quat, jd.rotation.exp(jnp.array([1e-6, 2e-6, 0.0]))))
    found = kalman.update_position(tipped, jd.rotation.rotate(quat, offset), 0.01, offset)
    linear = kalman.error(tipped, jnp.zeros(3), jnp.zeros(3), quat, jnp.zeros(3), jnp.zeros(3))
    seen = -jd.rotation.to_matrix(quat) @ jnp.cross(offset, linear[kalman.ANGLE])
    np.testing.assert_allclose(
        jd.rotation.rotate(quat, offset) - jd.rotation.rotate(tipped.quat, offset), seen, atol=1e-12
    )
    assert np.abs(found.pos).max() < 1e-6


@pytest.mark.slow
def test_prediction_has_the_jacobian_of_its_own_motion():
    """The covariance is moved by the derivative of the motion with respect to the error."""
    rng = np.random.default_rng(0)
    pos, vel, gyro, acc = (jnp.array(rng.normal(size=3)) * scale for scale in (1, 2, 3, 9))
    quat = jd.rotation.from_rpy(jnp.array([0.4, -0.7, 1.0]))
    gravity, dt = jnp.array(9.8), 0.01
    silent = imu_noise(PERFECT)
    start = kalman.init(pos, vel, quat, jnp.ones(15))

    def ends(error):
        begun = start.replace(
            pos=pos + error[kalman.POS],
            vel=vel + error[kalman.VEL],
            quat=jd.rotation.multiply(quat, jd.rotation.exp(error[kalman.ANGLE])),
            gyro_bias=error[kalman.GYRO_BIAS],
            acc_bias=error[kalman.ACC_BIAS],
        )
        end = kalman.move(begun, gyro, acc, gravity, dt)
        ref = kalman.move(start, gyro, acc, gravity, dt)
        return kalman.error(ref, end.pos, end.vel, end.quat, end.gyro_bias, end.acc_bias)

    jacobian = jax.jit(jax.jacfwd(ends))(jnp.zeros(15))
    moved = jax.jit(kalman.predict)(silent, start, gyro, acc, gravity, dt)
    np.testing.assert_allclose(moved.cov, jacobian @ jacobian.T, atol=2e-4)  # series to the second order of dt w


@pytest.mark.slow
@pytest.mark.float32
def test_environments_carry_all_of_them_and_policies_see_them():
    sensors = (imu(), motion_capture(), barometer(), magnetometer(), state_estimate())
    env = jd.make("hover", sensors=sensors, observation=("position_error", "state_estimate", "barometer"))
    assert env.observation_size == 3 + 17 + 1
    obs, world = env.reset(KEY)

    @jax.jit
    def fly(world):
        return jax.lax.scan(
            lambda w, k: (env.step(k, w, jnp.zeros((1, 4)))[1], None), world, jax.random.split(KEY, 50)
        )[0]

    world = fly(world)
    read = world.readings["state_estimate"]
    assert isinstance(read, jd.State) and read.pos.dtype == jnp.float32
    np.testing.assert_allclose(read.pos, world.drones.pos, atol=0.005)
    np.testing.assert_allclose(read.vel, world.drones.vel, atol=0.1)
    assert_finite((obs, world.readings, world.sensors))
    np.testing.assert_allclose(world.readings["magnetometer"][0], EUROPE, atol=60)


@pytest.mark.slow
def test_an_estimate_has_a_gradient_through_the_flight(flown):
    params, states, rates = few(flown, 1, 20)
    sensor = state_estimate()

    def last(shift):
        moved = states.replace(pos=states.pos + shift)
        return jnp.sum(along(sensor, params, moved, rates, KEY)[1].pos[-1])

    slope = jax.grad(last)(0.0)
    np.testing.assert_allclose(slope, 3, rtol=1e-6)  # all poses are shifted, in three coordinates


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: state_estimate(rate=250.0), r"rate of the poses of state_estimate is 100 Hz, 2.5 periods of the IMU"),
        (lambda: state_estimate(rate=50.0), "rate of the poses of state_estimate is 100 Hz, 0.5 periods"),
        (lambda: state_estimate(system=dataclasses.replace(VICON, delay=0.015)), "delay of the poses .* 1.5 periods"),
        (lambda: state_estimate(system=MotionCaptureSystem()), "pos_noise of state_estimate is 0.0; give a positive"),
        (lambda: state_estimate("bmi088"), "part of an IMU is 'bmi088'; give jaxdrones.sensing.BMI088"),
        (lambda: state_estimate(start=0.1), "start of state_estimate is 0.1; give deviations"),
        (lambda: motion_capture("vicon"), "system of motion_capture is 'vicon'"),
        (lambda: MotionCaptureSystem(dropout=2), "dropout of a motion capture is 2"),
        (lambda: barometer(errors=0.1), "errors of barometer is 0.1; give jaxdrones.sensing.Noise"),
        (lambda: magnetometer(field=3.0), "field of magnetometer is 3.0; give 3 numbers"),
        (lambda: barometer(Noise(), rate=0), "rate of barometer is 0"),
        (lambda: imu(offset=(0, 0)), r"offset of imu is \(0, 0\); give 3 numbers"),
        (
            lambda: jd.make("hover", sensors=(imu(rate=500.0),)),
            "sensor 'imu' measures at 500 Hz, which does not divide",
        ),
        (lambda: jd.make("hover", sensors=(imu(rate=30.0),)), "30 Hz, which does not divide the 100 Hz of the control"),
        (lambda: jd.Sensor("x", imu().measure, clocked=True), "sensor 'x' is clocked, but has no rate"),
    ],
)
def test_nonsense_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
