"""Drawn vehicles: the laws against published airframes, consistency, and that they fly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_finite
from lagging_flight import hover_errors

import jaxdrones as jd
from jaxdrones import vehicles
from jaxdrones.checks import check_params
from jaxdrones.envs.randomize import AnyVehicle, scaled
from jaxdrones.vehicles import LAWS

GRAVITY, AIR_DENSITY = 9.81, 1.225
RPM = 2 * np.pi / 60  # rad/s
NO = np.nan

PUBLISHED = {
    # mass (kg), arm (m), I_xx, I_yy, I_zz (kg m^2), thrust to weight, propeller radius (m), torque over thrust (m),
    # rise and fall time (s), k_F (N/RPM^2), drag along x and z (N/(m/s)), rotor inertia (kg m^2)
    # crazyflow 0.4.0, cf2x_P250, cf2x_T350, cf21B_500, about hover as in assets/cf21*.urdf:
    "cf21": (
        0.0318,
        0.0460,
        16.8e-6,
        16.8e-6,
        29.8e-6,
        1.54,
        0.0234,
        0.00702,
        0.1117,
        0.1029,
        1.45e-10,
        0.01351,
        0.01677,
        2.697e-8,
    ),
    "cf21_thrust": (
        0.0379,
        0.0460,
        15.7e-6,
        17.1e-6,
        30e-6,
        1.939,
        0.0254,
        0.00531,
        0.0879,
        0.0693,
        2.5637e-10,
        0.0152,
        0.02205,
        NO,
    ),
    "cf21_brushless": (
        0.0434,
        0.05,
        25e-6,
        28e-6,
        49e-6,
        1.881,
        0.0275,
        0.00611,
        0.0571,
        0.0621,
        4.2103e-10,
        0.02164,
        0.02477,
        3.893e-8,
    ),
    # rl-tools, parameters/dynamics/crazyflie.h, identified by Eschmann et al. 2024 (arXiv 2404.07837), with decks:
    "crazyflie": (0.0306, 0.0396, 9.42e-6, 9.64e-6, 17.5e-6, 1.479, 0.0234, 0.00467, 0.0691, 0.1137, NO, NO, NO, NO),
    # Ferede et al. 2023 (arXiv 2304.13460), as in assets/bebop.urdf:
    "bebop": (
        0.389,
        0.1098,
        9.06e-4,
        1.242e-3,
        2.054e-3,
        2.564,
        0.07,
        0.0101,
        0.06,
        0.06,
        1.6972e-8,
        0.1197,
        0.3252,
        3.924e-6,
    ),
    # rotorpy 3.0.0 and RotorS (lag), as in assets/hummingbird.urdf:
    "hummingbird": (
        0.5,
        0.17,
        3.65e-3,
        3.68e-3,
        7.03e-3,
        4.08,
        0.1,
        0.0244,
        0.0125,
        0.025,
        6.108e-8,
        0.2233,
        0.4353,
        NO,
    ),
    # Powers et al. 2015, as in assets/hb.urdf:
    "hb": (0.5, 0.175, 2.3e-3, 2.3e-3, 4.0e-3, 2.0, 0.1016, 0.0245, NO, NO, 6.11e-8, NO, NO, NO),
    # Bauersfeld et al. 2021, Sun et al. 2022, as in assets/agilicious.urdf:
    "agilicious": (
        0.772,
        0.125,
        2.5e-3,
        2.1e-3,
        4.3e-3,
        4.494,
        0.0648,
        0.022,
        0.033,
        0.033,
        1.7135e-8,
        0.27,
        0.42,
        5.64e-6,
    ),
    # rl-tools, parameters/dynamics/soft.h and fs.h:
    "soft": (0.97, 0.2207, 8.1547e-3, 5.2261e-3, 12.04e-3, 3.31, NO, 0.00707, 0.04, 0.04, NO, NO, NO, NO),
    "fs": (3.35, 0.3187, 0.11361, 0.12552, 0.22822, 3.727, NO, 0.01492, 0.06532, 0.06532, NO, NO, NO, NO),
    # fdcl-gwu/gym-rotor, its laboratory's quadrotor:
    "gwu": (1.85, 0.23, 0.022, 0.022, 0.035, 2.2, NO, 0.0135, NO, NO, NO, NO, NO, NO),
    # Eschmann et al. 2024 and PX4's Gazebo model, as in assets/x500.urdf; crazyflow's hb_x500:
    "x500": (2.0, 0.25, 0.021705, 0.021304, 0.039396, 3.25, 0.127, 0.016, 0.054, 0.054, 9.375e-8, NO, NO, NO),
    "hb_x500": (2.28, 0.25, 0.024, 0.024, 0.044, 2.17, 0.127, NO, 0.071, 0.071, 9.375e-8, 0.803, 1.014, NO),
}
MASS, ARM, IXX, IYY, IZZ, T_W, RADIUS, KAPPA, RISE, FALL, KF, DRAG, DRAG_Z, ROTOR = np.array(list(PUBLISHED.values())).T

RAPTOR = {"thrust_to_weight": (1.5, 5.0), "rise_time": (0.03, 0.10), "fall_time": (0.03, 0.30)}
"""Ranges that a policy for all quadrotors is trained on: rl-tools, src/foundation_policy/pre_training."""

CF2X = jd.load_params("cf2x")
KEYS = jax.random.split(jax.random.key(20), 1000)
draw_many = jax.jit(jax.vmap(lambda key: vehicles.draw(key, CF2X)))


@pytest.fixture(scope="module")
def drawn():
    with jax.enable_x64(True):
        return draw_many(KEYS)


def regression(y, x=None):
    """Median at x = 1, exponent, and spread of the logarithm, of y over x where both are known; the residuals."""
    x = np.ones_like(y) if x is None else x
    known = np.isfinite(x) & np.isfinite(y)
    columns = np.stack([np.ones(known.sum()), np.log(x[known])], axis=1)[:, : 1 if np.ptp(x[known]) == 0 else 2]
    fit, *_ = np.linalg.lstsq(columns, np.log(y[known]), rcond=None)
    residual = np.log(y[known]) - columns @ fit
    spread = np.sqrt(residual @ residual / (known.sum() - columns.shape[1]))
    return np.exp(fit[0]), fit[1] if len(fit) > 1 else 0.0, spread, residual


_HOVER = np.sqrt(MASS * GRAVITY / 4 / KF) * RPM  # rad/s
_C_T = KF * 3600 / (AIR_DENSITY * (2 * RADIUS) ** 4)
FITS = {  # law: (numbers of the published airframes, what their power is taken of, the power in the law)
    "arm": (ARM, MASS, vehicles.ARM_POWER),
    "inertia": ((IXX + IYY) / 2 / (MASS * ARM**2), None, 0),
    "elongation": (IYY / IXX, None, 0),
    "flatness": (IZZ / (IXX + IYY), None, 0),
    "thrust_to_weight": (T_W, MASS, vehicles.THRUST_POWER),
    "prop_radius": (RADIUS / ARM, None, 0),
    "thrust_coefficient": (_C_T, None, 0),
    "figure_of_merit": (np.sqrt(_C_T * 2 / np.pi**3) * RADIUS / KAPPA, None, 0),
    "drag": (DRAG / (MASS * GRAVITY / (_HOVER * RADIUS)), None, 0),
    "vertical_drag": (DRAG_Z / DRAG, None, 0),
    "rise_time": (RISE, T_W, vehicles.LAG_POWER),
    "fall_time": (FALL / RISE, None, 0),
    "rotor_inertia": (ROTOR / (MASS * RADIUS**2), None, 0),
}


@pytest.mark.parametrize("name", FITS)
def test_a_law_is_the_regression_over_published_airframes(name):
    """Median, power and spread; limits are those of RAPTOR or where the published airframes end."""
    law, (numbers, over, power) = LAWS[name], FITS[name]
    median, fitted_power, spread, residual = regression(numbers, over)
    np.testing.assert_allclose([law.median, law.spread], [median, spread], rtol=0.02, atol=0.001)
    np.testing.assert_allclose(power, fitted_power, atol=0.002)
    if name in RAPTOR and name != "fall_time":
        assert (law.low, law.high) == RAPTOR[name]
    else:
        np.testing.assert_allclose([law.low, law.high], median * np.exp([residual.min(), residual.max()]), rtol=0.02)


@pytest.mark.slow
def test_angular_acceleration_falls_with_the_mass_as_in_published_airframes(drawn):
    """Froude scaling (Kushleyev et al. 2013) has 1 / length, the power -1/3 of the mass; published airframes -0.28."""
    _, published, _, _ = regression(ARM * T_W * MASS * GRAVITY / 4 / IXX, MASS)
    _, ours, _, _ = regression(
        np.asarray(drawn.arm * drawn.max_thrust / 4 / drawn.inertia[:, 0]), np.asarray(drawn.mass)
    )
    assert abs(published + 0.277) < 0.005
    assert abs(ours - published) < 0.06 and abs(ours + 1 / 3) < 0.06


ENVELOPE = {  # name: (number of a vehicle, low, high), with what the ends are from
    # the issue
    "mass, kg": (lambda p: p.mass, 0.02, 3.0),
    # RAPTOR; published 1.48 to 4.49
    "thrust to weight": (lambda p: p.max_thrust / p.weight, 1.5, 5.0),
    # published
    "arm over kg^0.423, m": (lambda p: p.arm / p.mass**vehicles.ARM_POWER, 0.139, 0.235),
    # the same at 20 g and at 3 kg; published 0.040 at 31 g to 0.32 at 3.35 kg
    "arm, m": (lambda p: p.arm, 0.026, 0.38),
    # published
    "inertia over m l^2": (lambda p: (p.inertia[:, 0] + p.inertia[:, 1]) / (2 * p.mass * p.arm**2), 0.142, 0.351),
    # published; 1 for a flat body
    "I_zz over I_xx + I_yy": (lambda p: p.inertia[:, 2] / (p.inertia[:, 0] + p.inertia[:, 1]), 0.795, 0.96),
    # RAPTOR: arm times thrust of a rotor over inertia; published 86 to 528
    "torque to inertia, rad/s^2": (lambda p: p.arm * p.max_thrust / 4 / p.inertia[:, 0], 40, 1200),
    # RAPTOR; published 0.0125 to 0.112
    "rise time, s": (lambda p: p.rotor_rise_time, 0.03, 0.10),
    # RAPTOR; published 0.025 to 0.114
    "fall time, s": (lambda p: p.rotor_fall_time, 0.03, 0.30),
    # published 0.126 to 0.30, 1.5 times either way, since it follows from two coefficients
    "torque over thrust over propeller radius": (lambda p: p.km / p.kf / p.prop_radius, 0.084, 0.45),
    # published 46 to 103, 1.5 times either way
    "tip speed in hover, m/s": (lambda p: p.hover_rpm * RPM * p.prop_radius, 30, 154),
    # published 0.31 to 0.50, twice either way
    "deceleration by drag in hover, 1/s": (lambda p: p.drag_coeff[:, 0] * 4 * p.hover_rpm * RPM / p.mass, 0.15, 1.0),
}


@pytest.mark.parametrize("name", ENVELOPE)
def test_drawn_vehicles_are_inside_the_published_envelope_and_fill_half_of_it(drawn, name):
    number, low, high = ENVELOPE[name]
    values = np.asarray(number(drawn))
    rounding = 1e-9
    assert low * (1 - rounding) <= values.min() and values.max() <= high * (1 + rounding)
    assert np.log(values.max() / values.min()) > 0.5 * np.log(high / low)


def test_the_aspect_is_the_rotors_y_over_x(monkeypatch):
    monkeypatch.setitem(vehicles.LAWS, "aspect", vehicles.Law(1.1, 0.01, 1.09, 1.11))
    x, y, _ = np.abs(vehicles.draw(KEYS[0], CF2X).rotor_pos[0])
    assert 1.089 < y / x < 1.111


def test_the_elongation_is_the_inertia_about_y_over_that_about_x(monkeypatch):
    monkeypatch.setitem(vehicles.LAWS, "elongation", vehicles.Law(1.2, 0.01, 1.19, 1.21))
    about_x, about_y, _ = vehicles.draw(KEYS[0], CF2X).inertia
    assert 1.189 < about_y / about_x < 1.211


def test_as_many_light_as_heavy_vehicles_are_drawn(drawn):
    """The logarithm of the mass is uniform: each fifth of its range has a fifth of the vehicles."""
    counts, _ = np.histogram(np.log(drawn.mass), 5, np.log([0.02, 3.0]))
    share = counts / len(drawn.mass)
    assert np.abs(share - 0.2).max() < 4 * np.sqrt(0.2 * 0.8 / len(drawn.mass))


@pytest.mark.slow
def test_a_thousand_drawn_vehicles_hover(drawn):
    """With lagging rotors, the reaction of their inertia and drag, from 0.3 m away and tilted by 20 degrees."""
    distance, speed = hover_errors(drawn, jax.random.key(1), seconds=10)
    assert np.max(distance) < 0.02 and np.max(speed) < 0.02


def test_drawn_numbers_are_those_of_a_body_with_four_rotors(drawn):
    check_params(drawn)
    assert_finite(drawn)
    largest = jnp.max(drawn.inertia, axis=1)
    assert np.all(2 * largest <= jnp.sum(drawn.inertia, axis=1))  # as of every body
    np.testing.assert_allclose(jnp.mean(drawn.rotor_pos, axis=1), 0, atol=1e-15)
    nearest = 2 * jnp.min(jnp.abs(drawn.rotor_pos[..., :2]), axis=(1, 2))
    assert np.all(nearest > 2 * drawn.prop_radius)  # propellers stay clear of each other
    np.testing.assert_array_equal(drawn.rotor_spin[0], CF2X.rotor_spin)


def test_the_surroundings_and_what_the_core_does_not_know_are_kept():
    params = CF2X.replace(gravity=jnp.array(3.7), wind=jnp.array([1.0, 2, 3]), aux={"battery": jnp.array(2.0)})
    one = vehicles.draw(jax.random.key(0), params)
    assert (one.gravity, one.aux["battery"]) == (3.7, 2.0)
    np.testing.assert_array_equal(one.wind, params.wind)


@pytest.mark.slow
def test_light_vehicles_can_be_asked_for():
    mass = jax.vmap(lambda key: vehicles.draw(key, CF2X, 0.02, 0.05).mass)(KEYS)
    assert 0.02 <= mass.min() < 0.0205 and 0.0495 < mass.max() <= 0.05
    assert vehicles.median(CF2X, 0.02, 0.05).mass < 0.05
    for masses in (0.01, 1.0), (1.0, 5.0), (2.0, 1.0), (np.nan, 1.0):
        with pytest.raises(ValueError, match="give"):
            AnyVehicle(*masses)


def test_more_light_vehicles_can_be_asked_for():
    @jax.jit
    def share(keys, light=2.0):  # below the geometric mean of the limits
        masses = jax.vmap(lambda key: vehicles.draw(key, CF2X, light=light).mass)(keys)
        return jnp.mean(masses < jnp.sqrt(0.02 * 3))

    keys = jax.random.split(jax.random.key(0), 2000)
    np.testing.assert_allclose(share(keys), np.sqrt(0.5), atol=0.03)  # u**2 < 1/2
    np.testing.assert_allclose(share(keys, 1.0), 0.5, atol=0.03)
    with pytest.raises(ValueError, match="light is 0"):
        AnyVehicle(light=0)


@pytest.mark.slow
def test_realistic_any_draws_the_vehicles_that_are_given():
    env = jd.make("hover", realistic="any", randomize=(AnyVehicle(0.02, 0.03),))
    masses = jax.jit(jax.vmap(lambda key: env.reset(key)[1].params.mass))(KEYS)
    assert (
        masses.max() <= 0.03 and env.params.mass < 0.03 and env != jd.make("hover", randomize=(AnyVehicle(0.02, 0.03),))
    )


@pytest.mark.float32
def test_drawn_vehicles_have_the_precision_of_the_parameters():
    one = vehicles.draw(jax.random.key(0), jd.load_params("cf2x"))
    assert {leaf.dtype for leaf in jax.tree.leaves(one)} == {np.dtype("float32")}
    assert_finite(one)


@pytest.mark.slow
def test_an_action_of_zero_hovers_whatever_vehicle_is_drawn():
    env = jd.make("hover", randomize=(AnyVehicle(),), tilt=0.0, speed=0.0, omega=0.0)
    _, world = jax.jit(jax.vmap(env.reset))(KEYS[:20])
    assert np.ptp(np.asarray(world.params.mass)) > 1
    zero = jnp.zeros((20, 1, 4))
    flown = jax.jit(jax.vmap(env.step))(KEYS[:20], world, zero)[1]
    np.testing.assert_allclose(flown.drones.vel, world.drones.vel, atol=1e-12)


@pytest.mark.slow
def test_realistic_any_draws_vehicles_before_what_else_is_drawn():
    env = jd.make("hover", realistic="any", randomize=(scaled("mass", 2.0, 2.0),))
    nominal, drawn = env.params, env.reset(jax.random.key(3))[1].params
    assert drawn.max_thrust / drawn.weight < 2.5 + 1e-6
    np.testing.assert_allclose(nominal.mass, np.sqrt(0.02 * 3))
    assert "any quadrotor of 0.02 to 3 kg; mass times" in jd.explain(env).physics["drawn per episode"]
    assert jd.explain(env).vehicle["name"] == "any vehicle" and jd.make("hover", realistic="any") != env


def test_a_vehicle_beside_drawn_ones_is_refused():
    with pytest.raises(ValueError, match="vehicle='hb' is given, but every episode draws a vehicle already; leave out"):
        jd.make("hover", realistic="any", vehicle="hb")
    with pytest.raises(ValueError, match=r"^a vehicle is given, but every episode"):
        jd.make("hover", realistic="any", vehicle=jd.load_params("hb"))
    with pytest.raises(ValueError, match="another AnyVehicle is given"):
        jd.make("hover", randomize=(AnyVehicle(0.02, 0.1), AnyVehicle()))
    with pytest.raises(ValueError, match="realistic is 'all'; give True or False or 'any'"):
        jd.make("hover", realistic="all")
    with pytest.raises(ValueError, match="needs rotors with a time constant"):
        jd.make("hover", realistic="any", action="position")
