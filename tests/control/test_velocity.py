from functools import partial

import golden_data
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop import always, fly, hovering, one, recorded_vehicle, team_of
from helpers import jit_unoptimized

from jaxdrones import State
from jaxdrones.control import for_team, pid, velocity


@pytest.mark.parametrize("name", golden_data.names("action", "rpm", speed_limit=float))
def test_recorded_sequences_agree(name):
    case = golden_data.load(name)
    rows = [jnp.asarray(case.arrays[key]) for key in ("pos", "quat", "vel", "action")]
    rpm = call_in_sequence(recorded_vehicle(case), case.about["control_dt"], *rows)
    np.testing.assert_allclose(rpm, case.arrays["rpm"], rtol=0, atol=1e-6)  # RPM; measured: 3e-11


@pytest.mark.parametrize("direction", [(1, 0, 0), (-2, 1, 0), (0.1, 0.2, -0.3)])
@pytest.mark.parametrize("share", [1.0, -0.4])
@pytest.mark.slow
def test_the_speed_becomes_the_asked_share_of_the_limit(direction, share):
    """Crazyflies: 0.25 m/s, 3 % of 30 km/h. Any length of the direction and either sign of the share will do."""
    team = team_of("cf2x", "cf2p")
    action = np.tile([*direction, share], (2, 1))
    flown = fly(
        velocity.control,
        pid.gains(),
        team,
        hovering(team),
        for_team(pid.init(), 2),
        always(action, 720),
        control_hz=120,
    )
    expected = 0.25 * abs(share) * np.array(direction) / np.linalg.norm(direction)
    # After 6 s; the closed loop's time constant is m / D = 0.135 s.
    np.testing.assert_allclose(flown.vel[-1], np.broadcast_to(expected, (2, 3)), rtol=0, atol=1e-4)


@pytest.mark.slow
def test_zero_stops_a_drone_and_keeps_its_heading():
    team = team_of("cf2x", "cf2p")
    start = hovering(team).replace(vel=jnp.broadcast_to(jnp.array([0.2, -0.1, 0.1]), (2, 3)))
    start = start.replace(quat=jnp.broadcast_to(jnp.array([0, 0, np.sin(0.3), np.cos(0.3)]), (2, 4)))
    memory = for_team(pid.init(), 2).replace(
        rpy=jnp.broadcast_to(jnp.array([0, 0, 0.6]), (2, 3))
    )  # so the first rate is not a kick
    targets = always(np.zeros((2, 4)), 720)
    flown = fly(velocity.control, pid.gains(), team, start, memory, targets, control_hz=120)
    np.testing.assert_allclose(flown.vel[-1], 0, atol=1e-4)
    np.testing.assert_allclose(2 * jnp.arctan2(flown.quat[-1, :, 2], flown.quat[-1, :, 3]), 0.6, rtol=0, atol=0.05)


def test_the_length_of_the_direction_and_the_sign_of_the_share_do_not_matter():
    team = team_of("cf2x")
    state = hovering(team)
    call = jit_unoptimized(
        lambda action: velocity.control(pid.gains(), one(team), pid.init(), one(state), action, dt=jnp.array(1 / 48))[1]
    )
    rpm = call(jnp.array([0.3, -0.4, 0.5, 0.7]))
    np.testing.assert_allclose(call(jnp.array([3.0, -4.0, 5.0, -0.7])), rpm, rtol=0, atol=1e-8)
    assert jnp.max(jnp.abs(call(jnp.array([0.3, -0.4, 0.5, 0.2])) - rpm)) > 1


@jit_unoptimized
@partial(jax.vmap, in_axes=(None, None, 0, 0, 0, 0))
def call_in_sequence(params, dt, pos, quat, vel, action):
    def advance(memory, row):
        pos, quat, vel, action = row
        state = State(pos, quat, vel, jnp.zeros(3), jnp.zeros(4))
        return velocity.control(pid.gains(), params, memory, state, action, dt=dt)

    return jax.lax.scan(advance, pid.init(), (pos, quat, vel, action))[1]
