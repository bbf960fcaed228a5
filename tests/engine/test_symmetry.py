"""Physics does not care where the axes point."""

import jax
import jax.numpy as jnp
import pytest
from helpers import VEHICLES, assert_close, assert_same_motion, fly, flying, make_step, tape, to_world
from scipy.spatial.transform import Rotation

import jaxdrones
from jaxdrones import (
    State,
    downwash,
    downwash_2021,
    drag,
    drag_world_axes,
    ground_effect,
    ground_effect_2021,
    rotation,
)

ROUND_OFF = 1e-10  # float64 over 0.4 s, in which a tumbling drone amplifies what is rounded

team = jaxdrones.stack([jaxdrones.load_params(vehicle) for vehicle in ("cf2x", "cf2p", "cf2x")])
start = flying(team).replace(pos=jnp.array([[0.0, 0, 0.3], [0.03, 0.02, 0.6], [0.2, -0.1, 1.0]]))
command = tape(team, 100)
windy = team.replace(wind=jnp.tile(jnp.array([[2.0, -1, 0.5]]), (3, 1)))

SMOOTH = (drag, ground_effect), (downwash,)
PAPER = (drag_world_axes, ground_effect_2021), (downwash_2021,)


def turned(q, states: State) -> State:
    """The same motion seen in a world that is turned by q."""
    return states.replace(
        pos=to_world(rotation.rotate, q, states.pos),
        quat=to_world(rotation.multiply, q, states.quat),
        vel=to_world(rotation.rotate, q, states.vel),
    )


def mirrored(states: State) -> State:
    """The same motion in a mirror on the plane y = 0: y turns round, and so do rotations about x and z."""
    vector, axial = jnp.array([1.0, -1, 1]), jnp.array([-1.0, 1, -1])
    return State(
        pos=_times(states.pos, vector),
        quat=_times(states.quat, jnp.append(axial, 1.0)),
        vel=_times(states.vel, vector),
        omega=_times(states.omega, axial),
        rpm=states.rpm,
    )


def turned_wind(q, params):
    return params.replace(wind=to_world(rotation.rotate, q, params.wind))


def _times(x, signs):
    return x * jnp.broadcast_to(signs, x.shape)


@pytest.mark.slow
@pytest.mark.parametrize(("effects", "pairs"), [SMOOTH, PAPER], ids=["smooth", "paper"])
def test_turning_the_world_about_the_vertical_turns_the_flight(effects, pairs):
    """The paper's drag has equal coefficients along x and y, so it does not notice either."""
    step = make_step(effects, pairs)
    q = jnp.array(Rotation.from_rotvec([0, 0, 1.1]).as_quat())
    flown = fly(step, turned_wind(q, windy), turned(q, start), command)
    assert_same_motion(flown, turned(q, fly(step, windy, start, command)), ROUND_OFF)


@pytest.mark.slow
def test_moving_the_world_sideways_moves_the_flight():
    step = make_step(*SMOOTH)
    shift = jnp.array([5.0, -7.0, 0.0])
    moved = fly(step, windy, start.replace(pos=start.pos + shift[None]), command)
    here = fly(step, windy, start, command)
    assert_close(moved, here.replace(pos=here.pos + shift[None, None]), ROUND_OFF)


@pytest.mark.slow
def test_without_gravity_and_ground_there_is_no_up():
    """Drag acts in the body frame and the jet along a thrust axis, so any rotation and shift will do."""
    step = make_step((drag,), (downwash,))
    free = windy.replace(gravity=jnp.zeros(3))
    q = jnp.array(Rotation.random(rng=0).as_quat())
    shift = jnp.array([1.0, 2.0, -30.0])
    there = turned(q, start)
    flown = fly(step, turned_wind(q, free), there.replace(pos=there.pos + shift[None]), command)
    expected = turned(q, fly(step, free, start, command))
    assert_same_motion(flown, expected.replace(pos=expected.pos + shift[None, None]), ROUND_OFF)


@pytest.mark.parametrize(
    ("effects", "pairs"), [SMOOTH, pytest.param(*PAPER, marks=pytest.mark.slow)], ids=["smooth", "paper"]
)
def test_a_mirrored_team_flies_the_mirrored_flight(effects, pairs):
    """A vehicle in the mirror has its rotors on the other side, turning the other way."""
    step = make_step(effects, pairs)
    sides = jnp.array([1.0, -1, 1])
    in_mirror = windy.replace(
        rotor_pos=windy.rotor_pos * sides[None, None], rotor_spin=-windy.rotor_spin, wind=windy.wind * sides[None]
    )
    flown = fly(step, in_mirror, mirrored(start), command)
    assert_same_motion(flown, mirrored(fly(step, windy, start, command)), ROUND_OFF)


@pytest.mark.parametrize("vehicle", ["cf2x", "racer"])
@pytest.mark.slow
def test_a_cross_is_its_own_mirror_image(vehicle):
    """Left and right rotors of an x frame change places; the spins already fit."""
    step = make_step((drag, ground_effect))
    pair = jaxdrones.repeat(jaxdrones.load_params(vehicle), 2)
    states, rpm = flying(pair), tape(pair, 100)
    swap = jnp.array([3, 2, 1, 0])
    in_mirror = mirrored(states).replace(rpm=states.rpm[:, swap])
    flown = fly(step, pair, in_mirror, rpm[..., swap])
    expected = mirrored(fly(step, pair, states, rpm))
    assert_same_motion(flown, expected.replace(rpm=expected.rpm[..., swap]), ROUND_OFF)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_a_quarter_turn_of_the_numbering_changes_nothing(vehicle):
    """Rotors may be listed in any order."""
    step = make_step((drag, ground_effect))
    drone = jaxdrones.repeat(jaxdrones.load_params(vehicle), 1)
    states, rpm = flying(drone), tape(drone, 100)
    order = jnp.array([1, 2, 3, 0])
    renumbered = drone.replace(rotor_pos=drone.rotor_pos[:, order], rotor_spin=drone.rotor_spin[:, order])
    flown = fly(step, renumbered, states.replace(rpm=states.rpm[:, order]), rpm[..., order])
    expected = fly(step, drone, states, rpm)
    assert_close(flown, expected.replace(rpm=expected.rpm[..., order]), ROUND_OFF)


def test_drones_may_be_listed_in_any_order():
    step = make_step(*SMOOTH)
    order = jnp.array([2, 0, 1])
    team_, start_ = jax.tree.map(lambda x: x[order], (windy, start))
    flown = fly(step, team_, start_, command[:, order])
    assert_close(flown, jax.tree.map(lambda x: x[:, order], fly(step, windy, start, command)), ROUND_OFF)
