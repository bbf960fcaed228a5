"""A vehicle is identified from its flights, and repeats them."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones
from jaxdrones.cli import main
from jaxdrones.dynamics import crazyflie_motors
from jaxdrones.identification import FlightLog, Vehicle, fit, hold_errors, open_loop_errors
from jaxdrones.identification.files import load_vehicle, write_vehicle
from jaxdrones.urdf import parse_params
from jaxdrones.urdf_writer import to_urdf

NANOBENCH = "B3_figure8_slow_rep2"
IDENTIFIABLE = ("kf", "drag_coeff_x", "drag_coeff_y", "flapping_coeff_x", "flapping_coeff_y")


@pytest.mark.slow
def test_the_vehicle_that_flew_repeats_its_flight(flown):
    """Its errors are below 1 % of those of others; rk4 flew, and the midpoint rule repeats."""
    params, log = flown
    own = open_loop_errors(log, Vehicle.of(params), crazyflie_motors())
    other = open_loop_errors(log, Vehicle.of(jaxdrones.load_params("cf2x")), crazyflie_motors())
    assert (own[-1] < 0.01 * other[-1]).all()
    assert (own[-1] < 0.01 * hold_errors(log)[-1]).all()


@pytest.mark.slow
def test_a_fit_finds_the_vehicle_that_flew(flown, tmp_path):
    """From half of the drag and no flapping, thrust is found within 1 %, drag and flapping within 5 %."""
    params, log = flown
    start = params.replace(
        kf=params.kf / 1.2, drag_coeff=params.drag_coeff * jnp.array([0.5, 0.5, 1]), flapping_coeff=jnp.zeros(2)
    )
    report = fit([log], start, IDENTIFIABLE)
    found = report.vehicle.params
    np.testing.assert_allclose(found.kf, params.kf, rtol=0.01)
    np.testing.assert_allclose(found.drag_coeff, params.drag_coeff, rtol=0.05)
    np.testing.assert_allclose(found.flapping_coeff, params.flapping_coeff, rtol=0.05)
    assert all(estimate.identifiable for estimate in report.parameters.values())

    write_vehicle(tmp_path / "fit", report, "test")
    read = load_vehicle(tmp_path / "fit")
    np.testing.assert_allclose(read.params.flapping_coeff, found.flapping_coeff, rtol=1e-6)
    np.testing.assert_allclose(read.params.max_rpm, found.max_rpm, rtol=1e-6)


@pytest.mark.slow
def test_unidentifiable_parameters_are_named(flown):
    """With measured rotor speeds, no flight identifies how the rotors follow a command."""
    params, log = flown
    with pytest.raises(ValueError, match=r"do not identify rotor_lag \(\S+ \+- \S+\); leave .* out of --parameters"):
        fit([log], params, ("kf", "rotor_lag"))


def test_what_cannot_be_fitted_is_named(flown):
    params, log = flown
    with pytest.raises(ValueError, match="no flights"):
        fit([], params)
    with pytest.raises(ValueError, match=r"unknown parameter 'color'"):
        fit([log], params, ("color",))
    with pytest.raises(ValueError, match="one after the other"):
        fit([log, FlightLog.load(NANOBENCH)], params)


@pytest.mark.parametrize("vehicle", ["cf2x", "hb"])
def test_a_written_vehicle_is_read_as_it_was(vehicle):
    params = jaxdrones.load_params(vehicle)
    read = parse_params("written.urdf", to_urdf(params, vehicle))
    for name, value in vars(params).items():
        if name != "aux":
            np.testing.assert_allclose(getattr(read, name), value, rtol=1e-6, err_msg=name)


@pytest.mark.slow
def test_a_recorded_flight_is_simulated_in_closed_loop(capsys, tmp_path):
    """The nominal Crazyflie stays within 8 cm of the real one in the plane, and needs less thrust than it."""
    figure = tmp_path / "paths.png"
    assert main(["score", NANOBENCH, "--vehicle", "cf2x", "--json", "--figure", str(figure)]) == 0
    results = json.loads(capsys.readouterr().out)
    assert set(results["open_loop"]) == {"hold", "nominal", "vehicle"}
    assert set(results["open_loop"]["vehicle"]) == {"10", "25", "50"}
    assert results["open_loop"]["vehicle"] == results["open_loop"]["nominal"]
    (flight,) = results["closed_loop"]
    assert flight["xy_rms_m"] < 0.08
    assert flight["pwm_sim"] < 0.9 * flight["pwm_real"]
    assert abs(flight["tracking_sim_m"] / flight["tracking_real_m"] - 1) < 0.12
    assert figure.stat().st_size > 1e4


@pytest.mark.slow
def test_a_fitted_crazyflie_needs_the_thrust_of_the_real_one(capsys, tmp_path):
    assert main(["fit", NANOBENCH, "--output", str(tmp_path / "fit")]) == 0
    assert "unfelt_sag" in capsys.readouterr().out
    assert main(["score", NANOBENCH, "--vehicle", str(tmp_path / "fit"), "--json"]) == 0
    results = json.loads(capsys.readouterr().out)
    (flight,), (nominal,) = results["closed_loop"], results["closed_loop_nominal"]
    assert abs(flight["pwm_sim"] / flight["pwm_real"] - 1) < 0.015
    assert flight["xy_rms_m"] < nominal["xy_rms_m"]
