from functools import partial

import golden_data
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from closed_loop import mirrored, recorded_vehicle
from helpers import VEHICLES, assert_finite, jit_optimized, jit_unoptimized

import jaxdrones
from jaxdrones import State
from jaxdrones.control.allocation import mixer, rpm_from_wrench
from jaxdrones.dynamics.rotors import rotor_wrench

N = 200  # wrenches in a batch, as in the recorded cases

allocate = jax.jit(rpm_from_wrench)
differentiate = jit_unoptimized(jax.jacrev(rpm_from_wrench, argnums=(1, 2)))
allocate_all = jit_optimized(jax.vmap(rpm_from_wrench, (None, 0, 0)))

MIXERS = {  # columns roll, pitch, yaw; of gym-pybullet-drones
    "cf2x": [(-0.5, -0.5, -1), (-0.5, 0.5, 1), (0.5, 0.5, -1), (0.5, -0.5, 1)],
    "cf2x of the paper": [(0.5, -0.5, -1), (0.5, 0.5, 1), (-0.5, 0.5, -1), (-0.5, -0.5, 1)],
    "cf2p": [(0, -1, -1), (1, 0, 1), (0, 1, -1), (-1, 0, 1)],
}


@pytest.mark.parametrize("vehicle", MIXERS)
def test_the_mixer_follows_from_where_the_rotors_are(vehicle):
    params = jaxdrones.load_params(vehicle.split()[0])
    params = mirrored(params) if "paper" in vehicle else params
    np.testing.assert_allclose(mixer(params), MIXERS[vehicle], rtol=0, atol=1e-15)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_roll_pitch_and_yaw_of_the_mixer_turn_about_their_own_axis(vehicle):
    params = jaxdrones.load_params(vehicle)
    squares = params.hover_rpm**2 * (1 + 0.1 * mixer(params).T)
    wrench = wrenches_of(params, jnp.sqrt(squares))
    np.testing.assert_allclose(wrench.force[:, 2], params.weight, rtol=1e-12)
    torque = np.asarray(wrench.torque)
    assert np.all(np.diagonal(torque) > 0)
    np.testing.assert_allclose(torque, np.diag(np.diagonal(torque)), rtol=0, atol=1e-12 * np.min(np.diagonal(torque)))


@pytest.mark.parametrize("name", golden_data.names("infeasible"))
def test_recorded_allocations_agree(name):
    case = golden_data.load(name)
    action = jnp.asarray(case.arrays["action"])
    assert 0 < case.arrays["infeasible"].sum() < len(action)
    rpm = allocate_all(golden_data.unlimited(recorded_vehicle(case)), action[:, 0], action[:, 1:])
    np.testing.assert_allclose(rpm, case.arrays["rpm"], rtol=0, atol=1e-6)  # RPM; measured: 1e-11


@pytest.mark.float32
@pytest.mark.slow
@pytest.mark.parametrize("name", golden_data.names("infeasible"))
def test_recorded_allocations_agree_in_float32(name):
    case = golden_data.load(name)
    params = golden_data.unlimited(recorded_vehicle(case))
    action = jnp.asarray(case.arrays["action"])
    rpm = allocate_all(params, action[:, 0], action[:, 1:])
    # Thrusts are differences of terms of the size of the largest, so it is squares that agree: a few roundings of 6e-8.
    scale = np.max(case.arrays["rpm"] ** 2, axis=-1, keepdims=True)
    np.testing.assert_allclose(rpm**2 / scale, case.arrays["rpm"] ** 2 / scale, rtol=0, atol=2e-6)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_what_rotors_can_produce_is_produced(vehicle):
    """Also with rotors at rest, on the border of what is possible."""
    params = jaxdrones.load_params(vehicle)
    rng = np.random.default_rng(0)
    share = rng.uniform(0, 1, (N, 4)) * (rng.uniform(size=(N, 4)) < 0.8)
    wanted = wrenches_of(params, params.max_rpm * share)
    wrench = wrenches_of(params, allocate_all(params, wanted.force[:, 2], wanted.torque))
    np.testing.assert_allclose(wrench.force, wanted.force, rtol=0, atol=1e-12 * params.max_thrust)
    scale = jnp.stack([params.max_xy_torque, params.max_xy_torque, params.max_z_torque])
    np.testing.assert_allclose((wrench.torque - wanted.torque) / scale[None], 0, atol=1e-12)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_what_rotors_without_a_limit_cannot_is_missed_by_the_least_squares(vehicle):
    """SciPy minimises the same, and no step to squares that are not negative comes closer."""
    params = jaxdrones.load_params(vehicle)
    thrust, torque = wild_wrenches(params, seed=1)
    params = golden_data.unlimited(params)
    squares = np.asarray(allocate_all(params, thrust, torque)) ** 2
    matrix, target = least_squares_problem(params, thrust, torque)
    scale = np.max(np.abs(target), axis=-1)
    assert np.mean(np.any(np.linalg.solve(matrix, target.T) < 0, axis=0)) > 0.5, "most should be infeasible"

    for x, b, unit in zip(squares, target, scale, strict=True):
        expected, _ = scipy.optimize.nnls(matrix, b / unit)
        np.testing.assert_allclose(x / unit, expected, rtol=0, atol=1e-12)

    def miss(x):
        return np.linalg.norm(x @ matrix.T - target, axis=-1) / scale

    step = np.random.default_rng(2).normal(size=squares.shape) * scale[:, None]
    for size in (1e-1, 1e-3):
        assert np.all(miss(np.maximum(squares + size * step, 0)) >= miss(squares) - 1e-12)


def test_the_least_squares_hold_wherever_the_rotors_are():
    """Also without the symmetries of a vehicle, for which some sets of rotors have equal solutions."""
    rng = np.random.default_rng(7)
    params = jaxdrones.load_params("cf2x")
    thrust, torque = wild_wrenches(params, seed=8)
    for _ in range(5):
        moved = params.replace(rotor_pos=params.rotor_pos + 0.6 * params.arm * rng.uniform(-1, 1, (4, 3)))
        squares = np.asarray(allocate_all(golden_data.unlimited(moved), thrust, torque)) ** 2
        matrix, target = least_squares_problem(moved, thrust, torque)
        for x, b in zip(squares, target, strict=True):
            unit = np.max(np.abs(b))
            expected, _ = scipy.optimize.nnls(matrix, b / unit)
            np.testing.assert_allclose(x / unit, expected, rtol=0, atol=1e-12 * np.linalg.cond(matrix) ** 2)


@pytest.mark.float32
def test_a_rotor_that_hardly_turns_is_not_stopped_by_rounding():
    """The demand of an infeasible wrench, with squares of 1e-2 to 1e-6 of the largest on the border of standing still.

    A comparison of residuals, which are flat around their minimum, would be off by the root of the rounding.
    """
    params = golden_data.unlimited(jaxdrones.load_params("cf2x"))
    matrix, _ = least_squares_problem(params, np.zeros(1), np.zeros((1, 3)))
    small = np.logspace(-2, -6, N)
    squares = np.stack([np.ones(N), small, np.zeros(N), np.zeros(N)], axis=-1)
    slopes = np.array([0, 0, 0.3, 0.4])  # of the misfit in the squares of the rotors at rest
    target = squares @ matrix.T - np.linalg.solve(matrix.T, slopes)
    thrust, torque = wrenches_of_targets(params, 1e8 * target)
    found = np.asarray(allocate_all(params, thrust, torque)) ** 2 / 1e8
    np.testing.assert_allclose(found, squares, rtol=0, atol=2e-6)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_no_rotor_is_asked_for_more_than_its_highest_speed(vehicle):
    """However large the wrench, up to a thousand times the largest, and whatever the drone weighs."""
    params = jaxdrones.load_params(vehicle)
    thrust, torque = wild_wrenches(params, seed=5)
    for size in (1, 10, 1000):
        rpm = allocate_all(params.replace(mass=10 * params.mass), size * thrust, size * torque)
        assert jnp.all((rpm >= 0) & (rpm <= params.max_rpm))
        assert jnp.mean(jnp.any(rpm > 0.999 * params.max_rpm, axis=1)) > 0.3, "many should be at the limit"


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_yaw_is_given_up_first(vehicle):
    """Thrust, roll and pitch that the rotors can produce do not feel a demand for yaw that is too large."""
    params = jaxdrones.load_params(vehicle)
    wanted = wrenches_of(params, at_work(params))
    for yaw in (-100, -0.9, 0.9, 100):
        torque = wanted.torque.at[:, 2].set(yaw * params.max_z_torque)
        wrench = wrenches_of(params, allocate_all(params, wanted.force[:, 2], torque))
        np.testing.assert_allclose(wrench.force[:, 2] / params.max_thrust, wanted.force[:, 2] / params.max_thrust)
        scaled = (wrench.torque - wanted.torque)[:, :2] / params.max_xy_torque
        np.testing.assert_allclose(scaled, 0, atol=1e-12)
        share = wrench.torque[:, 2] / torque[:, 2]
        assert jnp.all((share > -1e-12) & (share < 1 + 1e-12)) and jnp.mean(share < 0.9) > 0.9


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_thrust_is_given_up_before_roll_and_pitch(vehicle):
    """As little of it as there must be: the fastest rotor is at its limit."""
    params = jaxdrones.load_params(vehicle)
    wanted = wrenches_of(params, at_work(params))
    for thrust in (1.2, 100):
        rpm = allocate_all(params, jnp.full(N, thrust * params.max_thrust), wanted.torque)
        scaled = (wrenches_of(params, rpm).torque - wanted.torque)[:, :2] / params.max_xy_torque
        np.testing.assert_allclose(scaled, 0, atol=1e-12 * thrust)
        np.testing.assert_allclose(jnp.max(rpm, axis=1), params.max_rpm)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_too_much_roll_and_pitch_keep_their_direction(vehicle):
    """With half of the highest thrust and a hundred times the torque: all that the rotors have."""
    params = jaxdrones.load_params(vehicle)
    angle = jnp.linspace(0, 2 * jnp.pi, N)
    torque = 100 * params.max_xy_torque * jnp.stack([jnp.cos(angle), jnp.sin(angle), 0 * angle], axis=1)
    rpm = allocate_all(params, jnp.full(N, params.max_thrust / 2), torque)
    wrench = wrenches_of(params, rpm)
    x, y, z = wrench.torque.T
    np.testing.assert_allclose(jnp.cos(jnp.arctan2(y, x) - angle), 1, atol=1e-12)
    np.testing.assert_allclose(z / params.max_z_torque, 0, atol=1e-12)
    np.testing.assert_allclose(wrench.force[:, 2], params.max_thrust / 2)
    np.testing.assert_allclose(jnp.max(rpm, axis=1), params.max_rpm)
    np.testing.assert_allclose(jnp.min(rpm, axis=1) / params.max_rpm, 0, atol=1e-7)


@pytest.mark.float32
@pytest.mark.parametrize("vehicle", VEHICLES)
def test_a_demand_of_thrust_far_beyond_reach_is_full_thrust_with_roll_and_pitch(vehicle):
    """In single precision the difference between demand and limit was lost, and the rotors stood still."""
    params = jaxdrones.load_params(vehicle)
    torque = jnp.array([0.05, -0.02, 0.3]) * params.max_xy_torque
    thrusts = params.max_thrust * jnp.logspace(3, 29, N)
    rpm = allocate_all(params, thrusts, jnp.broadcast_to(torque, (N, 3)))
    expected = allocate(params, 2 * params.max_thrust, torque)
    assert jnp.max(expected) == params.max_rpm
    np.testing.assert_allclose(rpm, np.broadcast_to(expected, rpm.shape), rtol=1e-4)  # roundings of 100 times the limit


def test_nothing_is_asked_of_rotors_that_should_pull():
    params = jaxdrones.load_params("cf2x")
    np.testing.assert_array_equal(allocate_all(params, jnp.full(N, -params.weight), jnp.zeros((N, 3))), 0)


@pytest.mark.parametrize("limit", [1.5, np.inf])
def test_rotor_speeds_are_continuous_where_a_wrench_stops_being_feasible(limit):
    """From hover to a torque far beyond it; the squares of a least-squares solution are Lipschitz in the target.

    With rotors of up to 1.5 times the hover speed, and with rotors without a limit.
    """
    params = jaxdrones.load_params("cf2x")
    params = params.replace(max_rpm=limit * params.hover_rpm)
    share = np.linspace(0, 3, 15 * N)
    thrust = jnp.full(N, params.weight)
    torque = share[:, None] * float(params.weight * params.arm) * np.array([[0.7, 0.5, 0.05]])
    rpm = np.concatenate([allocate_all(params, thrust, jnp.array(part)) for part in torque.reshape(-1, N, 3)])
    squares = (rpm / float(params.hover_rpm)) ** 2
    assert np.any(np.min(squares, axis=1) > 0.1) and np.any(np.min(squares, axis=1) == 0)
    assert np.max(np.abs(np.diff(squares, axis=0))) < 5 * 4 * (share[1] - share[0])


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", VEHICLES)
def test_gradients_of_the_allocation_agree_with_differences_in_and_out_of_reach(vehicle):
    params = jaxdrones.load_params(vehicle)
    thrust, torque = wild_wrenches(params, seed=3)
    unit = jnp.concatenate([params.max_thrust[None], jnp.full(2, params.max_xy_torque), params.max_z_torque[None]])
    wrenches = jnp.column_stack([thrust, torque]) / unit[None]
    # Away from where a rotor starts or stops: there the root has no derivative.
    rpm = allocate_all(params, thrust, torque)
    clear = np.asarray(jnp.all((rpm == 0) | (rpm > 0.05 * params.max_rpm), axis=1))
    reached = np.asarray(jnp.all(rpm > 0, axis=1))
    assert np.sum(clear & reached) >= 10 and np.sum(clear & ~reached) >= 10

    jacobian, differences = gradients_and_differences(params, unit, wrenches)
    # The squares are piecewise linear in the wrench, so only the rounding of 1e-16 / 1e-6 is left.
    np.testing.assert_allclose(jacobian[clear], differences[clear], rtol=0, atol=1e-8)


@pytest.mark.parametrize("thrust", [0.0, -0.1])
def test_gradients_of_the_allocation_are_zero_at_rest(thrust):
    params = jaxdrones.load_params("cf2x")
    for gradient in differentiate(params, jnp.array(thrust), jnp.zeros(3)):
        np.testing.assert_array_equal(gradient, 0)


@pytest.mark.slow
def test_gradients_of_the_allocation_are_finite_without_a_limit_and_with_equal_demands():
    params = jaxdrones.load_params("cf2x")
    slopes = jax.jit(jax.jacrev(rpm_from_wrench, argnums=(0, 1, 2)))
    for limit, thrust in (jnp.inf, params.weight), (1e3, params.weight), (2e4, params.max_thrust):
        for torque in jnp.zeros(3), jnp.full(3, 1e-3):
            assert_finite(slopes(params.replace(max_rpm=jnp.asarray(limit, float)), thrust, torque))


@pytest.mark.slow
def test_a_vehicle_whose_rotors_have_no_drag_ignores_the_demand_of_yaw():
    """Its parameters are allowed; thrust, roll and pitch are those without the demand, and so are gradients."""
    params = jaxdrones.load_params("cf2x").replace(km=jnp.zeros(()))
    torque = jnp.array([1e-4, -2e-4, 1e-3])
    rpm = allocate(params, params.weight, torque)
    np.testing.assert_array_equal(rpm, allocate(params, params.weight, torque.at[2].set(0)))
    wrench = wrenches_of(params, rpm[None])
    np.testing.assert_allclose(wrench.force[0, 2], params.weight, rtol=1e-9)
    np.testing.assert_allclose(wrench.torque[0, :2], torque[:2], rtol=1e-9)
    assert_finite(differentiate(params, params.weight, torque))


@pytest.mark.slow
def test_compiled_and_batched_allocations_equal_single_ones():
    params = jaxdrones.load_params("racer")
    thrust, torque = wild_wrenches(params, seed=4)
    batched = allocate_all(params, thrust, torque)
    for i in range(5):
        squares = rpm_from_wrench(params, thrust[i], torque[i]) ** 2 / params.max_rpm**2
        for other in batched[i], allocate(params, thrust[i], torque[i]):  # sums in another order
            np.testing.assert_allclose(other**2 / params.max_rpm**2, squares, rtol=0, atol=1e-14)


@jax.jit
@partial(jax.vmap, in_axes=(None, 0))
def wrenches_of(params, rpm):
    zero = jnp.zeros(3)
    return rotor_wrench(params, State(zero, jnp.array([0.0, 0, 0, 1]), zero, zero, rpm))


@jit_unoptimized
@partial(jax.vmap, in_axes=(None, None, 0))
def gradients_and_differences(params, unit, wrench):
    """Of the squares of the rotor speeds in the wrench, both in units of the highest."""

    def squares(wrench):
        return (rpm_from_wrench(params, wrench[0] * unit[0], wrench[1:] * unit[1:]) / params.max_rpm) ** 2

    h = 1e-6
    there, back = (jax.vmap(squares)(wrench[None] + sign * h * jnp.eye(4)) for sign in (1, -1))
    return jax.jacrev(squares)(wrench), (there - back).T / (2 * h)


def at_work(params):
    """Rotor speeds (N, 4) without yaw torque."""
    rng = np.random.default_rng(6)
    middle = rng.uniform(0.1, 0.9, (N, 1))
    a, b = (0.99 * np.minimum(middle, 1 - middle) * rng.uniform(-1, 1, (N, 1)) for _ in range(2))
    return params.max_rpm * np.sqrt(np.hstack([middle + a, middle + b, middle - a, middle - b]))


def wild_wrenches(params, seed):
    """Thrusts from below zero to the highest and torques up to the largest, most of them together infeasible."""
    rng = np.random.default_rng(seed)
    thrust = params.max_thrust * rng.uniform(-0.1, 1, N)
    limits = np.array([params.max_xy_torque, params.max_xy_torque, params.max_z_torque])
    return thrust, jnp.asarray(rng.uniform(-1, 1, (N, 3)) * limits)


def wrenches_of_targets(params, target):
    """Thrust and torque with b, the inverse of `least_squares_problem`."""
    scale = np.array([params.kf, params.kf * params.arm, params.kf * params.arm, params.km])
    return jnp.asarray(scale[0] * target[:, 0]), jnp.asarray(scale[1:] * target[:, 1:])


def least_squares_problem(params, thrust, torque):
    """A and b of A x = b in squares of RPM, as gym-pybullet-drones weighs its rows."""
    x, y, _ = np.asarray(params.rotor_pos).T
    arm = np.mean(np.hypot(x, y))
    matrix = np.stack([np.ones(4), y / arm, -x / arm, np.asarray(params.rotor_spin)])
    scale = np.array([params.kf, params.kf * arm, params.kf * arm, params.km])
    return matrix, np.column_stack([thrust, torque]) / scale
