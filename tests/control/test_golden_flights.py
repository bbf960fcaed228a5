"""Controllers along recorded flights: they are given the recorded states and have to command what was recorded.

Where gym-pybullet-drones flew at 48 Hz it was in a limit cycle, so only this comparison is well conditioned.
"""

from functools import partial

import golden_data
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop import control_team, recorded_vehicle
from helpers import jit_unoptimized

import jaxdrones
from jaxdrones import State, rotation
from jaxdrones.control import for_team, pid, simple_pid, velocity
from jaxdrones.control.setpoint import Setpoint

ATOL = 1e-6  # RPM; measured: 8e-11


# What is decimated lacks the rows between, of which a controller keeps something.
@pytest.mark.parametrize(
    "name", golden_data.names("target_pos", kind="closed_loop", vehicle=pid.VEHICLES, decimation=None)
)
def test_the_pid_commands_what_was_recorded(name):
    assert_commands(pid, golden_data.load(name))


@pytest.mark.parametrize("name", golden_data.names("target_pos", kind="closed_loop", vehicle="hb", decimation=None))
def test_the_simple_pid_commands_what_was_recorded(name):
    assert_commands(simple_pid, golden_data.load(name))


@pytest.mark.parametrize("name", golden_data.names("action", kind="closed_loop"))
def test_velocities_are_commanded_as_recorded(name):
    """gym-pybullet-drones asks its controller before it moves: first for no velocity at the initial state."""
    case = golden_data.load(name)
    arrays = case.arrays
    pos, quat, _, vel, omega, _ = np.split(arrays["initial_state"], np.cumsum([3, 4, 3, 3, 3]), axis=-1)
    first = np.concatenate([pos, quat, vel, omega], axis=-1)
    states = np.concatenate([first[None], arrays["state"][:-1]])
    actions = np.concatenate([np.zeros_like(arrays["action"][:1]), arrays["action"][:-1]])
    team, dt = team_and_dt(case)
    np.testing.assert_allclose(team.max_speed[0] * velocity.SPEED_SHARE, arrays["speed_limit"], rtol=1e-12)
    rpm = along(
        velocity.control, pid.gains(), team, for_team(pid.init(), len(team.mass)), states, jnp.array(actions), dt
    )
    np.testing.assert_allclose(clipped(case, rpm), arrays["rpm_applied"], rtol=0, atol=ATOL)


def assert_commands(controller, case):
    """After every step the controller is called for the next one; the last command was not flown."""
    arrays = case.arrays
    pos = jnp.asarray(arrays["target_pos"])
    vel = jnp.broadcast_to(jnp.asarray(arrays.get("target_vel", 0.0)), pos.shape)
    yaw = jnp.broadcast_to(jnp.asarray(arrays["target_rpy"][..., 2]), pos.shape[:-1])
    team, dt = team_and_dt(case)
    memory = for_team(controller.init(), len(team.mass))
    targets = Setpoint.at(pos, vel=vel, yaw=yaw)
    rpm = along(controller.control, controller.gains(), team, memory, arrays["state"], targets, dt)
    expected = np.concatenate([arrays["rpm_applied"][1:], arrays["rpm_final"][None]])
    np.testing.assert_allclose(clipped(case, rpm), clipped(case, expected), rtol=0, atol=ATOL)


def clipped(case, rpm):
    """As gym-pybullet-drones limits what its controllers command before it flies it."""
    return np.clip(rpm, 0, case.constants["max_rpm"])


def team_and_dt(case):
    params = golden_data.unlimited(recorded_vehicle(case))
    return jaxdrones.repeat(params, case.about["num_drones"]), 1 / case.about["control_freq_hz"]


@partial(jit_unoptimized, static_argnums=0)
def along(control, gains, team, memory, states, targets, dt):
    """The commands (length, n, 4) along recorded states (length, n, 13); the angular velocity there is in the world."""

    def advance(memory, row):
        columns, target = row
        pos, quat, vel, world_omega = jnp.split(columns, np.cumsum([3, 4, 3]), axis=-1)
        omega = jax.vmap(rotation.rotate_inverse)(quat, world_omega)
        state = State(pos, quat, vel, omega, jnp.zeros_like(quat))
        return control_team(control, gains, team, memory, state, target, dt=dt)

    return jax.lax.scan(advance, memory, (states, targets))[1]
