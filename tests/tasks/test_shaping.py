"""Reward terms and ends that tasks share, in numbers."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
from helpers import jit_unoptimized

from jaxdrones.sensing import Scene
from jaxdrones.tasks import shaping


def world_of(pos, vel=0.0, omega=0.0, **own):
    pos, vel, omega = (jnp.broadcast_to(jnp.asarray(x), np.shape(pos)).astype(float) for x in (pos, vel, omega))
    return SimpleNamespace(drones=SimpleNamespace(pos=pos, vel=vel, omega=omega), **own)


def asked(pos, vel=0.0):
    target = SimpleNamespace(pos=jnp.asarray(pos), vel=jnp.full((1, 3), vel))
    return SimpleNamespace(target_now=lambda world: target)


def test_the_distance_counts_half_at_three_meters_and_speeds_are_those_relative_to_the_target():
    world = world_of([[1.0, 0, 0], [0, 3.02, 0]], vel=[[2.0, 0, 0], [0, 2, 0]])
    np.testing.assert_allclose(shaping.position(asked([[1.0, 0, 0], [0, 0, 0]]), world), [0, 1.5], atol=1e-4)
    np.testing.assert_allclose(shaping.velocity(asked([[0.0, 0, 0]], 2.0), world), [np.sqrt(8.01) - 0.1] * 2)
    near = shaping.near(asked([[1.0, 0, 0], [0, 3.02, 0]], 0.0), world)
    np.testing.assert_allclose(near, np.exp(-(np.hypot(2, 0.02) - 0.02) / 0.2), rtol=1e-6)


def test_a_crowd_costs_the_squared_share_of_the_nearest_drone_within_40_cm():
    crowding = shaping.crowding(None, world_of([[0.0, 0, 0], [0.3, 0, 0], [0.4, 0, 0]]))
    np.testing.assert_allclose(crowding, np.square([0.25, 0.75, 0.75]), atol=1e-12)
    assert shaping.crowding(None, world_of([[0.0, 0, 0]])).tolist() == [0]


def test_the_margin_of_a_surface_grows_with_the_speed_towards_it():
    """Half a meter above the ground: falling, climbing and level."""
    params = SimpleNamespace(collision_radius=jnp.full(3, 0.1))
    world = world_of([[0.0, 0, 0.5]] * 3, [[0.0, 0, -2], [0, 0, 2], [2, 0, 0]], params=params, scene=Scene())
    cost = jit_unoptimized(lambda: shaping.clearance()(None, world))()
    closing = np.array([2.0, 0, 0])
    inside = 0.2 + 0.1 * closing - 0.4
    np.testing.assert_allclose(cost, (1 + closing) * 0.1 * np.log1p(np.exp(inside / 0.1)), rtol=1e-9)


def test_the_change_of_an_action_is_that_of_the_last_two():
    actions = jnp.array([[[9.0, 9], [1, 2], [2, 0]]])
    assert shaping.action_change(None, SimpleNamespace(actions=actions)).tolist() == [5]


def test_who_is_far_along_some_axis_or_not_a_number_is_lost_and_who_turns_fast_spins():
    pos = jnp.array([[0.0, 0, 2], [5, 0, 2], [0, -5, 2], [0, 0, 7], [0, 0, np.nan]])
    world = world_of(pos + 0.0, omega=[[0.0, 0, 0], [0, 0, 99], [0, 0, -101], [101, 0, 0], [np.nan, 0, 0]])
    for center, target in ((0, 0, 2), [[9.0, 9, 9]]), (None, [[0.0, 0, 2]]):
        ends = shaping.out_of_control(5.0, center)
        assert ends["lost"](asked(target), world).tolist() == [False, True, True, True, True]
        assert ends["spinning"](None, world).tolist() == [False, False, True, True, True]
