"""Drag and ground effect: recorded forces, and what air can and cannot do."""

from functools import partial

import golden_data
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, assert_finite, flying, jit_unoptimized

import jaxdrones
from jaxdrones import State, drag, drag_world_axes, ground_effect, ground_effect_2021, rotation

params = jaxdrones.load_params("cf2x")
states = flying(jaxdrones.repeat(params, 50))
RADIUS = float(params.prop_radius)
WEIGHT = float(params.weight)


@partial(jit_unoptimized, static_argnums=0)
def on_each(effect, states=states, params=params):
    return jax.vmap(effect, (None, 0))(params, states)


@jit_unoptimized
def lift(heights):
    """Smooth ground effect in level hover, N."""
    return jax.vmap(lambda h: ground_effect(params, hovering(h)).force[2])(heights)


def hovering(height, tilt=0.0):
    """At a height (m), rolled by `tilt` (rad), rotors at hover speed."""
    return State(
        pos=jnp.array([0, 0, height]),
        quat=rotation.from_rpy(jnp.array([tilt, 0.0, 0.0])),
        vel=jnp.zeros(3),
        omega=jnp.zeros(3),
        rpm=jnp.full(4, params.hover_rpm),
    )


@pytest.mark.parametrize("name", golden_data.names("ground_force", variant="main"))
def test_forces_of_the_paper_are_the_recorded_ones(name):
    """1e-9 N and 1e-9 relative; measured 3e-17 N."""
    case = golden_data.load(name)
    recorded = {key: jnp.asarray(value) for key, value in case.arrays.items()}
    zero = jnp.zeros_like(recorded["pos0"])
    states = State(recorded["pos0"], recorded["quat0"], recorded["vel0"], zero, recorded["rpm0"])
    params = golden_data.recorded_params(case)

    ground = on_each(ground_effect_2021, states, params)
    per_rotor = recorded["ground_force"]
    np.testing.assert_allclose(ground.force[:, 2], jnp.sum(per_rotor, axis=1), rtol=1e-9, atol=1e-9)
    x, y, _ = params.rotor_pos.T
    np.testing.assert_allclose(ground.torque[:, 0], per_rotor @ y, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(ground.torque[:, 1], -per_rotor @ x, rtol=1e-9, atol=1e-9)

    force = on_each(drag_world_axes, states, params).force
    np.testing.assert_allclose(force, recorded["drag_force_frame_vector"], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("effect", [drag, drag_world_axes])
def test_drag_never_adds_power_in_still_air(effect):
    force = jax.vmap(rotation.rotate)(states.quat, on_each(effect).force)
    assert np.all(jnp.sum(force * states.vel, axis=1) < 0)


@pytest.mark.parametrize("effect", [drag, drag_world_axes])
def test_drag_vanishes_when_flying_with_the_wind(effect):
    wind = jnp.array([3.0, -2.0, 1.0])
    drifting = states.replace(vel=jnp.broadcast_to(wind, states.vel.shape))
    assert_close(on_each(effect, drifting, params.replace(wind=wind)), jax.tree.map(jnp.zeros_like, on_each(effect)), 0)


@pytest.mark.parametrize("effect", [drag, drag_world_axes])
def test_drag_feels_only_the_velocity_relative_to_the_air(effect):
    wind = jnp.array([3.0, -2.0, 1.0])
    moved = states.replace(vel=states.vel + wind[None])
    assert_close(on_each(effect, moved, params.replace(wind=wind)), on_each(effect), atol=1e-15)  # N


def test_drag_grows_with_the_rotor_speeds_and_needs_them():
    still = states.replace(rpm=0 * states.rpm)
    np.testing.assert_array_equal(on_each(drag, still).force, 0)
    twice = on_each(drag, states.replace(rpm=2 * states.rpm)).force
    np.testing.assert_allclose(twice, 2 * on_each(drag).force, rtol=0, atol=1e-16)  # N


def test_drag_axes_turn_with_the_body_and_those_of_the_paper_do_not():
    """Nose up, the air from the front meets the body from above: the vertical coefficient applies."""
    quat = rotation.from_rpy(jnp.array([0.0, -jnp.pi / 2, 0.0]))
    state = hovering(1.0).replace(vel=jnp.array([1.0, 0, 0]), quat=quat)
    speed = 4 * params.hover_rpm * 2 * np.pi / 60
    for effect, coeff in (drag, params.drag_coeff[2]), (drag_world_axes, params.drag_coeff[0]):
        world = rotation.rotate(quat, effect(params, state).force)
        np.testing.assert_allclose(world, [-coeff * speed, 0, 0], rtol=1e-14, atol=1e-17)


def test_level_drones_have_the_same_drag_both_ways():
    """The horizontal coefficients are equal, so heading does not matter."""
    yawed = jax.vmap(rotation.from_rpy)(jnp.linspace(0, 3, 50)[:, None] * jnp.array([[0.0, 0, 1]]))
    level = states.replace(quat=yawed)
    assert_close(on_each(drag, level), on_each(drag_world_axes, level), atol=1e-16)  # N


@pytest.mark.parametrize("radii", [5, 10, 20])
def test_ground_effect_approaches_equation_5_at_height(radii):
    """1/sqrt(h^4 + h0^4) = (1 - (h0/h)^4/2 ...)/h^2 with h0 = 1.63 propeller radii."""
    smooth = lift(jnp.array([radii * RADIUS]))[0]
    equation = 4 * params.kf * params.ground_effect_coeff * (1 / (4 * radii)) ** 2 * params.hover_rpm**2
    lack = 1 - smooth / equation
    assert 0 < lack < (1.63 / radii) ** 4 / 2
    np.testing.assert_allclose(ground_effect_2021(params, hovering(radii * RADIUS)).force[2], equation, rtol=1e-14)


def test_ground_effect_falls_with_height_and_is_bounded():
    """Never above the paper's value at its clip, 4/15 of the thrust (0.3 % for rounding 1.63), also below the floor."""
    heights = jnp.linspace(0.0, 3.0, 301)
    gain, below = lift(heights) / WEIGHT, lift(-heights) / WEIGHT
    assert np.all(np.diff(gain) < 0)
    np.testing.assert_allclose(gain[0], 4 / 15, rtol=4e-3)
    assert np.all((below > 0) & (below <= gain[0]))


def test_ground_effect_is_smooth_in_height():
    """Its slope is continuous: it changes by no more than its curvature, under 4 gain/h0^2, times the spacing."""
    heights = jnp.linspace(-0.2, 0.2, 4001)
    slope = jax.jvp(lift, (heights,), (jnp.ones_like(heights),))[1]
    floor = 1.63 * RADIUS
    assert np.max(np.abs(np.diff(slope))) <= 4 * (4 / 15 * WEIGHT / floor**2) * 1e-4


@pytest.mark.parametrize("effect", [ground_effect, ground_effect_2021])
def test_there_is_no_ground_effect_upside_down(effect):
    tilts = jnp.array([jnp.pi / 2 + 0.01, jnp.pi, -2.0])
    wrench = on_each(effect, jax.vmap(partial(hovering, 0.05))(tilts))
    np.testing.assert_array_equal(wrench.force, 0)
    np.testing.assert_array_equal(wrench.torque, 0)


def test_ground_effect_fades_out_smoothly_on_the_way_to_upside_down():
    tilts = jnp.pi / 2 + jnp.array([-0.02, -0.01, 0.01])
    gain = on_each(ground_effect, jax.vmap(partial(hovering, 0.05))(tilts)).force[:, 2]
    np.testing.assert_allclose(gain[0] / gain[1], 4, rtol=0.01)  # cos^2, within 1 % at 0.02 rad
    assert gain[2] == 0


@pytest.mark.slow
def test_ground_effect_rights_a_tilted_drone():
    """The lower rotors gain more, so the torque is against the roll."""
    tilts = jnp.array([0.3, -0.3])
    torque = on_each(ground_effect, jax.vmap(partial(hovering, 0.03))(tilts)).torque
    assert np.all(torque[:, 0] * tilts < 0)
    np.testing.assert_allclose(torque[:, 1:], 0, atol=1e-12 * WEIGHT * RADIUS)


def test_a_vehicle_without_a_coefficient_has_no_ground_effect_and_no_drag():
    hummingbird = jaxdrones.load_params("hb")
    for effect in ground_effect, ground_effect_2021, drag:
        wrench = on_each(effect, states, hummingbird)
        np.testing.assert_array_equal(wrench.force, 0)
        np.testing.assert_array_equal(wrench.torque, 0)


@pytest.mark.parametrize("effect", [ground_effect, ground_effect_2021])
@pytest.mark.parametrize("height", [-0.1, 0.0, 0.1])
def test_without_a_coefficient_values_and_gradients_stay_finite_at_any_height(effect, height):
    hummingbird = jaxdrones.load_params("hb")
    state = jax.tree.map(lambda x: x[0], State.at_rest([[0.0, 0, height]])).replace(rpm=jnp.full(4, 4000.0))
    force, gradient = jit_unoptimized(jax.value_and_grad(lambda p, s: effect(p, s).force[2], argnums=(0, 1)))(
        hummingbird, state
    )
    assert force == 0
    assert_finite(gradient)
