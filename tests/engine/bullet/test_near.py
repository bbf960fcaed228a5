"""Drones that can touch nothing stay out of Bullet's collision world, which changes no flight by a bit."""

from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones as jd
from jaxdrones import State, rotation
from jaxdrones.engine import bullet
from jaxdrones.engine.bullet.client import in_body
from jaxdrones.sensing import Box, Scene, Sphere, Urdf

pytestmark = pytest.mark.needs("pybullet")

TWO_BLOCKS = """<robot name="blocks"><link name="a">{0}</link><link name="b">{0}</link>
<joint name="j" type="fixed"><parent link="a"/><child link="b"/><origin xyz="0 0 1.2"/></joint></robot>"""
BLOCK = "<collision><geometry><box size='0.2 0.2 0.2'/></geometry></collision>"
SIDE, ABOVE = [[0.0, 0.0, 1.5], [0.6, 0.02, 1.51]], [[0.0, 0.0, 0.5], [4.0, 0.0, 0.4]]


def flight(step, pos, vel):
    """States, and touched bodies, of a team that coasts for a fifth of a second with the rotors at rest."""
    team = jd.repeat(jd.load_params("cf2x"), len(pos))
    state = State.at_rest(jnp.array(pos)).replace(vel=jnp.array(vel), omega=jnp.ones((len(pos), 3)))
    states, touched = [], set()
    for _ in range(48):
        state = step(team, state, np.zeros((len(pos), 4)))
        touched |= {contact.other for contact in step.contacts(team, state)}
        states.append(state)
    return states, touched


@pytest.mark.parametrize(
    ("solids", "pos", "vel", "touched"),
    [
        pytest.param((), ABOVE, [[1.0, 0, -4.0], [0, 0, -2.0]], "ground", marks=pytest.mark.slow),
        ((), SIDE, [[2.0, 0, 0], [-2.0, 0, 0]], "drone 1"),
        ((Box(pos=(0.5, 0, 1.5), size=(0.1, 9.0, 9.0)),), SIDE[:1], [[4.0, 0, 0]], "obstacle 0"),
        pytest.param(
            [Sphere(pos=(x, 0, 1.5), radius=0.1) for x in (9.0, 0.5)], SIDE[:1], [[4.0, 0, 0]], "obstacle 1",
            marks=pytest.mark.slow,
        ),
        ("urdf", SIDE[:1], [[4.0, 0, 0]], "obstacle 0"),
    ],
)  # fmt: skip
def test_a_flight_into_something_is_the_same_as_with_all_drones_in_the_collision_world(
    tmp_path, monkeypatch, solids, pos, vel, touched
):
    """From afar, over the first contact, and beyond; whatever it flies into, also a link of a file."""
    if solids == "urdf":
        (tmp_path / "blocks.urdf").write_text(TWO_BLOCKS.format(BLOCK))
        solids = (Urdf(pos=(0.5, 0, 0.3), path=tmp_path / "blocks.urdf"),)
    flights = []
    for everywhere in (False, True):
        with bullet.make_step(scene=Scene.of(*solids)) as step:
            if everywhere:
                monkeypatch.setattr(step.client, "_near", lambda team, loads: [True] * len(team))
            flights.append(flight(step, pos, vel))
    jax.tree.map(np.testing.assert_array_equal, *flights)
    assert touched in flights[0][1]


@pytest.mark.slow
def test_a_step_in_the_air_needs_six_calls_a_drone(monkeypatch):
    """Two set it, two push it, two read it; one is the step."""
    team, calls = jd.repeat(jd.load_params("cf2x"), 10), Counter()
    state = State.at_rest(np.arange(10)[:, None] * np.array([1.0, 0, 1.0]) + np.array([0, 0, 1.0]))
    with bullet.make_step() as step:
        step(team, step(team, state, state.rpm), state.rpm)

        class Counted:
            def __getattr__(self, name, p=step.client.p):
                calls[name] += callable(getattr(p, name))
                return getattr(p, name)

        monkeypatch.setattr(step.client, "p", Counted())
        step(team, state, state.rpm)
    assert calls.total() == 6 * 10 + 1 and calls["setCollisionFilterGroupMask"] == 0


def test_the_steps_of_a_crash_are_the_same_in_any_order():
    """Contacts are those of the pose alone, whether or not the drones touched something in the step before."""
    with bullet.make_step(scene=Scene.of(Box(pos=(0, 0, 0.3), size=(0.1, 0.1, 0.1)))) as step:
        states, touched = flight(step, [[0.0, 0.0, 0.5], [0.03, 0.0, 0.6]], [[0.5, 0, -4.0], [0.5, 0, -7.0]])
        team, still = jd.repeat(jd.load_params("cf2x"), 2), np.zeros((2, 4))
        after = {k: step(team, states[k], still) for k in np.random.default_rng(0).permutation(47)}
    for k, state in after.items():
        jax.tree.map(np.testing.assert_array_equal, state, states[k + 1])
    assert touched == {"obstacle 0", "drone 1"}


def test_angular_velocities_turn_into_the_body_frame():
    rows = np.random.default_rng(0).normal(size=(100, 7))
    quat, omega = rows[:, :4] / np.linalg.norm(rows[:, :4], axis=1, keepdims=True), rows[:, 4:]
    turned = [in_body(*row) for row in zip(quat.tolist(), omega.tolist(), strict=True)]
    np.testing.assert_allclose(turned, jax.vmap(rotation.rotate_inverse)(quat, omega), atol=1e-14)
