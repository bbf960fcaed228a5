"""Equations 1 to 3 of the paper, and rotors that lag behind their command."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import VEHICLES

import jaxdrones
from jaxdrones import State, instant_rotors, lagging_rotors
from jaxdrones.dynamics import rotor_wrench

level = State(*(jnp.zeros(3), jnp.array([0.0, 0, 0, 1]), jnp.zeros(3), jnp.zeros(3)), rpm=jnp.zeros(4))


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_each_rotor_pushes_where_it_stands_and_twists_against_its_spin(vehicle):
    params = jaxdrones.load_params(vehicle)
    for i in range(4):
        rpm = jnp.zeros(4).at[i].set(params.hover_rpm)
        wrench = rotor_wrench(params, level.replace(rpm=rpm))
        force = np.array([0, 0, params.kf * params.hover_rpm**2])
        reaction = np.array([0, 0, params.rotor_spin[i] * params.km * params.hover_rpm**2])
        np.testing.assert_allclose(wrench.force, force, rtol=1e-14)
        np.testing.assert_allclose(wrench.torque, np.cross(params.rotor_pos[i], force) + reaction, rtol=1e-13, atol=0)


def test_equal_speeds_give_no_torque():
    for vehicle in VEHICLES:
        params = jaxdrones.load_params(vehicle)
        wrench = rotor_wrench(params, level.replace(rpm=jnp.full(4, params.max_rpm)))
        np.testing.assert_allclose(wrench.torque / params.max_xy_torque, 0, atol=1e-15)


def test_instant_rotors_turn_as_commanded():
    params, command = jaxdrones.load_params("cf2x"), jnp.arange(4.0)
    rpm, rate = instant_rotors(params, jnp.full(4, 9.0), command)
    np.testing.assert_array_equal(rpm, command)
    np.testing.assert_array_equal(rate, 0)


@pytest.mark.parametrize(
    ("start", "command", "time"), [(0.0, 1000.0, "rotor_rise_time"), (1000.0, 0.0, "rotor_fall_time")]
)
def test_lagging_rotors_close_the_gap_to_1_over_e_in_one_time_constant(start, command, time):
    """Integrated by RK4 in 100 steps, whose error is 1e-10 of the gap."""
    params = jaxdrones.load_params("cf2x")
    step = jaxdrones.make_step(
        rotors=lagging_rotors, integrator=jaxdrones.rk4, dt=float(getattr(params, time)) / 100, substeps=100
    )
    state = State.at_rest(np.zeros((1, 3))).replace(rpm=jnp.full((1, 4), start))
    after = step(jaxdrones.repeat(params, 1), state, jnp.full((1, 4), command))
    np.testing.assert_allclose((after.rpm - command) / (start - command), np.exp(-1), rtol=1e-8)


def test_lagging_rotors_rise_and_fall_with_their_own_time_constants():
    params = jaxdrones.load_params("cf2x")
    rpm, rate = lagging_rotors(params, jnp.array([100.0, 100, 100, 100]), jnp.array([150.0, 50, 100, 0]))
    np.testing.assert_array_equal(rpm, 100)
    np.testing.assert_allclose(rate, [50 / 0.055, -50 / 0.249, 0, -100 / 0.249], rtol=1e-12)


def test_thrust_of_rotors_that_stand_still_has_a_finite_gradient():
    params = jaxdrones.load_params("cf2x")
    gradient = jax.jacobian(lambda rpm: rotor_wrench(params, level.replace(rpm=rpm)).force)(jnp.zeros(4))
    np.testing.assert_array_equal(gradient, 0)
