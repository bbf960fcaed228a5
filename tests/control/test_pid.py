from functools import partial

import golden_data
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop import always, at, fly, hovering, one, reaches, recorded_vehicle, team_of
from helpers import jit_unoptimized
from scipy.spatial.transform import Rotation as scipy_rotation

import jaxdrones
from jaxdrones import State
from jaxdrones.control import for_team, pid
from jaxdrones.control.setpoint import Setpoint

INPUTS = ("pos", "quat", "vel", "target_pos", "target_rpy", "target_vel", "target_rpy_rates", "dt")


@pytest.mark.parametrize("name", golden_data.names("thrust_pwm"))
def test_recorded_single_calls_agree(name):
    """Also with many times between calls in one batch: `dt` may be an array."""
    case = golden_data.load(name)
    memory, rpm, (thrust, attitude) = call_fresh(recorded_vehicle(case), *inputs(case))
    np.testing.assert_allclose(rpm, case.arrays["rpm"], rtol=0, atol=1e-6)  # RPM; measured: 4e-12
    np.testing.assert_allclose(thrust, case.arrays["thrust_pwm"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(attitude, intrinsic_xyz(case.arrays["target_euler"]), rtol=0, atol=1e-9)
    np.testing.assert_allclose(memory.pos_integral, case.arrays["integral_pos_e"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(memory.rpy_integral, case.arrays["integral_rpy_e"], rtol=0, atol=1e-12)


@pytest.mark.float32
@pytest.mark.parametrize("name", golden_data.names("thrust_pwm"))
@pytest.mark.slow
def test_recorded_single_calls_agree_in_float32(name):
    case = golden_data.load(name)
    _, rpm, _ = call_fresh(recorded_vehicle(case), *inputs(case))
    # Three roundings of 22,000 RPM; most torques are saturated. Measured: 6e-3 RPM.
    np.testing.assert_allclose(rpm, case.arrays["rpm"], rtol=0, atol=2e-2)


@pytest.mark.parametrize("name", golden_data.names("last_rpy", "dt"))
def test_recorded_sequences_agree_in_speeds_and_memory(name):
    case = golden_data.load(name)
    keys = ("pos", "quat", "vel", "target_pos", "target_rpy", "target_vel")
    sequences = [jnp.asarray(case.arrays[key]) for key in keys]
    memory, rpm = call_in_sequence(recorded_vehicle(case), jnp.asarray(case.arrays["dt"]), *sequences)
    np.testing.assert_allclose(rpm, case.arrays["rpm"], rtol=0, atol=1e-6)  # RPM; measured: 7e-11
    np.testing.assert_allclose(memory.pos_integral, case.arrays["integral_pos_e"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(memory.rpy_integral, case.arrays["integral_rpy_e"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(memory.rpy, case.arrays["last_rpy"], rtol=0, atol=1e-12)


@pytest.mark.parametrize("hz", [pytest.param(120, marks=pytest.mark.slow), 240])
def test_a_place_30_cm_off_is_reached_and_the_rest_leaves_with_the_integral(hz):
    """Within 3 cm after one second; then the position integral unwinds with P / I = 8 s."""
    error = reaches(pid, ("cf2x", "cf2p"), (0.3, -0.3, 1.3), seconds=12, hz=hz)
    assert np.all(error[hz - 1] < 0.03)
    assert np.all(error[-1] < 0.01)
    np.testing.assert_allclose(error[-1] / error[-1 - 4 * hz], np.exp(-4 / 8), rtol=0.03)  # measured: 0.610 to 0.615


@pytest.mark.slow
def test_at_48_hz_it_is_in_a_limit_cycle_and_at_120_hz_it_is_not():
    """Hover after a push of 0.1 m/s. With its own small inertia the drone saturates the torque at 12 Hz."""
    ripple, lowest, highest = {}, {}, {}
    team = team_of("cf2x", "cf2p")
    start = hovering(team).replace(vel=jnp.full((2, 3), 0.1))
    for hz in (48, 120):
        targets = always(at(2, (0, 0, 1)), 12 * hz)
        rpm = fly(pid.control, pid.gains(), team, start, for_team(pid.init(), 2), targets, control_hz=hz).rpm[-2 * hz :]
        ripple[hz] = jnp.max(jnp.std(rpm, axis=0), axis=-1)
        lowest[hz], highest[hz] = jnp.min(rpm), jnp.max(rpm)
    assert jnp.all((ripple[48] > 700) & (ripple[48] < 1600))  # RPM; measured: 1330 and 846
    assert 12_700 < lowest[48] < 13_000 and 15_900 < highest[48] < 16_170  # gym-pybullet-drones' are 12,710 and 16,160
    assert jnp.all(ripple[120] < 1)  # RPM; measured: 5e-5


def test_it_never_leaves_the_range_of_its_motors():
    params = jaxdrones.load_params("cf2x")
    state = one(hovering(team_of("cf2x")))
    pos = jnp.asarray(np.random.default_rng(0).uniform(-50, 50, (100, 3)))
    _, rpm = jit_unoptimized(jax.vmap(lambda pos: call(params, state, Setpoint.at(pos))))(pos)
    lowest, highest = 0.2685 * np.array([20000, 65535]) + 4070.3
    np.testing.assert_allclose([jnp.min(rpm), jnp.max(rpm)], [lowest, highest], rtol=1e-12)


def test_its_integrals_stop_at_their_limits():
    params = jaxdrones.load_params("cf2x")
    state = one(hovering(team_of("cf2x"))).replace(quat=jnp.array([0.5, 0.5, 0.5, 0.5]))
    memory = jax.tree.map(lambda x: x + 1e6, pid.init())
    memory, _ = jit_unoptimized(call)(params, state, Setpoint.at(jnp.zeros(3)), memory)
    np.testing.assert_array_equal(memory.pos_integral, [2, 2, 0.15])
    np.testing.assert_array_equal(memory.rpy_integral, [1, 1, 1500])


def test_only_a_crazyflie_has_gains():
    with pytest.raises(ValueError, match="no PID gains for 'hb', only for cf2x, cf2p"):
        pid.gains("hb")


def call(params, state, setpoint, memory=None):
    memory = pid.init() if memory is None else memory
    return pid.control(pid.gains(), params, memory, state, setpoint, dt=1 / 240)


def inputs(case):
    return [jnp.asarray(case.arrays[key]) for key in INPUTS]


@jax.jit
@partial(jax.vmap, in_axes=(None, *len(INPUTS) * [0]))
def call_fresh(params, pos, quat, vel, target_pos, target_rpy, target_vel, target_rpy_rates, dt):
    state = State(pos, quat, vel, jnp.zeros(3), jnp.zeros(4))
    setpoint = Setpoint.at(target_pos, vel=target_vel, yaw=target_rpy[2], omega=target_rpy_rates)
    fresh = pid.init()
    memory, rpm = pid.control(pid.gains(), params, fresh, state, setpoint, dt=dt)
    _, thrust, target = pid.position_loop(pid.gains(), params, fresh, state, setpoint, dt)
    return memory, rpm, (thrust, jnp.stack(target, axis=-1))


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, *6 * [0]))
def call_in_sequence(params, dt, pos, quat, vel, target_pos, target_rpy, target_vel):
    def advance(memory, row):
        pos, quat, vel, target_pos, target_rpy, target_vel = row
        state = State(pos, quat, vel, jnp.zeros(3), jnp.zeros(4))
        setpoint = Setpoint.at(target_pos, vel=target_vel, yaw=target_rpy[2])
        memory, rpm = pid.control(pid.gains(), params, memory, state, setpoint, dt=dt)
        return memory, (memory, rpm)

    rows = pos, quat, vel, target_pos, target_rpy, target_vel
    return jax.lax.scan(advance, pid.init(), rows)[1]


def intrinsic_xyz(angles):
    """Rotation matrices Rx Ry Rz, as gym-pybullet-drones writes its target attitudes down."""
    return scipy_rotation.from_euler("XYZ", angles).as_matrix()
