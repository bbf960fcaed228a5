from functools import partial

import golden_data
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop import hovering, one, reaches, recorded_vehicle, team_of
from helpers import jit_unoptimized

from jaxdrones import State
from jaxdrones.control import for_team, simple_pid
from jaxdrones.control.setpoint import Setpoint


@pytest.mark.parametrize("name", golden_data.names("last_rpy_e"))
def test_recorded_sequences_agree_in_speeds_and_memory(name):
    case = golden_data.load(name)
    rows = [jnp.asarray(case.arrays[key]) for key in ("pos", "quat", "target_pos")]
    memory, rpm = call_in_sequence(golden_data.unlimited(recorded_vehicle(case)), case.about["dt"], *rows)
    np.testing.assert_allclose(rpm, case.arrays["rpm"], rtol=0, atol=1e-6)  # RPM; measured: 2e-11
    np.testing.assert_allclose(memory.pos_integral, case.arrays["integral_pos_e"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(memory.rpy_integral, case.arrays["integral_rpy_e"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(memory.pos_error, case.arrays["last_pos_e"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(memory.rpy_error, case.arrays["last_rpy_e"], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_at_60_hz_a_hummingbird_reaches_a_place_30_cm_off():
    """A slow loop: sqrt(P / m) is 0.45 rad/s in x and y."""
    error = fly_30_cm(60, seconds=20)
    assert np.max(error) < 0.6
    assert error[-1] < 0.005  # measured: 0.4 mm


@pytest.mark.slow
def test_at_48_hz_a_hummingbird_with_its_own_inertia_is_not_stable():
    """Flights of gym-pybullet-drones at 48 Hz have the fivefold inertia that its engine made of the collision shape.

    With motors without a limit, as its controller has them.
    """
    assert np.max(fly_30_cm(48, seconds=10, max_rpm=np.inf)[-48:]) > 0.5  # measured: 0.9 m


@pytest.mark.slow
def test_the_first_call_kicks_and_the_second_does_not():
    """Derivatives are differences of errors, and the last error in a fresh memory is zero."""
    team = team_of("hb")
    params, state, memory = one(team), one(hovering(team)), simple_pid.init()
    error, dt = 0.01, 1 / 240
    forces = []
    for _ in range(2):
        setpoint = Setpoint.at(state.pos + jnp.array([0, 0, error]))
        memory, rpm = call(params, memory, state, setpoint, dt)
        forces.append(jnp.sum(params.kf * rpm**2) - params.weight)
    p, i, d = 0.2, 1e-4, 0.4
    expected = p * error + i * error * dt * np.array([1, 2]) + d * error / dt * np.array([1, 0])
    np.testing.assert_allclose(forces, expected, rtol=0, atol=1e-12)


def fly_30_cm(hz, seconds, **constants):
    """Distance from the target, m. The memory holds the first error, so there is no kick."""
    memory = for_team(simple_pid.init(), 1).replace(pos_error=jnp.array([[0.3, -0.3, 0.3]]))
    return reaches(simple_pid, ("hb",), (0.3, -0.3, 1.3), seconds, hz, memory=memory, **constants)


@jit_unoptimized
def call(params, memory, state, setpoint, dt):
    return simple_pid.control(simple_pid.gains(), params, memory, state, setpoint, dt=dt)


@jit_unoptimized
@partial(jax.vmap, in_axes=(None, None, 0, 0, 0))
def call_in_sequence(params, dt, pos, quat, target_pos):
    def advance(memory, row):
        pos, quat, target_pos = row
        state = State(pos, quat, jnp.zeros(3), jnp.zeros(3), jnp.zeros(4))
        memory, rpm = simple_pid.control(simple_pid.gains(), params, memory, state, Setpoint.at(target_pos), dt=dt)
        return memory, (memory, rpm)

    return jax.lax.scan(advance, simple_pid.init(), (pos, quat, target_pos))[1]
