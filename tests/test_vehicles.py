"""Every bundled vehicle flies, and the identified ones have the numbers of their sources."""

import re
import xml.etree.ElementTree as ET

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop import hovering, reaches, team_of
from lagging_flight import hover_errors

import jaxdrones as jd
from jaxdrones import assets
from jaxdrones.control import geometric, pid

EVERY = tuple(assets.vehicles())
CRAZYFLIES = ("cf21", "cf21_thrust", "cf21_brushless")
GRAVITY = 9.81  # m/s^2, of the identifications
RPM = 2 * np.pi / 60  # rad/s


@pytest.mark.slow
def test_every_vehicle_goes_where_the_geometric_controller_sends_it():
    error = reaches(geometric, EVERY, (0.3, -0.3, 1.3), seconds=4, hz=240)
    assert np.all(error[-1] < 1e-3)


@pytest.mark.slow
def test_every_vehicle_hovers_on_rotors_that_lag():
    """With drag, from 0.3 m away and tilted by 20 degrees, and with the reaction of the rotors' inertia."""
    team = team_of(*EVERY)
    distance, speed = hover_errors(team, jax.random.key(0), seconds=12)
    assert np.all(distance < 0.01) and np.all(speed < 0.01)


@pytest.mark.slow
def test_the_pid_hovers_the_crazyflies_that_it_suits():
    suited = [vehicle for vehicle in EVERY if pid.fits(jd.load_params(vehicle))]
    assert suited == ["cf2p", "cf2x"]
    assert np.all(reaches(pid, suited, (0.0, 0.0, 1.2), seconds=4, hz=240)[-1] < 0.05)


@pytest.mark.parametrize("vehicle", EVERY)
def test_a_vehicle_says_unit_and_source_of_each_number(vehicle):
    text = assets.vehicles()[vehicle].read_text()
    for name in ET.fromstring(text).find("properties").keys():
        assert re.search(rf"^ +{name}: .{{10,}}", text, re.MULTILINE), f"{vehicle}: {name} has no source"


CURVES = {  # of crazyflow 0.4.0: thrust (N) and torque (N m) by powers of RPM, thrust limit (N), lag upwards, downwards
    "cf21": ((-3.6200226530383495e-7, 1.6060924304100328e-10), (-2.2665265829562245e-9, 1.1149485566919186e-12), 0.12),
    "cf21_thrust": (
        (-7.167227176573658e-7, 2.9401303690194613e-10),
        (5.815894847811497e-10, 1.331813874166509e-12),
        0.18,
    ),
    "cf21_brushless": (
        (-3.133427287299859e-7, 4.407354891648379e-10),
        (1.65886356219615e-9, 2.4693477924534137e-12),
        0.2,
    ),
}
LAGS = {
    "cf21": (5.172596691828673, 8.14774234381285e-5, 0.0, 0.0002095253491455741),
    "cf21_thrust": (11.374753209400291, 0.0, 0.0, 0.00037867688499079635),
    "cf21_brushless": (13.996001897562685, 0.00011093207920685363, 5.933168530682111, 0.00031951312393561264),
}
DRAGS = {
    "cf21": (0.01351483, 0.01677452),
    "cf21_thrust": (0.015203241038199845, 0.02204579179094129),
    "cf21_brushless": (0.021643637770852733, 0.02477138502714662),
}


@pytest.mark.parametrize("vehicle", CRAZYFLIES)
def test_a_crazyflie_is_the_identified_one_about_hover(vehicle):
    """Thrust, torque, lag and drag at the rotor speed at which the identified curve carries the weight."""
    params = jd.load_params(vehicle)
    (linear, square), (torque_linear, torque_square), limit = CURVES[vehicle]
    weight = float(params.mass) * GRAVITY / 4
    rpm = (-linear + np.sqrt(linear**2 + 4 * square * weight)) / (2 * square)
    close = lambda actual, expected: np.testing.assert_allclose(actual, expected, rtol=1e-3)  # noqa: E731
    close(params.kf * rpm**2, weight)
    close(params.km * rpm**2, torque_linear * rpm + torque_square * rpm**2)
    close(params.max_thrust, 4 * limit)
    rise, rise_square, fall, fall_square = LAGS[vehicle]
    close(1 / params.rotor_rise_time, rise + 2 * rise_square * rpm)
    close(1 / params.rotor_fall_time, fall + 2 * fall_square * rpm)
    close(params.drag_coeff[jnp.array([0, 2])] * 4 * rpm * RPM, DRAGS[vehicle])


def test_the_bebop_accelerates_as_in_the_model_of_its_paper():
    """Ferede et al. 2023 (arXiv 2304.13460), whose thrust and drag are accelerations and whose speeds are in RPM."""
    params, rpm = jd.load_params("bebop"), 7000.0
    np.testing.assert_allclose(params.kf * rpm**2 / params.mass, 4.36301076e-08 * rpm**2, rtol=1e-4)
    drag = params.drag_coeff * 4 * rpm * RPM / params.mass
    np.testing.assert_allclose(drag, 4 * rpm * np.array([1.07933887e-05, 9.65250793e-06, 2.7862899e-05]), rtol=1e-4)
    levers = [1.4119331e-09, 1.21601884e-09]  # N m/RPM^2 of one rotor, roll and pitch
    np.testing.assert_allclose(params.kf * jnp.abs(params.rotor_pos[0, jnp.array([1, 0])]), levers, rtol=1e-4)
    np.testing.assert_allclose(2 * params.km * params.hover_rpm, 2.57035545e-06, rtol=1e-3)  # 9.8 and 9.81 m/s^2
    np.testing.assert_allclose(params.rotor_inertia * RPM, 4.10923364e-07, rtol=1e-4)


@pytest.mark.parametrize(
    ("vehicle", "kf", "kappa", "thrust"),  # N/(rad/s)^2, m, N of all rotors
    [
        ("hummingbird", 5.57e-6, 1.36e-7 / 5.57e-6, 20),
        ("agilicious", 1.562522e-6, 0.022, 34),
        ("x500", 8.54858e-6, 0.016, 63.704),
    ],
)
def test_coefficients_per_radian_are_those_of_the_source(vehicle, kf, kappa, thrust):
    params = jd.load_params(vehicle)
    np.testing.assert_allclose(params.kf / RPM**2, kf, rtol=1e-4)
    np.testing.assert_allclose(params.km / params.kf, kappa, rtol=1e-4)
    np.testing.assert_allclose(params.max_thrust, thrust, rtol=1e-3)


@pytest.mark.slow
def test_every_vehicle_stands_on_the_ground():
    """It does not sink, tip or slide; the ground is stiff for all of them."""
    team = team_of(*EVERY)
    start = hovering(team, (0.0, 0.0, 0.0)).replace(
        pos=jnp.zeros((len(EVERY), 3)).at[:, 2].set(team.collision_height / 2 - team.collision_offset + 0.01),
        rpm=jnp.zeros((len(EVERY), 4)),
    )
    spread = 3.0 * jnp.arange(len(EVERY))[:, None] * jnp.array([[1.0, 0, 0]])
    start = start.replace(pos=start.pos + spread)
    step = jd.make_step(effects=(jd.ground_contact,), dt=1 / 240, substeps=240)
    end = step(team, step(team, start, start.rpm), start.rpm)
    np.testing.assert_allclose(end.pos[:, 2], team.collision_height / 2 - team.collision_offset, atol=2e-3)
    np.testing.assert_allclose(end.pos[:, :2], start.pos[:, :2], atol=1e-3)
    assert np.all(np.abs(end.vel) < 1e-3) and np.all(np.abs(end.omega) < 1e-2)


def test_the_aspect_of_a_drawn_vehicle_is_the_distance_of_its_rotors_along_y_over_that_along_x(monkeypatch):
    monkeypatch.setitem(jd.vehicles.LAWS, "aspect", jd.vehicles.Law(1.1, 0.1, 1.09, 1.11))
    x, y, _ = jnp.abs(jd.vehicles.median(jd.load_params("cf2x")).rotor_pos).T
    np.testing.assert_allclose(y / x, 1.1, rtol=1e-6)
