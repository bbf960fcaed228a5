"""The state estimate errs as much as it says, on the IMU and the poses that it is given."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_finite, jit_unoptimized
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
from jaxdrones.sensing.estimator import imu_noise, seen

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
    pos, seen = jit_unoptimized(lambda c: jax.lax.scan(control, c, jax.random.split(KEY, 300))[1])(begun)
    np.testing.assert_allclose(pos[100:], np.broadcast_to(here, (200, 3)), atol=0.01)
    assert 0 < np.abs(pos - seen).max() < 0.05


def tilted(deviation=0.1):
    """An estimate of a drone in flight."""
    pos, vel = jnp.array([1.0, -2, 3]), jnp.array([2.0, 1, -1])
    return kalman.init(pos, vel, jd.rotation.from_rpy(jnp.array([0.4, -0.7, 1.0])), jnp.full(15, deviation))


def shifted(estimate, error):
    """The estimate if it had this error less."""
    return estimate.replace(
        pos=estimate.pos + error[kalman.POS],
        vel=estimate.vel + error[kalman.VEL],
        quat=jd.rotation.multiply(estimate.quat, jd.rotation.exp(error[kalman.ANGLE])),
        gyro_bias=estimate.gyro_bias + error[kalman.GYRO_BIAS],
        acc_bias=estimate.acc_bias + error[kalman.ACC_BIAS],
    )


def difference(a, b):
    return kalman.error(a, b.pos, b.vel, b.quat, b.gyro_bias, b.acc_bias)


PARTS = kalman.POS, kalman.VEL, kalman.ANGLE, kalman.GYRO_BIAS, kalman.ACC_BIAS


def test_prediction_has_the_jacobian_of_its_own_motion_in_every_block():
    """The covariance is moved by the derivative of the motion; of a certain error alone, by one of its columns."""
    start, dt = tilted(), 1e-3
    gyro, acc, gravity = jnp.array([3.0, -2, 1]), jnp.array([4.0, 5, 9]), jnp.array(9.8)

    @jit_unoptimized
    def both(start):
        end = kalman.move(start, gyro, acc, gravity, dt)
        exact = jax.jacfwd(lambda e: difference(end, kalman.move(shifted(start, e), gyro, acc, gravity, dt)))
        units = jax.vmap(lambda e: start.replace(cov=jnp.outer(e, e)))(jnp.eye(15))
        covs = jax.vmap(lambda one: kalman.predict(imu_noise(PERFECT), one, gyro, acc, gravity, dt).cov)(units)
        return exact(jnp.zeros(15)), covs

    exact, covs = map(np.asarray, both(start))
    diagonal = np.einsum("kkk->k", covs)
    assert np.all(diagonal > 0.9)
    found = np.einsum("kik->ik", covs) / np.sqrt(diagonal)  # each column times its own entry of the diagonal
    half_turn = dt * np.linalg.norm(gyro) / 2  # what the column of the gyroscope's bias neglects; the others are exact
    for row in PARTS:
        for column in PARTS:
            block, share = exact[row, column], half_turn if column == kalman.GYRO_BIAS else 1e-9
            np.testing.assert_allclose(found[row, column], block, rtol=0, atol=share * np.abs(block).max() + 1e-15)


def test_an_imu_adds_its_densities_times_the_step_to_the_covariance_of_what_they_drive():
    noise = kalman.ImuNoise(*map(jnp.array, (0.1, 0.2, 0.3, 0.4)))
    zero = jnp.zeros(3)
    cov = kalman.predict(noise, tilted(0.0), zero, zero, jnp.array(9.8), 0.01).cov
    np.testing.assert_allclose(cov, np.diag(np.repeat([0, 0.2, 0.1, 0.3, 0.4], 3) ** 2 * 0.01), atol=1e-15)
    noise = Noise(random_walk=0.3, instability=0.2, correlation=1.0)
    assert imu_noise(ImuPart(acc=noise, gyro=Noise())).acc_walk == noise.bias_walk > 0.3


@pytest.mark.slow
def test_the_estimate_is_that_of_now_and_its_covariance_that_of_the_poses_which_arrived():
    """An IMU almost without noise and poses of every second period, two periods old; half of them are lost."""
    imu = Noise(density=1e-8, limit=35.0)
    system = MotionCaptureSystem(rate=50.0, delay=0.02, dropout=0.5, pos_noise=1e-12)
    sensor = state_estimate(ImuPart(imu, imu), system, attitude=False, start=(0.0, 0.0, 0.0))
    params, (acc, omega) = jd.load_params("cf2x"), jnp.array([[1.0, -2, 0.5], [0.5, 1, -0.3]])

    def at(t):
        quat = jd.rotation.multiply(jd.rotation.exp(jnp.array([0, 0, 2.0])), jd.rotation.exp(omega * t))
        return jd.State(acc * t**2 / 2, quat, acc * t, omega, jnp.zeros(4))

    def measure(memory, now):
        key, t = now
        memory, read = sensor.measure(key, params, at(t), at(t), Scene(), memory)
        oldest = memory.samples.fresh[0], memory.estimate.cov[0, 0]
        return memory, (difference_to(read, at(t)), *oldest)

    def difference_to(read, true):
        return jnp.stack(
            [read.pos - true.pos, read.vel - true.vel, kalman.angle(read.quat, true.quat), read.omega - omega]
        )

    run = jit_unoptimized(lambda keys, t: jax.lax.scan(measure, sensor.init(KEY, params), (keys, t))[1])
    error, fresh, cov = map(np.asarray, run(jax.random.split(KEY, 20), 0.01 * jnp.arange(20)))
    np.testing.assert_allclose(error, 0, atol=1e-5)
    fresh, cov = fresh[4:], cov[4:]  # those of instant 2, and so on
    assert not fresh[1::2].any() and 0 < fresh[::2].sum() < 8
    assert np.all(cov[fresh] < 1e-23) and np.all(cov[~fresh] > 1e-23)


def test_a_measurement_leaves_the_covariance_of_bayes_about_the_corrected_attitude():
    """The inverse covariances add, in the old body axes; the correction of 0.2 rad turns the axes of the new angle."""
    rng = np.random.default_rng(0)
    root, jacobian = rng.normal(size=(15, 15)), rng.normal(size=(4, 15))
    prior, noise = root @ root.T / 15, np.diag([0.1, 0.2, 0.3, 0.4])
    posterior = np.linalg.inv(np.linalg.inv(prior) + jacobian.T @ np.linalg.inv(noise) @ jacobian)
    gain = posterior @ jacobian.T @ np.linalg.inv(noise)
    residual = np.array([0.3, -0.2, 0.1, 0.2])
    residual *= 0.2 / np.linalg.norm((gain @ residual)[kalman.ANGLE])
    error = jnp.array(gain @ residual)

    @jit_unoptimized
    def both(estimate):
        after = kalman.update(estimate, jnp.array(residual), jnp.array(jacobian), jnp.array(noise))
        mean = shifted(estimate, error)
        return after, mean, jax.jacfwd(lambda e: difference(mean, shifted(estimate, error + e)))(jnp.zeros(15))

    after, mean, turn = both(tilted().replace(cov=jnp.array(prior)))
    np.testing.assert_allclose(difference(mean, after), 0, atol=1e-9)
    np.testing.assert_allclose(after.cov, turn @ posterior @ turn.T, atol=0.2**2 / 3 * np.abs(posterior).max())
    assert np.linalg.norm(turn[kalman.ANGLE, kalman.ANGLE] - np.eye(3)) > 0.1


def test_a_bias_that_is_known_is_taken_out_of_the_body_rates_and_one_that_is_not_stays_in():
    bias, omega = jnp.array([0.1, -0.2, 0.3]), jnp.array([1.0, 2, -1])
    state = jax.tree.map(lambda x: x[0], jd.State.at_rest(jnp.zeros((1, 3)))).replace(omega=omega)
    for known in bias, 0 * bias:
        now = tilted().replace(gyro_bias=known)
        read = seen(now, state, {"gyro": 0.9 * omega + bias}, {"gyro": 0.9 * omega})  # means over the period
        np.testing.assert_allclose(read.omega, omega + bias - known, rtol=1e-12)
        np.testing.assert_array_equal([*read.pos, *read.quat, *read.vel], [*now.pos, *now.quat, *now.vel])


POINT, FIELD = jnp.array([0.1, 0.2, -0.3]), jnp.array(EUROPE) / 20
MEASUREMENTS = {
    "position": lambda e, at, d: kalman.update_position(e, at.pos, d),
    "point": lambda e, at, d: kalman.update_position(e, at.pos + jd.rotation.rotate(at.quat, POINT), d, POINT),
    "attitude": lambda e, at, d: kalman.update_attitude(e, at.quat, d),
    "height": lambda e, at, d: kalman.update_height(e, at.pos[2], d),
    "direction": lambda e, at, d: kalman.update_direction(e, jd.rotation.rotate_inverse(at.quat, FIELD), FIELD, d),
}


def test_an_exact_measurement_of_any_kind_is_fulfilled_after_it():
    """Position and height move the position; the others, of a drone whose position is known, turn the attitude."""
    error = jnp.array([0.01, -0.02, 0.03, 0, 0, 0, 0.02, 0.03, -0.01, *[0.0] * 6])

    @jit_unoptimized
    def corrected(estimate):
        known = estimate.replace(cov=jnp.diag(jnp.full(15, 1e-16).at[kalman.ANGLE].set(0.01)))
        turned = jnp.zeros(15).at[kalman.ANGLE].set(error[kalman.ANGLE])
        found = {}
        for name, measure in MEASUREMENTS.items():
            start, off = (estimate, error) if name in ("position", "height") else (known, turned)
            truth = shifted(start, off)
            found[name] = difference(measure(start, truth, 1e-6), truth)
        return found

    left = corrected(tilted())
    np.testing.assert_allclose(left["position"][kalman.POS], 0, atol=1e-9)
    np.testing.assert_allclose(left["height"][2], 0, atol=1e-9)
    np.testing.assert_allclose(left["attitude"][kalman.ANGLE], 0, atol=1e-6)
    for name, axis in ("point", POINT), ("direction", jd.rotation.rotate_inverse(tilted().quat, FIELD)):
        seen = np.cross(axis, left[name][kalman.ANGLE]) / np.linalg.norm(axis)  # a turn about the vector is not seen
        np.testing.assert_allclose(seen, 0, atol=1e-3)
        assert np.linalg.norm(np.cross(axis, error[kalman.ANGLE])) / np.linalg.norm(axis) > 0.01


@pytest.mark.slow
@pytest.mark.float32
def test_environments_carry_all_of_them_and_policies_see_them():
    sensors = (imu(), motion_capture(), barometer(), magnetometer(), state_estimate())
    env = jd.make("hover", sensors=sensors, observation=("position_error", "state_estimate", "barometer"))
    assert env.observation_size == 3 + 17 + 1
    obs, world = env.reset(KEY)

    @jit_unoptimized
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
        (lambda: state_estimate(rate=np.nan), "rate is nan; give a positive number"),
        (lambda: state_estimate(start=(-1, 0, 0)), "start of state_estimate is -1; give a number of at least 0"),
        (lambda: state_estimate(start=(0.1, np.nan, 0)), "start of state_estimate is nan"),
        (lambda: state_estimate(start=(1, 2)), r"start of state_estimate has shape \(2,\)"),
        (lambda: barometer(rate=0), "rate of a barometer is 0"),
        (lambda: imu(rate=None), "rate of an imu is None; give a positive number"),
        (
            lambda: jd.make("hover", sensors=(imu(rate=500.0),)),
            "sensor 'imu' measures at 500 Hz, which does not divide",
        ),
        (lambda: jd.make("hover", sensors=(imu(rate=30.0),)), "30 Hz, which does not divide the 100 Hz of the control"),
        (lambda: jd.Sensor("x", imu().measure, clocked=50.0), "sensor 'x' is clocked at 50.0 Hz, but its rate is None"),
        (lambda: dataclasses.replace(imu(), rate=50.0), "'imu' is clocked at 100.0 Hz, but its rate is 50.0;"),
        (lambda: dataclasses.replace(barometer(), rate=100), "'barometer' is clocked at 50.0 Hz, but its rate is 100;"),
    ],
)
def test_nonsense_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
