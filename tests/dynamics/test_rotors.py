"""Equations 1 to 3 of the paper, and rotors that lag behind their command."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import VEHICLES, assert_finite, jit_unoptimized, mostly_slow, name_of

import jaxdrones
from jaxdrones import State, instant_rotors, lagging_rotors
from jaxdrones.dynamics.rotors import lost_share, rotor_reaction, rotor_wrench

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


def test_thrusts_and_drag_torques_are_proportional_to_the_density_of_the_air():
    params = jaxdrones.load_params("cf2x")
    state = State(*(jnp.zeros(k) for k in (3, 4, 3, 3)), rpm=jnp.array([9e3, 1e4, 1.2e4, 1.4e4]))
    thick, thin = (rotor_wrench(params.replace(air_density=k * params.air_density), state) for k in (1, 0.6))
    np.testing.assert_allclose(thin.force, 0.6 * thick.force, rtol=1e-12)
    np.testing.assert_allclose(thin.torque, 0.6 * thick.torque, rtol=1e-12)
    assert (jnp.abs(thick.torque) > 1e-4).all()


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
    gradients = jit_unoptimized(jax.grad(sums, (0, 1, 2)))(*arguments)
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


def spinning(rotors, integrator, rotor_spin=None, **aerodynamics):
    """A team of one in weightless, airless space with rotors that have inertia, and its step."""
    team = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 1)
    none = dict(gravity=jnp.zeros(1), kf=1e-30 * team.kf, km=1e-30 * team.km, rotor_inertia=jnp.full(1, 3e-8))
    team = team.replace(**none | aerodynamics)
    team = team if rotor_spin is None else team.replace(rotor_spin=jnp.array([rotor_spin]))
    return team, jaxdrones.make_step(rotors=rotors, integrator=integrator, dt=1e-3, substeps=20)


def total_angular_momentum(team, state):
    """Of body and rotors, world, kg m^2/s."""
    params, state = jax.tree.map(lambda x: x[0], (team, state))
    rotors = -params.rotor_inertia * 2 * np.pi / 60 * np.sum(params.rotor_spin * state.rpm)
    return jaxdrones.rotation.rotate(state.quat, params.inertia * state.omega + jaxdrones.vector.along_z(rotors))


@pytest.mark.parametrize("rotors", mostly_slow([instant_rotors, lagging_rotors], [lagging_rotors]), ids=name_of)
def test_a_change_of_rotor_speed_turns_the_body_as_angular_momentum_demands(rotors):
    """Without aerodynamic torque; the four rotors turn the same way, so that their momenta add up."""
    team, step = spinning(rotors, jaxdrones.rk4, rotor_spin=[1.0, 1, 1, 1])
    start = State.at_rest(np.zeros((1, 3)))
    after = step(team, start, jnp.full((1, 4), 2e4))
    turned = team.rotor_inertia * 2 * np.pi / 60 * 4 * after.rpm[:, 0] / team.inertia[:, 2]
    assert after.rpm[0, 0] > 1000
    np.testing.assert_allclose(after.omega, [[0, 0, turned[0]]], rtol=1e-9, atol=1e-30)
    np.testing.assert_allclose(total_angular_momentum(team, after), 0, atol=1e-9 * 4 * 3e-8 * 2e3)


@pytest.mark.slow
def test_a_tumbling_drone_with_spinning_rotors_keeps_its_angular_momentum():
    """Gyroscopic torque of rotors about a body that turns about all axes; rk4 is exact to 1e-9 here."""
    team, step = spinning(lagging_rotors, jaxdrones.rk4, rotor_spin=[1.0, -1, 1, 1])
    start = State.at_rest(np.zeros((1, 3))).replace(omega=jnp.array([[3.0, -2, 1]]), rpm=jnp.full((1, 4), 1e4))
    after = start
    for _ in range(5):
        after = step(team, after, jnp.array([[2e4, 5e3, 1e4, 1.5e4]]))
    before = total_angular_momentum(team, start)
    np.testing.assert_allclose(total_angular_momentum(team, after), before, atol=1e-9 * float(jnp.linalg.norm(before)))
    without = step(team.replace(rotor_inertia=jnp.zeros(1)), start, jnp.full((1, 4), 1e4))
    assert np.abs(step(team, start, jnp.full((1, 4), 1e4)).omega - without.omega).max() > 0.01


def test_turning_the_spinning_rotors_takes_the_torque_that_angular_momentum_demands():
    """The torque on the body is minus the rate of h in the world, -(h' + omega x h), with h of all rotors along z."""
    params = jaxdrones.load_params("cf2x").replace(rotor_inertia=jnp.array(3e-8))
    omega, rpm, rate = np.array([1.0, -2, 3]), np.array([1e4, 2e4, 3e4, 5e4]), np.array([1e3, -2e3, 5e3, 7e3])
    state = State(*(jnp.zeros(3), jnp.array([0.0, 0, 0, 1]), jnp.zeros(3)), jnp.array(omega), jnp.asarray(rpm))
    h, h_rate = (-3e-8 * 2 * np.pi / 60 * np.sum(np.asarray(params.rotor_spin) * x) for x in (rpm, rate))
    expected = -np.array([0, 0, h_rate]) - np.cross(omega, [0, 0, h])
    torque = rotor_reaction(params, state, jnp.array(rate)).torque
    np.testing.assert_allclose(torque, expected, rtol=1e-12)


def test_the_lost_share_is_linear_up_to_one_half_and_never_reaches_one():
    """Its slope is one where the limit sets in, from both sides; in single precision far losses round to one."""
    share = jax.jit(jax.vmap(jax.value_and_grad(lost_share)))
    small, far = np.linspace(-0.5, 0.5, 11), np.array([0.75, 1.5, 10.0])
    np.testing.assert_array_equal(share(small)[0], small)
    np.testing.assert_allclose(share(far)[0], 1 - np.exp([-0.5, -2, -19]) / 2, rtol=1e-12)
    np.testing.assert_array_equal(share(-far)[0], -share(far)[0])
    slopes = share(np.array([-1e9, -0.5, 0.0, 0.5, 0.5 + 1e-12, 1e9]))[1]
    np.testing.assert_allclose(slopes, [0, 1, 1, 1, 1, 0], rtol=1e-9)
