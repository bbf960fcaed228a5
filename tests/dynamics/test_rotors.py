"""Equations 1 to 3 of the paper, and rotors that lag behind their command."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import VEHICLES, assert_finite, name_of

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
    rpm, rate = instant_rotors(params, level, command)
    np.testing.assert_array_equal(rpm, command)
    np.testing.assert_array_equal(rate, 0)


@pytest.mark.parametrize("rotors", [instant_rotors, lagging_rotors], ids=name_of)
def test_rotors_turn_neither_backwards_nor_faster_than_they_can(rotors):
    params = jaxdrones.load_params("cf2x")
    state = level.replace(rpm=jnp.array([0.0, 5000, 10000, 20000]))
    command = jnp.array([-1000.0, 2 * params.max_rpm, jnp.inf, -jnp.inf])
    within = jnp.array([0, params.max_rpm, params.max_rpm, 0])
    for beyond, limit in zip(rotors(params, state, command), rotors(params, state, within), strict=True):
        np.testing.assert_array_equal(beyond, limit)


@pytest.mark.parametrize("rotors", [instant_rotors, lagging_rotors], ids=name_of)
def test_rotors_without_a_limit_follow_any_command_forwards_and_have_finite_gradients(rotors):
    """`max_rpm` is infinite for recordings of motors that were not limited."""
    params = jaxdrones.load_params("cf2x").replace(max_rpm=jnp.array(jnp.inf))
    command = jnp.array([1e5, 0.0, -1.0, 2e4])

    def sums(params, state, command):
        return sum(jnp.sum(x) for x in rotors(params, state, command))

    arguments = params, level.replace(rpm=jnp.full(4, 3e4)), command
    if rotors is instant_rotors:
        np.testing.assert_array_equal(rotors(*arguments)[0], [1e5, 0, 0, 2e4])
    gradients = jax.grad(sums, (0, 1, 2))(*arguments)
    assert_finite(gradients)
    np.testing.assert_array_equal(gradients[2] != 0, [True, True, False, True])


def test_a_command_beyond_the_limits_has_no_gradient_and_one_on_them_has():
    params = jaxdrones.load_params("cf2x")
    command = jnp.array([-1.0, 0.0, params.max_rpm, params.max_rpm + 1])
    gradient = jax.grad(lambda c: jnp.sum(instant_rotors(params, level, c)[0]))(command)
    np.testing.assert_array_equal(gradient, [0, 1, 1, 0])


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
    state = level.replace(rpm=jnp.full(4, 100.0))
    rpm, rate = lagging_rotors(params, state, jnp.array([150.0, 50, 100, 0]))
    np.testing.assert_array_equal(rpm, 100)
    np.testing.assert_allclose(rate, [50 / 0.055, -50 / 0.249, 0, -100 / 0.249], rtol=1e-12)


def test_thrust_of_rotors_that_stand_still_has_a_finite_gradient():
    params = jaxdrones.load_params("cf2x")
    gradient = jax.jacobian(lambda rpm: rotor_wrench(params, level.replace(rpm=rpm)).force)(jnp.zeros(4))
    np.testing.assert_array_equal(gradient, 0)
