import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

from jaxdrones import load_params, repeat
from jaxdrones.sensing import Scene
from jaxdrones.tasks import curves
from jaxdrones.tasks.tracking import tracking


def test_the_circle_is_a_circle_and_starts_where_gym_pybullet_drones_does():
    circle = curves.circle(radius=0.3, period=10.0)
    start = circle.positions(4)
    angle = 2 * np.pi * np.arange(4) / 6 + np.pi / 2
    expected = np.stack([0.3 * np.cos(angle), 0.3 * np.sin(angle) - 0.3, 0.1 + 0.05 * np.arange(4)], axis=-1)
    np.testing.assert_allclose(start, expected, atol=1e-12)
    np.testing.assert_allclose(circle.positions(4, 10.0), start, atol=1e-12)
    np.testing.assert_allclose(circle.positions(1, 5.0)[0], [0, -0.6, 0.1], atol=1e-12)


def test_drones_that_cross_are_above_each_other_twice_a_period():
    crossing = curves.crossing(2)
    np.testing.assert_allclose(crossing.positions(2), [[0.5, 0, 1.0], [-0.5, 0, 0.5]], atol=1e-12)
    for t in (1.25, 3.75):
        np.testing.assert_allclose(crossing.positions(2, t)[:, 0], 0, atol=1e-12)


def test_a_hop_is_to_the_height_and_its_amplitude_about_which_it_oscillates():
    hop = curves.hop(height=1.0, amplitude=0.2, period=4.0)
    for t, z in (0.0, 1.2), (1.0, 1.4), (3.0, 1.0):
        np.testing.assert_allclose(hop.positions(2, t), [[0, 0, z], [1, 0, z]], atol=1e-12)


@pytest.mark.parametrize("curve", [curves.circle(), curves.crossing(3), curves.hop()])
def test_velocity_and_acceleration_are_the_derivatives_of_the_curve(curve):
    h = 1e-4
    positions = jax.jit(lambda t: curve.positions(3, t))
    before, now, after = (np.asarray(positions(0.7 + d)) for d in (-h, 0, h))
    setpoints = jax.jit(lambda t: curve.setpoints(3, t))(0.7)
    np.testing.assert_allclose(setpoints.pos, now, atol=1e-14)
    np.testing.assert_allclose(setpoints.vel, (after - before) / (2 * h), atol=1e-7)
    np.testing.assert_allclose(setpoints.acc, (after - 2 * now + before) / h**2, atol=1e-6)


@pytest.mark.parametrize("shape", curves.SHAPES.values())
def test_shapes_repeat_after_a_period_and_stay_within_their_size(shape):
    u = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, curves.RANDOM_NUMBERS))
    s = jnp.linspace(0, 1, 100, endpoint=False)
    along = jax.jit(jax.vmap(shape, (None, 0)))
    np.testing.assert_allclose(along(u, s), along(u, s + 2), atol=1e-12)
    assert np.all(np.abs(along(u, s)) <= np.array([1, 1, 0.5]) + 1e-12)


def test_amplitudes_and_phases_of_a_lissajous_figure_are_drawn_for_themselves():
    u = np.random.default_rng(0).uniform(-1, 1, curves.RANDOM_NUMBERS)
    expected = (0.75 + 0.25 * u[:3]) * np.sin(np.pi * u[3:6]) * [1, 1, 0.5]
    np.testing.assert_allclose(curves.lissajous(jnp.asarray(u), jnp.zeros(())), expected, atol=1e-12)


def test_polynomials_pass_all_waypoints_in_order():
    u = np.random.default_rng(0).uniform(-1, 1, curves.RANDOM_NUMBERS)
    passed = jax.vmap(curves.polynomial, (None, 0))(jnp.asarray(u), jnp.arange(curves.WAYPOINTS) / curves.WAYPOINTS)
    np.testing.assert_allclose(passed, u[:24].reshape(8, 3) * [1, 1, 0.5], atol=1e-12)


def test_centers_of_curves_are_in_a_row_about_the_origin():
    center = curves.draw(jax.random.key(0), jax.random.key(1), 3, 4.0, 2.0, float)["center"]
    np.testing.assert_array_equal(center, [[0, -4, 2], [0, 0, 2], [0, 4, 2]])


def test_tracking_follows_the_shape_with_its_derivatives():
    task = tracking(curve="figure-eight", period=8.0)
    variables = {"center": jnp.ones((1, 3)), "random": jnp.zeros((1, 27)), "phase": jnp.array([0.25])}
    setpoint = task.target(variables, jnp.array(1.0))
    s, rate = 0.25 + 1 / 8, 2 * np.pi / 8
    sin, cos = np.sin(2 * np.pi * s), np.cos(2 * np.pi * s)
    sin2, cos2 = np.sin(4 * np.pi * s), np.cos(4 * np.pi * s)
    np.testing.assert_allclose(setpoint.pos[0], [1 + sin, 1, 1 + sin2 / 2], atol=1e-12)
    np.testing.assert_allclose(setpoint.vel[0], [rate * cos, 0, rate * cos2], atol=1e-12)
    np.testing.assert_allclose(setpoint.acc[0], [-(rate**2) * sin, 0, -2 * rate**2 * sin2], atol=1e-12)


def test_nobody_and_no_time_are_refused():
    with pytest.raises(ValueError, match="number of drones is 0"):
        curves.circle().positions(0)
    with pytest.raises(ValueError, match="period is 0"):
        curves.circle(period=0)


@pytest.mark.parametrize("random_start", [True, False])
def test_tracking_starts_with_the_motion_of_a_random_point_or_at_rest_at_the_start(random_start):
    task = tracking(drones=2, random_start=random_start)
    begin = jax.vmap(lambda key: task.begin(key, repeat(load_params("cf2x"), 2), Scene()))
    state, variables = jit_unoptimized(begin)(jax.random.split(jax.random.key(0), 20))
    target = jax.vmap(task.target, (0, None))(variables, jnp.zeros(()))
    spread = 0.1 * random_start
    assert np.ptp(variables["phase"]) > 0.8 if random_start else not np.any(variables["phase"])
    assert np.max(np.abs(state.pos - target.pos)) <= spread
    assert np.max(np.abs(state.vel - random_start * target.vel)) <= spread


def test_success_of_tracking_is_the_root_mean_square_after_a_second():
    k = np.arange(300)[:, None]
    for larger, success in (0.07, True), (0.072, False):
        error = np.where(k < 100, 1.0, np.where(k % 2, larger, 0.0))
        assert tracking().success({"error": jnp.asarray(error)}, 0.01).tolist() == [success]
