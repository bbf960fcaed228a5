"""Errors of sensors have the Allan deviation that their parameters say, and nothing else."""

import decimal
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones.sensing import (
    BMI088,
    BMP388,
    MPU9250,
    DepthNoise,
    MotionCaptureSystem,
    Noise,
    allan_deviation,
    optical_flow,
)

KEY = jax.random.key(0)
WHITE, WALK, DRIFT = Noise(density=0.02), Noise(random_walk=0.3), Noise(instability=0.5, correlation=0.05)


@partial(jax.jit, static_argnums=(0, 1, 2, 3))
def readings(noise, dt, length, channels=3):
    """Readings (length, channels) of what is zero."""
    begin, key = jax.random.split(KEY)
    zero = jnp.zeros(channels)

    def measure(errors, key):
        return noise.measure(key, errors, zero, dt)

    return jax.lax.scan(measure, noise.init(begin, (channels,), float), jax.random.split(key, length))[1]


@pytest.mark.parametrize(
    ("noise", "samples"),
    [
        (WHITE, [1, 10, 100]),
        (WALK, [10, 100]),
        (Noise(instability=0.5, correlation=1.0), [30, 100, 189, 400]),
        (Noise(density=0.02, instability=0.05, correlation=2.0, random_walk=0.01), [1, 10, 100, 400]),
    ],
)
@pytest.mark.slow
def test_the_allan_deviation_is_that_of_the_parameters(noise, samples):
    """64 channels over 200 s."""
    made = readings(noise, 0.01, 20_000, 64)
    found = [np.sqrt(np.mean(allan_deviation(made, 0.01, k) ** 2)) for k in samples]
    np.testing.assert_allclose(found, noise.allan_deviation(0.01 * np.array(samples)), rtol=0.03)


def test_each_parameter_is_read_off_its_own_part_of_the_curve():
    """IEEE 952: density at 1 s of white noise, K at 3 s of the random walk, 0.664 B at the top of the instability."""
    np.testing.assert_allclose(Noise(density=0.3).allan_deviation(1.0), 0.3)
    np.testing.assert_allclose(Noise(random_walk=0.3).allan_deviation(3.0), 0.3)
    assert Noise(density=0.3, instability=1.0, correlation=np.inf).allan_deviation(1.0) == 0.3
    curve = Noise(instability=0.3, correlation=10.0).allan_deviation(np.geomspace(0.1, 1000, 2000))
    np.testing.assert_allclose(curve.max(), 0.3 * np.sqrt(2 * np.log(2) / np.pi), rtol=1e-4)


def test_the_noise_that_drives_a_bias_in_a_filter_is_that_of_its_steps():
    noise, dt = Noise(instability=0.3, correlation=50.0, random_walk=0.02, turn_on=0.3), 0.1
    errors = noise.init(KEY, (20_000,), float)
    np.testing.assert_allclose(np.std(errors.bias), noise.bias, rtol=0.03)
    steps = noise.measure(jax.random.key(1), errors, jnp.zeros(20_000), dt)[0].bias - errors.bias
    np.testing.assert_allclose(np.std(steps), noise.bias_walk * np.sqrt(dt), rtol=0.03)


def test_data_sheets_in_degrees_g_and_pascal_are_converted():
    np.testing.assert_allclose([BMI088.gyro.turn_on, MPU9250.gyro.turn_on], np.radians([1, 5]))
    np.testing.assert_allclose([BMI088.acc.turn_on, MPU9250.acc.turn_on], [20e-3 * 9.80665, 60e-3 * 9.80665])
    np.testing.assert_allclose([BMP388.density, BMP388.turn_on], np.array([0.03, 8]) / (1.225 * 9.80665), rtol=1e-4)


@pytest.mark.parametrize("part", [BMI088, MPU9250], ids=["BMI088", "MPU9250"])
@pytest.mark.slow
def test_a_part_has_the_noise_of_its_data_sheet(part):
    for noise in part.acc, part.gyro:
        made = readings(noise, 0.01, 20_000, 64)
        found = np.sqrt(np.mean(allan_deviation(made, 0.01, 100) ** 2))
        np.testing.assert_allclose(found, noise.allan_deviation(1.0), rtol=0.03)
        np.testing.assert_allclose(noise.allan_deviation(1.0), noise.density, rtol=0.01)


def test_bias_and_scale_are_drawn_and_a_channel_saturates():
    noise = Noise(turn_on=2.0, scale=0.1, limit=50.0)
    errors = noise.init(KEY, (4000,), float)
    read = noise.measure(KEY, errors, jnp.full(4000, 10.0), 0.01)[1]
    np.testing.assert_allclose(read, 10 * (1 + errors.scale) + errors.bias)
    np.testing.assert_allclose([np.std(errors.bias), np.std(errors.scale)], [2, 0.1], rtol=0.05)
    for true in 1e3, -1e3:
        np.testing.assert_array_equal(noise.measure(KEY, errors, jnp.full(4000, true), 0.01)[1], np.sign(true) * 50)


def test_white_noise_shrinks_and_the_walk_of_the_bias_grows_with_the_root_of_the_time_between_measurements():
    zero = jnp.zeros(4000)
    for dt in 0.0025, 0.09:
        errors, read = WHITE.measure(KEY, WHITE.init(KEY, (4000,), float), zero, dt)
        np.testing.assert_allclose(np.std(read), 0.02 / np.sqrt(dt), rtol=0.05)
        np.testing.assert_array_equal(errors.bias, 0)
        errors, read = WALK.measure(KEY, WALK.init(KEY, (4000,), float), zero, dt)
        np.testing.assert_allclose(np.std(read), 0.3 * np.sqrt(dt), rtol=0.05)
        np.testing.assert_array_equal(errors.bias, read)
        again = WALK.measure(jax.random.key(1), errors, zero, dt)[1]
        np.testing.assert_allclose(np.std(again), 0.3 * np.sqrt(2 * dt), rtol=0.05)
        errors, read = DRIFT.measure(KEY, DRIFT.init(jax.random.key(1), (4000,), float), zero, dt)
        np.testing.assert_allclose(np.std(read), DRIFT.drift, rtol=0.05)


def test_too_few_readings_are_refused():
    with pytest.raises(ValueError, match=r"\(20,\) readings are too few to average 10; give at least"):
        allan_deviation(np.zeros(20), 0.01, 10)


@pytest.mark.parametrize("time", [0, -1.0, [1.0, np.nan]])
def test_an_averaging_time_that_is_not_positive_is_refused(time):
    with pytest.raises(ValueError, match=r"^time is .*; give positive averaging times"):
        Noise(density=1.0).allan_deviation(time)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Noise(density=-0.1), "density of Noise is -0.1; give a number of at least 0"),
        (lambda: Noise(correlation=0), "correlation of Noise is 0; give a positive number"),
        (lambda: Noise(limit=np.nan), "limit of Noise is nan; give a positive number"),
        (lambda: Noise(scale="a"), "scale of Noise is 'a'"),
        (
            lambda: MotionCaptureSystem(dropout=2),
            r"dropout of MotionCaptureSystem is 2; give .* at most 1 \(a fraction\)",
        ),
        (lambda: MotionCaptureSystem(rate=0), "rate of MotionCaptureSystem is 0; give a positive number"),
        (lambda: MotionCaptureSystem(delay=-0.1), "delay of MotionCaptureSystem is -0.1"),
        (lambda: MotionCaptureSystem(pos_noise=np.inf), "pos_noise of MotionCaptureSystem is inf"),
        (lambda: DepthNoise(dropout=1.5), r"dropout of DepthNoise is 1.5; give .* at most 1 \(a fraction\)"),
        (lambda: DepthNoise(missing="nan"), r"unknown value of a missing pixel 'nan'.*far, zero"),
        (lambda: DepthNoise(disparity_step=-1), "disparity_step of DepthNoise is -1"),
        (lambda: allan_deviation(np.zeros(50), -0.01, 10), r"dt is -0.01; give a positive number \(s\)"),
        (lambda: allan_deviation(np.zeros(50), 0.01, 0), "samples is 0; give a whole number"),
        (lambda: allan_deviation(np.full(50, np.nan), 0.01, 10), "some readings are not finite"),
        (lambda: optical_flow(noise=-1), "noise of optical-flow is -1"),
        (lambda: optical_flow(dropout=np.nan), r"dropout of optical-flow is nan"),
    ],
)
def test_errors_that_make_no_sense_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("ratio", [1e-12, 1e-7, 1e-4, 0.00999, 0.01001, 0.3, 4.0, 50.0])
def test_the_allan_deviation_of_a_slow_drift_is_not_rounded(ratio):
    """With 50 digits; a correlation time of 100 s had an error of 1.6 % at 1 ms, and one of 1e9 s was NaN at 0.1 s."""
    with decimal.localcontext(decimal.Context(prec=50)):
        x = decimal.Decimal(ratio)
        expected = (2 * (1 - (3 - 4 * (-x).exp() + (-2 * x).exp()) / (2 * x)) / x).sqrt()
    noise = Noise(instability=0.2, correlation=100.0)
    found = noise.allan_deviation(np.array([100 * ratio])) / noise.drift
    np.testing.assert_allclose(found, [float(expected)], rtol=1e-8)
