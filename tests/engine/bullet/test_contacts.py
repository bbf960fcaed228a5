"""Contacts: who, where, how hard."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones
from jaxdrones import State
from jaxdrones.engine import bullet
from jaxdrones.sensing import Box, Cylinder, Scene, gate

pytestmark = pytest.mark.needs("pybullet")

CRAZYFLIE = jaxdrones.load_params("cf2x")
WEIGHT = float(CRAZYFLIE.weight)


@pytest.fixture(scope="module")
def step():
    scene = Scene.of(Cylinder(pos=(2, 0, 0.5), radius=0.2, height=1.0), Box(pos=(0, 3, 0.5), size=(0.5, 0.5, 1.0)))
    with bullet.make_step(scene=scene) as step:
        yield step


def settled(step, params, pos) -> State:
    state = State.at_rest(jnp.array(pos, float))
    for _ in range(240):
        state = step(params, state, np.zeros((len(pos), 4)))
    return state


def test_the_ground_carries_the_weight_of_a_drone_at_rest(step):
    params = jaxdrones.repeat(CRAZYFLIE, 1)
    contacts = step.contacts(params, settled(step, params, [[0, 0, 0.013]]))
    assert {(c.body, c.other) for c in contacts} == {("drone 0", "ground")}
    assert sum(c.force for c in contacts) == pytest.approx(WEIGHT, rel=0.02)
    for contact in contacts:
        assert contact.impulse == pytest.approx(contact.force / 240)
        np.testing.assert_allclose(contact.normal, [0, 0, 1], atol=1e-6)
        assert abs(contact.pos[2]) < 1e-3 and np.linalg.norm(contact.pos[:2]) < 0.07


def test_a_drone_on_top_of_another_presses_on_it(step):
    params = jaxdrones.repeat(CRAZYFLIE, 2)
    contacts = step.contacts(params, settled(step, params, [[0, 0, 0.0125], [0, 0, 0.0376]]))
    between = [c for c in contacts if "drone" in c.other]
    assert {frozenset((c.body, c.other)) for c in between} == {frozenset(("drone 0", "drone 1"))}
    assert sum(c.force for c in between) == pytest.approx(WEIGHT, rel=0.05)
    assert sum(c.force for c in contacts if c.other == "ground") == pytest.approx(2 * WEIGHT, rel=0.05)


def test_a_drone_that_flies_into_a_pole_touches_it(step):
    params = jaxdrones.repeat(CRAZYFLIE, 1)
    state = State.at_rest([[1.7405, 0, 0.6]]).replace(vel=jnp.array([[1.0, 0, 0]]))
    contacts = step.contacts(params, state)
    assert {(c.body, c.other) for c in contacts} == {("drone 0", "obstacle 1")}  # boxes come before cylinders
    assert contacts[0].normal[0] < -0.99 and contacts[0].force > 1.0


def test_nothing_touches_in_the_air(step):
    team = jaxdrones.repeat(CRAZYFLIE, 3)
    assert step.contacts(team, State.at_rest([[0, 0, 1], [0.3, 0, 1], [0, 0, 2]])) == []


def test_a_drone_flies_through_a_gate_and_not_through_its_frame():
    params = jaxdrones.repeat(CRAZYFLIE.replace(gravity=0.0), 1)
    with bullet.make_step(scene=Scene.of(gate((0, 0, 1), yaw=0.5))) as step:
        for aside, passes in (0.0, True), (0.28, False):
            forward, left = np.array([np.cos(0.5), np.sin(0.5), 0]), np.array([-np.sin(0.5), np.cos(0.5), 0])
            start = np.array([0, 0, 1.0]) - 0.3 * forward + aside * left
            state = State.at_rest(start[None]).replace(vel=jnp.array([2.0 * forward]))
            for _ in range(72):
                state = step(params, state, np.zeros((1, 4)))
            assert (float((state.pos[0] - np.array([0, 0, 1.0])) @ forward) > 0.2) == passes
