"""Contact that is computed only where an obstacle is near equals contact that is computed everywhere."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, jit_unoptimized, make_step

import jaxdrones as jd
from jaxdrones.dynamics.contact import contact_radius
from jaxdrones.engine.clearance import FreeBalls, NearObstacles
from jaxdrones.sensing import Box, Scene, Sphere

TEAM = jd.repeat(jd.load_params("cf2x"), 2)
RPM = jnp.zeros((2, 4))
SCENE = Scene.of(
    Box(pos=np.array([(0.4, 0, 0), (-0.4, 0, 0)]), size=(0.2, 1, 1)), Sphere(pos=(0, 0.4, 0), radius=0.2), ground=False
)


def starts(worlds, near, speed):
    """Teams of two; in the first `near` worlds they fly at the obstacles, in the others far away."""
    rng = np.random.default_rng(worlds)
    pos = rng.uniform(-0.6, 0.6, (worlds, 2, 3))
    pos[near:, :, 2] += 50
    state = jax.vmap(jd.State.at_rest)(jnp.array(pos))
    quat = rng.normal(size=(worlds, 2, 4))
    return state.replace(
        vel=jnp.asarray(speed * rng.uniform(-1, 1, (worlds, 2, 3))),
        omega=jnp.asarray(rng.uniform(-9, 9, (worlds, 2, 3))),
        quat=jnp.asarray(quat / np.linalg.norm(quat, axis=2, keepdims=True)),
    )


def flown(effect, integrator, state, scene=SCENE, substeps=12):
    """Two control steps of a world."""
    step = make_step(effects=(effect,), integrator=integrator, dt=1 / 240, substeps=substeps)
    return step(TEAM, step(TEAM, state, RPM, scene), RPM, scene)


@pytest.mark.parametrize("integrator", [jd.semi_implicit_euler, pytest.param(jd.rk4, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_worlds_that_are_near_and_worlds_that_are_not_fly_as_if_all_were_computed(integrator, monkeypatch):
    """Where few, most and none are near; at up to 20 m/s, with 1 m between two control steps."""
    fly = partial(flown, jd.obstacle_contact, integrator)
    together, everywhere = jit_unoptimized(jax.vmap(fly)), jit_unoptimized(jax.vmap(fly))
    cases = {near: starts(64, near, 20.0) for near in (50, 6, 0)}
    fast = {near: together(states) for near, states in cases.items()}
    monkeypatch.setattr(FreeBalls, "hold", lambda self, params, state: jnp.zeros(2, bool))
    for near, states in cases.items():
        found = fast[near]
        assert_close(found, everywhere(states), 1e-9)
        pushed = np.any(np.asarray(found.vel != states.vel)[..., :2], axis=(1, 2))  # the rotors stand still
        assert near / 2 <= pushed.sum() <= near


@pytest.mark.slow
def test_the_gradient_far_from_obstacles_is_that_of_a_flight_without_them():
    def end(scene, push):
        state = jd.State.at_rest(jnp.array([(0.0, 0, 50), (1, 0, 50)])).replace(vel=push)
        return jnp.sum(flown(jd.obstacle_contact, jd.rk4, state, scene, substeps=2).pos ** 2)

    push = jnp.ones((2, 3))
    found, free = (jax.grad(partial(end, scene))(push) for scene in (SCENE, Scene(ground=False)))
    np.testing.assert_array_equal(found, free)


@pytest.mark.slow
def test_what_stays_in_its_free_ball_has_no_contact():
    """Wherever the drone is in it, and in whatever attitude; and the ball is the largest one."""
    states = jax.tree.map(lambda x: x[:, :1], starts(400, 400, 0.0))
    states = states.replace(pos=2 * states.pos)
    one = jax.tree.map(lambda x: x[:1], TEAM)

    def of_world(state, towards):
        free = FreeBalls.about(state, SCENE)
        moved = state.replace(pos=state.pos + towards)
        wrench = jax.vmap(jd.obstacle_contact, (0, 0, None))(one, moved, SCENE)
        return free.hold(one, moved)[0], jnp.any(wrench.force != 0), free.radius[0]

    towards = jnp.asarray(np.random.default_rng(1).normal(size=(400, 1, 3)) * 0.2)
    inside, touched, radius = jit_unoptimized(jax.vmap(of_world))(states, towards)
    assert 50 < jnp.sum(inside) < 350 and jnp.sum(touched) > 10
    assert not np.any(inside & touched)
    size = contact_radius(jd.load_params("cf2x"))
    away = np.linalg.norm(towards[:, 0], axis=1)
    np.testing.assert_array_equal(inside, away + size + 1e-3 < radius)


def test_the_ball_that_holds_a_drone_is_the_smallest_one():
    """At its radius above the ground no attitude touches, and slightly lower one does; hb's shape is off its center."""
    params = jd.stack([jd.load_params(name) for name in ("cf2x", "hb", "racer")])

    @partial(jax.vmap, in_axes=(None, None, 0))
    def force(params, height, roll):
        state = jax.tree.map(lambda x: x[0], jd.State.at_rest(jnp.array([[0, 0, 1.0]]) * height))
        state = state.replace(quat=jd.rotation.from_rpy(jnp.array([1.0, 0, 0]) * roll))
        return jnp.max(jnp.abs(jd.ground_contact(params, state).force))

    @jit_unoptimized
    @partial(jax.vmap, in_axes=(0, None))
    def largest(params, share):
        return jnp.max(force(params, share * contact_radius(params), jnp.linspace(-np.pi, np.pi, 721)))

    np.testing.assert_array_equal(largest(params, 1.0001), 0)
    assert np.all(largest(params, 0.999) > 0)


def test_a_drone_that_leaves_its_ball_within_a_physics_step_is_stopped():
    """At a plate half a meter below, through which it would fly 0.8 m in a single step."""
    plate = Scene.of(Box(pos=(0.0, 0.0, 0.0), size=(2.0, 2.0, 0.02)), ground=False)
    state = jd.State.at_rest([[0.0, 0, 0.5], [0, 0, 50.0]])

    @jit_unoptimized
    def after(state):
        near = NearObstacles([jd.obstacle_contact], state, plate)
        return near.step(TEAM, state, lambda contact: state.replace(pos=state.pos - jnp.array([[0, 0, 0.8]]))).pos[:, 2]

    stopped, free = after(state)
    assert 0 < stopped < 0.05 and free == 49.2


def height(effect, vel, shift, state):
    """A number that depends on how a world is flown, with the obstacles moved."""
    scene = SCENE.replace(boxes=SCENE.boxes.replace(pos=SCENE.boxes.pos + shift))
    return jnp.sum(flown(effect, jd.semi_implicit_euler, state.replace(vel=vel), scene, 3).pos ** 2)


def of_each(f):
    return jax.vmap(jax.grad(f, (0, 1)), (0, None, 0))


def of_all(f):
    return jax.grad(lambda *x: jnp.sum(jax.vmap(f, (0, None, 0))(*x)), (0, 1))


def forward(f):
    return jax.vmap(jax.jacfwd(f, (0, 1)), (0, None, 0))


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [of_each, of_all, forward])
def test_derivatives_of_many_worlds_are_those_of_each(derivative):
    """In the velocities and in the places of the obstacles."""
    states, shift = starts(8, 4, 3.0), jnp.zeros((1, 3))
    fall = partial(height, jd.obstacle_contact)
    found = jit_unoptimized(derivative(fall))(states.vel, shift, states)
    alone = jit_unoptimized(jax.grad(fall, (0, 1)))
    each = [alone(states.vel[i], shift, jax.tree.map(lambda x, i=i: x[i], states)) for i in range(8)]
    by_vel, by_shift = (jnp.stack(x) for x in zip(*each, strict=True))
    expected = by_vel, (jnp.sum(by_shift, axis=0) if derivative is of_all else by_shift)
    assert np.any(found[1] != 0)
    assert_close(found, expected, 1e-9)
