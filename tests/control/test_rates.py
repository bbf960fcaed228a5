import golden_data
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop import always, at, fly, hovering, one, reaches, team_of
from helpers import VEHICLES, mostly_slow

import jaxdrones
from jaxdrones import State, rotation
from jaxdrones.control import rates
from jaxdrones.control.setpoint import Setpoint
from jaxdrones.dynamics.rigid_body import newton_euler
from jaxdrones.dynamics.rotors import rotor_wrench

INPUTS = ("pos", "quat", "vel", "target_pos", "target_vel")


@jax.jit
def command_all(params, *rows):
    def one_command(pos, quat, vel, target_pos, target_vel):
        state = State(pos, quat, vel, jnp.zeros(3), jnp.zeros(4))
        return rates.command(rates.gains(), params, state, Setpoint.at(target_pos, vel=target_vel))

    return jax.vmap(one_command)(*rows)


@pytest.mark.parametrize("name", golden_data.names("ctbr"))
def test_recorded_commands_agree(name):
    case = golden_data.load(name)
    collective, omega = command_all(jaxdrones.load_params("racer"), *(jnp.asarray(case.arrays[key]) for key in INPUTS))
    np.testing.assert_allclose(collective, case.arrays["ctbr"][:, 0], rtol=0, atol=1e-9)  # measured: 1e-14
    np.testing.assert_allclose(omega, case.arrays["ctbr"][:, 1:], rtol=0, atol=1e-9)


@pytest.mark.float32
@pytest.mark.parametrize("name", golden_data.names("ctbr"))
def test_recorded_commands_agree_in_float32(name):
    case = golden_data.load(name)
    collective, omega = command_all(jaxdrones.load_params("racer"), *(jnp.asarray(case.arrays[key]) for key in INPUTS))
    # A few roundings of 6e-8 in numbers around 30 and 10.
    np.testing.assert_allclose(collective, case.arrays["ctbr"][:, 0], rtol=0, atol=2e-5)
    np.testing.assert_allclose(omega, case.arrays["ctbr"][:, 1:], rtol=0, atol=2e-5)


@pytest.mark.parametrize("omega", [(0.5, -0.3, 0.1), (1.5, 0.0, 0.0), (-0.4, 0.8, -0.1)])
@pytest.mark.slow
def test_body_rates_follow_a_step_as_a_first_order_lag(omega):
    """Exactly, as long as all rotors turn: 1 - (1 - 40 dt)^k in roll and pitch, 1 - (1 - 15 dt)^k in yaw."""
    team = team_of(*VEHICLES)
    targets = always(np.tile(omega, (len(VEHICLES), 1)), 60)
    flown = fly(hold_rates, rates.gains(), team, hovering(team), None, targets, control_hz=240)
    assert jnp.all((flown.rpm > 0) & (flown.rpm < team.max_rpm[None, :, None]))
    k = np.arange(1, 61)[:, None, None]
    expected = np.array(omega) * (1 - (1 - np.array([40, 40, 15]) / 240) ** k)
    np.testing.assert_allclose(flown.omega, np.broadcast_to(expected, flown.omega.shape), rtol=0, atol=1e-10)


@pytest.mark.slow
def test_the_collective_is_thrust_per_mass():
    team = team_of(*VEHICLES)
    for params in (one(team, i) for i in range(len(VEHICLES))):
        rpm = rates.follow(rates.gains(), params, one(hovering(team)), jnp.array(12.0), jnp.zeros(3))
        np.testing.assert_allclose(jnp.sum(params.kf * rpm**2), 12 * params.mass, rtol=1e-12)


@pytest.mark.slow
def test_every_vehicle_reaches_a_place_30_cm_off():
    error = reaches(rates, VEHICLES, (0.3, -0.3, 1.3), seconds=6, hz=240)
    assert np.all(error[3 * 240 - 1] < 0.01)
    assert np.all(error[-1] < 1e-4)  # m; measured: 5e-5


@pytest.mark.slow
def test_every_vehicle_recovers_from_straight_upside_down():
    """The quaternion error is largest there, while the geometric controller's would vanish."""
    team = team_of(*VEHICLES)
    start = hovering(team).replace(quat=jnp.broadcast_to(jnp.array([1.0, 0, 0, 0]), (len(VEHICLES), 4)))
    error = reaches(rates, VEHICLES, (0.0, 0.0, 1.0), seconds=6, hz=240, start=start)
    assert np.all(np.max(error, axis=0) < 2.2)  # m; measured: 1.5 to 1.9
    assert np.all(error[-1] < 0.01)


@pytest.mark.parametrize("yaw", mostly_slow([-2.0, 0.5, 3.0], [-2.0]))
def test_the_yaw_of_a_setpoint_is_turned_to(yaw):
    team = team_of(*VEHICLES)
    targets = always(at(len(VEHICLES), (0, 0, 1), yaw=yaw), 6 * 240)
    flown = fly(rates.control, rates.gains(), team, hovering(team), None, targets, control_hz=240)
    level = rotation.from_rpy(jnp.array([0, 0, yaw]))
    turned = 1 - jnp.abs(flown.quat[-1] @ level)  # an eighth of the squared angle
    assert jnp.all(turned < 0.01**2 / 8)


def hold_rates(gains, params, memory, state, omega, *, dt):
    return memory, rates.follow(gains, params, state, params.gravity, omega)


def test_the_inner_loop_compensates_the_gyroscopic_torque():
    """Without rotor lag the body takes exactly the angular acceleration of the gains, also in a fast tumble."""
    params, gains = jaxdrones.load_params("cf2x"), rates.gains()
    params = params.replace(inertia=jnp.array([1.4e-5, 1.8e-5, 2.17e-5]))
    omega, commanded = jnp.array([6.0, -5.0, 2.0]), jnp.array([6.5, -5.5, 2.2])
    state = State(jnp.zeros(3), jnp.array([0.0, 0, 0, 1]), jnp.zeros(3), omega, jnp.zeros(4))

    @jax.jit
    def turning(collective):
        rpm = rates.follow(gains, params, state, collective, commanded)
        return newton_euler(params, state, rotor_wrench(params, state.replace(rpm=rpm)))[1]

    np.testing.assert_allclose(turning(params.gravity), gains.rate * (commanded - omega), rtol=1e-9)
    np.testing.assert_array_equal(turning(-params.gravity), turning(0 * params.gravity))  # rotors cannot pull
