import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones import State, load_params, repeat, rotation
from jaxdrones.sensing import Scene, photograph


def test_a_team_at_rest_is_level_and_still():
    pos = np.array([[0, 0, 1], [1, 2, 3]])
    state = State.at_rest(pos)
    np.testing.assert_array_equal(state.pos, pos)
    np.testing.assert_array_equal(state.quat, [[0, 0, 0, 1]] * 2)
    for still in state.vel, state.omega, state.rpm:
        np.testing.assert_array_equal(still, np.zeros((2, still.shape[1])))


def test_yaw_is_the_heading():
    yaw = np.array([0.5, -2.0])
    state = State.at_rest(np.zeros((2, 3)), yaw)
    np.testing.assert_allclose(jax.vmap(rotation.to_rpy)(state.quat), [[0, 0, 0.5], [0, 0, -2]], atol=1e-15)


def test_worlds_of_teams_at_rest_come_from_vmap():
    pos = jnp.arange(12.0).reshape(2, 2, 3)
    worlds = jax.vmap(State.at_rest)(pos)
    assert worlds.quat.shape == (2, 2, 4)
    np.testing.assert_array_equal(worlds.pos, pos)


def test_a_traced_height_may_stand_among_numbers():
    heights = jax.jit(lambda z: State.at_rest([[0, 0, z], [1, 0, 2.0]]).pos[:, 2])(1.5)
    np.testing.assert_array_equal(heights, [1.5, 2])


@pytest.mark.parametrize(
    ("pos", "yaw", "message"),
    [
        (np.zeros(3), None, r"pos has shape \(3,\); expected \(n, 3\).*per drone"),
        (np.zeros((2, 2)), None, r"pos has shape \(2, 2\); expected \(n, 3\)"),
        (np.zeros((2, 2, 3)), None, r"pos has shape \(2, 2, 3\); expected \(n, 3\)"),
        (np.zeros((0, 3)), None, r"pos has shape \(0, 3\).*at least one"),
        (np.zeros((2, 3)), np.zeros(3), r"yaw has shape \(3,\); expected \(2,\).*heading per drone"),
        (np.zeros((2, 3)), 0.5, r"yaw has shape \(\); expected \(2,\)"),
        ([[0, 0, np.nan]], None, r"pos is not finite.*nan.*give finite"),
        ([[0, 0, 1]], [np.inf], r"yaw is not finite.*inf"),
    ],
)
def test_a_bad_start_says_what_is_wrong(pos, yaw, message):
    with pytest.raises(ValueError, match=message):
        State.at_rest(pos, yaw)


@pytest.mark.parametrize("given", [None, jnp.zeros((1, 3))])
def test_what_is_not_a_state_is_no_team(given):
    with pytest.raises(ValueError, match=r"state is .*; give a jaxdrones\.State of a team"):
        photograph(Scene(), repeat(load_params("cf2x"), 1), given, (2.0, 0, 1), (0.0, 0, 1))
