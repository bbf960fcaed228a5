"""Closed-loop simulations of flights on set-points start at take-off or in flight."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones
from jaxdrones import rotation
from jaxdrones.control import firmware_pid
from jaxdrones.dynamics.propulsion import FULL_PWM, crazyflie_motors
from jaxdrones.flights import FlightLog, Vehicle, simulate_closed_loop
from jaxdrones.flights.closed_loop import closed_loop_columns
from jaxdrones.flights.preparation import prepare
from jaxdrones.flights.vehicle import Instruments
from jaxdrones.state import State

ROWS, REST, LOADED = 700, 4.1, 3.3
HEIGHT = 0.5  # m, of the set-point
TAKE_OFF = 100  # row


def log_of(height, begin):
    """A log whose motors start in the row `begin`, with a drone at this height and a set-point at `HEIGHT`."""
    zero, up = np.zeros((ROWS, 1, 3)), np.array([0.0, 0, 1])
    runs = np.arange(ROWS) >= begin
    pos = np.where((np.arange(ROWS) < 2 * begin)[:, None], height * up, HEIGHT * up)
    return FlightLog(
        np.arange(ROWS) * 0.01,
        pos[:, None],
        np.tile([0, 0, 0, 1.0], (ROWS, 1, 1)),
        zero,
        zero,
        pwm=np.where(runs, 0.6 * FULL_PWM, 0)[:, None, None] * np.ones(4),
        vbat=np.where(runs, LOADED, REST)[:, None],
        target_pos=np.where(runs[:, None], HEIGHT * up, 0)[:, None],
        target_yaw=np.zeros((ROWS, 1)),
    )


def test_a_heading_that_was_not_recorded_is_not_taken_for_north():
    unknown = dataclasses.replace(log_of(0.05, TAKE_OFF), target_yaw=np.asarray(np.nan))
    (log,) = prepare(unknown, allow_inconsistent=True)
    assert log.has("target_pos") and not log.has("target_yaw")
    with pytest.raises(ValueError, match="has no set-points; add ref_pos, ref_yaw, pwm and vbat for a closed loop"):
        closed_loop_columns(log)


def test_the_sag_of_a_battery_is_from_its_highest_voltage_at_rest():
    log = log_of(0.05, TAKE_OFF)
    vbat = np.array(log.vbat)
    vbat[: TAKE_OFF // 2] -= 0.3  # it was connected a moment ago
    assert dataclasses.replace(log, vbat=vbat).sag == pytest.approx(REST - LOADED)
    vbat[TAKE_OFF : TAKE_OFF + 150] -= 0.3  # the climb
    assert dataclasses.replace(log, vbat=vbat).sag == pytest.approx(REST - LOADED)


def test_the_onboard_estimate_is_late_and_exaggerates_the_tilt():
    """Of a drone that turns steadily at a constant velocity: its state 20 ms ago, with 1.5 times the tilt."""
    quat, omega = rotation.from_rpy(jnp.array([0.02, -0.03, 0.8])), jnp.array([0.3, -0.5, 2.0])
    state = State(jnp.array([1.0, 2, 3]), quat, jnp.array([0.5, -1, 2]), omega, jnp.zeros(4))
    ago = rotation.multiply(quat, rotation.exp(-0.02 * omega))
    late = Instruments.ideal().replace(estimate_delay=jnp.array(0.02))
    np.testing.assert_allclose(late.estimate(state).pos, [0.99, 2.02, 2.96], rtol=1e-12)
    np.testing.assert_allclose(late.estimate(state).quat, ago, rtol=1e-12)
    np.testing.assert_array_equal(late.estimate(state).omega, omega)
    seen = late.replace(estimate_tilt=jnp.array(1.5)).estimate(state).quat
    np.testing.assert_allclose(rotation.z_axis(seen)[:2], 1.5 * rotation.z_axis(ago)[:2], rtol=2e-3)


@pytest.fixture(scope="module")
def flown():
    """A vehicle with an unfelt sag of 0.5, and its simulations from a start in flight and from one on the ground."""
    vehicle = Vehicle.of(jaxdrones.load_params("cf21"))
    vehicle = vehicle.replace(instruments=vehicle.instruments.replace(unfelt_sag=jnp.array(0.5)))
    motors, gains = crazyflie_motors(), firmware_pid.gains()
    logs = log_of(HEIGHT, 0), log_of(0.05, TAKE_OFF)
    return vehicle, [simulate_closed_loop(log, vehicle, motors, gains) for log in logs]


@pytest.mark.slow
def test_a_simulation_that_begins_in_flight_hovers_at_once(flown):
    """The drone stays within a centimeter, with the PWM that carries the weight."""
    vehicle, (hovering, _) = flown
    np.testing.assert_allclose(hovering.sim_pos, hovering.ref_pos, atol=0.01)
    duty = crazyflie_motors().voltage(vehicle.params.weight / 4) / LOADED
    np.testing.assert_allclose(hovering.sim_pwm[-1], duty * FULL_PWM, rtol=1e-3)


@pytest.mark.slow
def test_a_simulation_from_the_ground_overshoots_by_the_integrators_of_the_climb(flown):
    """The drone overshoots as the real one does, by an integrator that wound up on the ground, and then settles."""
    _, (_, climbing) = flown
    assert climbing.sim_pos[:, 2].max() > HEIGHT + 0.05
    assert np.abs(climbing.sim_pos[:, :2]).max() < 1e-6
    assert abs(climbing.sim_pos[-1, 2] - HEIGHT) < 0.05


@pytest.mark.slow
def test_a_part_of_a_large_sag_does_not_reach_the_motors(flown):
    """A drone whose battery sags by 0.8 V needs the PWM of one with half of 0.25 V more."""
    vehicle, (hovering, climbing) = flown
    log = log_of(0.05, TAKE_OFF)
    assert log.sag == pytest.approx(REST - LOADED)
    assert log_of(0.05, ROWS - 100).sag == pytest.approx(REST - LOADED)  # a flight of one second
    assert log_of(HEIGHT, 0).sag == 0
    np.testing.assert_allclose(vehicle.instruments.motor_supply(jnp.array(LOADED), jnp.array(0.4)), LOADED)
    supply = LOADED + 0.5 * (log.sag - 0.55)
    np.testing.assert_allclose(climbing.sim_pwm[-1].mean() * supply, hovering.sim_pwm[-1].mean() * LOADED, rtol=0.01)
