"""Forces of contact are estimated from the motion of a log."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones as jd
from jaxdrones.dynamics.contact import rim
from jaxdrones.flights.log import FlightLog
from jaxdrones.sensing import Box, Scene
from jaxdrones.visualization.viewer import contacts
from jaxdrones.visualization.viewer.contacts import contact_forces

PARAMS = jd.repeat(jd.load_params("cf2x"), 2)
WEIGHT = float(PARAMS.mass[0] * PARAMS.gravity[0])
REST = float(rim(jd.load_params("cf2x"))[0] - PARAMS.collision_offset[0])  # m: height at which the rim is on the ground


def log_at(heights, thrust=0.0, scene=None, speed=(0.0, 0.0)):
    """Log of two drones at constant heights, with a thrust in weights and a velocity along x that grows with time."""
    t = 0.01 * np.arange(5)
    pos = np.stack([np.broadcast_to([i, 0.0, height], (5, 3)) for i, height in enumerate(heights)], axis=1)
    vel = t[:, None, None] * np.array([[[speed[0], 0, 0], [speed[1], 0, 0]]])
    rpm = np.broadcast_to(np.sqrt(thrust) * np.asarray(PARAMS.hover_rpm)[:, None], (5, 2, 4))
    quat = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (5, 2, 4))
    return FlightLog(t, pos, quat, vel, np.zeros((5, 2, 3)), rpm, params=PARAMS, scene=scene or Scene())


@pytest.mark.parametrize("thrust", [0.0, 0.6])
def test_the_ground_carries_what_thrust_does_not(thrust):
    forces = contact_forces(log_at([REST, 1.0], thrust))
    np.testing.assert_allclose(forces[:, 0], np.broadcast_to([0, 0, (1 - thrust) * WEIGHT], (5, 3)), atol=1e-3 * WEIGHT)
    np.testing.assert_array_equal(forces[:, 1], 0)  # in the air


def test_the_ground_carries_more_in_thin_air():
    log = log_at([REST, 1.0], thrust=0.6)
    thin = contact_forces(dataclasses.replace(log, params=PARAMS.replace(air_density=0.5 * PARAMS.air_density)))
    np.testing.assert_allclose(thin[:, 0, 2], (1 - 0.5 * 0.6) * WEIGHT, rtol=1e-3)


def test_the_force_of_contact_accelerates_the_drone():
    forces = contact_forces(log_at([REST, REST], 1.0, speed=(-5.0, 0.0)))
    np.testing.assert_allclose(forces[:, 0], np.broadcast_to([-5.0 * PARAMS.mass[0], 0, 0], (5, 3)), atol=1e-3 * WEIGHT)


def test_only_a_surface_that_is_touched_exerts_a_force():
    table = Scene.of(Box(pos=(0.0, 0.0, 0.4), size=(1.0, 1.0, 0.2)), ground=False)
    on_table = contact_forces(log_at([0.5 + REST, 0.5 + REST], scene=table))
    assert (on_table[:, 0, 2] > 0.9 * WEIGHT).all() and (on_table[:, 1] == 0).all()  # the second is beside it
    assert contact_forces(log_at([REST, REST], scene=Scene(ground=False))) is None
    assert contact_forces(log_at([0.5, 1.0])) is None
    assert contact_forces(dataclasses.replace(log_at([REST, 1.0]), rpm=np.full((5, 2, 4), np.nan))) is None


def test_the_rim_is_where_the_offset_of_the_collision_shape_says():
    offset = np.float32(0.03)
    log = log_at([REST + float(PARAMS.collision_offset[0]) + offset] * 2)
    quat = log.quat.copy()
    quat[:, 0] = [1.0, 0.0, 0.0, 0.0]  # upside down: the shape is below the center of mass
    log = dataclasses.replace(log, quat=quat, params=PARAMS.replace(collision_offset=jnp.full(2, offset)))
    forces = contact_forces(log)
    assert (forces[:, 0, 2] > 0.9 * WEIGHT).all() and (forces[:, 1] == 0).all()


@pytest.mark.slow
def test_a_drone_that_lies_on_the_simulated_ground_has_its_force():
    step = jd.make_step(effects=(jd.ground_contact,), dt=1 / 240)
    start = jd.State.at_rest(jnp.array([[0.0, 0.0, REST + 0.002], [0.0, 1.0, 1.0]]))

    def stopped(params, memory, state, k):
        return memory, jnp.zeros((2, 4))

    _, states = jax.jit(lambda: jd.rollout(step, stopped, PARAMS, start, None, length=200))()
    arrays = {name: np.asarray(getattr(states, name)) for name in ("pos", "quat", "vel", "omega", "rpm")}
    forces = contact_forces(FlightLog(np.arange(1, 201) / 240, **arrays, params=PARAMS))
    np.testing.assert_allclose(forces[-1, 0], [0, 0, WEIGHT], atol=0.02 * WEIGHT)
    assert (forces[:100, 1] == 0).all()  # it falls until then


@pytest.mark.slow
def test_two_drones_that_collide_exert_opposite_forces_while_they_touch():
    step = jd.make_step(effects=(), pairs=(jd.drone_contact,), dt=1 / 240)
    rpm = np.asarray(PARAMS.hover_rpm)[:, None] * np.ones((2, 4))
    start = jd.State.at_rest(jnp.array([[0.0, 0.0, 1.0], [0.3, 0.0, 1.0]]))
    start = start.replace(vel=jnp.array([[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0]]), rpm=jnp.asarray(rpm))

    def hovering(params, memory, state, k):
        return memory, jnp.asarray(rpm)

    _, states = jax.jit(lambda: jd.rollout(step, hovering, PARAMS, start, None, length=100))()
    arrays = {name: np.asarray(getattr(states, name)) for name in ("pos", "quat", "vel", "omega", "rpm")}
    log = FlightLog(np.arange(1, 101) / 240, **arrays, params=PARAMS)
    forces = contact_forces(log)
    np.testing.assert_allclose(forces[:, 0], -forces[:, 1], atol=1e-6 * WEIGHT)  # Newton's third law
    assert (forces[:, 0, 0] <= 0).all() and forces[:, 0, 0].min() < -WEIGHT
    impulse = np.sum(forces[:, 0, 0]) / 240
    assert impulse == pytest.approx(float(PARAMS.mass[0] * (states.vel[-1, 0, 0] - 0.5)), rel=0.05)
    apart = np.linalg.norm(log.pos[:, 1] - log.pos[:, 0], axis=1)
    assert (apart[forces.any(axis=(1, 2))] < 2 * float(PARAMS.collision_radius[0]) + 6e-3).all()
    far = dataclasses.replace(log, pos=log.pos + np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]))
    assert contact_forces(far) is None  # as of a gust


def test_pairs_of_close_points_are_found_once_and_only_in_the_same_row():
    random = np.random.default_rng(0)
    row, pos = random.integers(0, 5, 200), random.uniform(0, 1, (200, 3))
    apart = np.linalg.norm(pos[:, None] - pos, axis=-1)
    close = np.argwhere(np.tril((apart < 0.15) & (row[:, None] == row), k=-1))
    found = contacts._close_pairs(row, pos, 0.15)
    assert {(max(pair), min(pair)) for pair in found.tolist()} == {tuple(pair) for pair in close.tolist()}
    assert len(found) == len(close) > 10
