"""Downwash: recorded forces, the formulas in plain numpy, and what a jet can and cannot do."""

from functools import partial
from pathlib import Path

import golden_data
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, jit_unoptimized, to_world
from scipy.spatial.transform import Rotation

import jaxdrones
from jaxdrones import State, downwash, downwash_2021, rotation
from jaxdrones.dynamics import interaction

PAGE = (Path(__file__).parents[2] / "docs" / "physics.md").read_text()
params = jaxdrones.load_params("cf2x")
LENGTH = float(np.sqrt(2) * params.arm)  # m, distance of neighboring motors
INDUCED = float(np.sqrt(params.weight / (8 * params.air_density * np.pi * params.prop_radius**2)))  # m/s, in hover


def hovering(pos, quat=(0.0, 0, 0, 1), rpm=None):
    rpm = jnp.full(4, params.hover_rpm if rpm is None else rpm)
    return State(jnp.array(pos, float), jnp.array(quat, float), jnp.zeros(3), jnp.zeros(3), rpm)


lower = hovering((0, 0, 0))


@partial(jit_unoptimized, static_argnames="pair")
def on_lower(upper, lower=lower, params=params, other=params, pair=downwash):
    return pair(params, lower, other, upper)


probe = params.replace(rotor_pos=jnp.zeros((4, 3)))  # all rotors in the center of the drone


@pytest.mark.parametrize("name", golden_data.names("downwash_on_0", variant="main"))
def test_forces_of_the_paper_are_the_recorded_ones(name):
    """1e-9 N and 1e-9 relative; some values are tens of newtons."""
    case = golden_data.load(name)
    recorded = {key: jnp.asarray(value) for key, value in case.arrays.items()}
    zero = jnp.zeros_like(recorded["pos0"])
    first = State(recorded["pos0"], recorded["quat0"], recorded["vel0"], zero, recorded["rpm0"])
    second = State(recorded["pos1"], jnp.tile(jnp.array([[0.0, 0, 0, 1]]), (len(zero), 1)), zero, zero, first.rpm)
    params = golden_data.recorded_params(case)
    force = jit_unoptimized(jax.vmap(lambda a, b: downwash_2021(params, a, params, b).force))
    for on, expected in (force(first, second), "downwash_on_0"), (force(second, first), "downwash_on_1"):
        np.testing.assert_allclose(on[:, 2], recorded[expected], rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(on[:, :2], 0)


def test_the_guards_of_the_papers_downwash_leave_its_values_alone():
    """Equation 6 as written, wherever dz >= 0.05 m and its width is at least 0.5 mm."""
    rng = np.random.default_rng(0)
    k1, k2, k3 = np.asarray(params.downwash_coeff)
    min_std = (5e-4 * np.array([1, -1]) * (1 + 1e-9) - k3) / k2  # dz where the width is at its bound
    dz = np.concatenate([[0.05, 0.6, 0.68], min_std, rng.uniform(0.05, 3, 500)])
    beta = k2 * dz + k3
    dz, beta = dz[np.abs(beta) >= 5e-4], beta[np.abs(beta) >= 5e-4]
    assert len(dz) > 490
    off_axis = rng.uniform(-2, 2, (len(dz), 2)) * np.abs(beta)[:, None]  # where there is something to compare
    expected = -k1 * (float(params.prop_radius) / (4 * dz)) ** 2 * np.exp(-np.sum(off_axis**2, 1) / beta**2 / 2)
    upper = jax.vmap(hovering)(jnp.asarray(np.column_stack([off_axis, dz])))
    actual = jax.vmap(lambda s: on_lower(s, pair=downwash_2021).force[2])(upper)
    np.testing.assert_allclose(actual, expected, rtol=1e-9)  # beta cancels digits near zero width: 1e-16 * 0.1 / 5e-4


def test_the_guards_bound_the_papers_downwash():
    """At 5 cm it is 30 N; it grows no further, whatever the distance, and sideways it ends at 10 m."""
    bound = -params.downwash_coeff[0] * (params.prop_radius / 0.2) ** 2
    for dz in 1e-3, 1e-9, 0.05:
        np.testing.assert_allclose(on_lower(hovering((0, 0, dz)), pair=downwash_2021).force[2], bound, rtol=1e-12)
    for pos in (0, 0, 0), (0, 0, -1), (10.1, 0, 20):
        assert on_lower(hovering(pos), pair=downwash_2021).force[2] == 0
    assert on_lower(hovering((0, 0, 0.6875)), pair=downwash_2021).force[2] < 0


def test_the_jet_is_that_of_bauersfeld_below_the_rotors():
    """U_c = 10.11 U_h / (z/l + 5.817), half width 0.07668 (z/l + 5.817) l, profile (1 + (sqrt 2 - 1) xi^2)^-2."""
    rng = np.random.default_rng(1)
    for x, y, z in rng.uniform([-0.1, -0.1, LENGTH], [0.1, 0.1, 2], (20, 3)):
        wrench = on_lower(hovering((x, y, z)))
        depth = z / LENGTH + 5.817
        off_axis = np.linalg.norm(np.asarray(params.rotor_pos)[:, :2] - [x, y], axis=1)
        xi = off_axis / (0.07668 * depth * LENGTH)
        speed = INDUCED * 10.11 / depth / (1 + (np.sqrt(2) - 1) * xi**2) ** 2
        loss = params.inflow_loss * speed * params.weight / 4
        np.testing.assert_allclose(wrench.force, [0, 0, -np.sum(loss)], rtol=1e-12)


def test_half_a_metre_below_another_a_crazyflie_loses_the_share_of_its_weight_that_the_page_says():
    upper = hovering((0, 0, 0.5))
    for pair, percent in (downwash, 14.3), (downwash_2021, 115):
        push = -100 * float(on_lower(upper, pair=pair).force[2] / params.weight)
        np.testing.assert_allclose(push, percent, rtol=0, atol=0.5 if percent == 115 else 0.05)
        assert f"{percent} %" in PAGE


def test_at_the_half_width_the_jet_blows_half_as_fast():
    width = 0.07668 * (1.0 / LENGTH + 5.817) * LENGTH
    center, side = (on_lower(hovering((x, 0, 1.0)), params=probe).force[2] for x in (0, width))
    np.testing.assert_allclose(side / center, 0.5, rtol=1e-12)


@pytest.mark.parametrize("pair", [downwash, downwash_2021])
def test_nothing_blows_upwards(pair):
    for pos in np.random.default_rng(2).uniform([-0.2, -0.2, -1], [0.2, 0.2, 0], (20, 3)):
        np.testing.assert_array_equal(on_lower(hovering(pos), pair=pair).force, 0)


def test_the_jet_is_bounded_everywhere():
    """Nowhere faster than at its onset, 10.11 / 5.817 of the induced speed, so no rotor loses more than that share."""
    pos = np.random.default_rng(3).normal(size=(2000, 3)) * 10.0 ** np.random.default_rng(4).uniform(-6, 1, (2000, 1))
    pos = jnp.asarray(np.concatenate([pos, [[0, 0, 0], [0, 0, -LENGTH]]]))
    force = jax.vmap(lambda p: on_lower(lower, lower.replace(pos=p), params=probe).force[2])(pos)
    largest = params.inflow_loss * INDUCED * 10.11 / 5.817 * params.weight
    assert np.all((force <= 0) & (force >= -largest))
    np.testing.assert_allclose(np.min(force), -largest * 5.817 / 6.817, rtol=0.05)  # about one motor distance below


def test_the_jet_has_no_jump():
    """A straight flight through it changes the force steadily: at most 3 largest forces per motor distance."""
    largest = params.inflow_loss * INDUCED * 10.11 / 5.817 * params.weight
    way = jnp.linspace(-0.5, 0.5, 5001)[:, None]  # m
    for direction in np.vstack([np.eye(3), np.full(3, 0.5)]):
        pos = jnp.array([[0, 0, 0.05]]) + way * direction[None]
        force = jax.vmap(lambda p: on_lower(lower.replace(pos=p)).force[2])(pos)
        assert np.max(np.abs(np.diff(force))) <= 3 * largest / LENGTH * 2e-4


def test_the_derivatives_of_the_jet_are_those_of_its_formula():
    jet = interaction._jet
    z, off_axis = (jnp.array(x.ravel()) for x in np.meshgrid([-0.3, 0.2, 0.8, 1.4, 30.0], [0.0, 0.5, 4.0]))

    @jax.jit
    @jax.vmap
    def derivatives(*at):
        rule, formula = ((jax.grad(f, (0, 1))(*at), jax.hessian(f, (0, 1))(*at)) for f in (jet, jet.fun))
        return rule, formula, jax.jvp(jet, at, at)[0], jet(*at)

    (slopes, curvatures), (expected_slopes, expected_curvatures), value, expected = derivatives(z, off_axis)
    assert_close(slopes, expected_slopes, 1e-14)
    assert_close(curvatures, expected_curvatures, 1e-13)
    assert_close(value, expected, 1e-15)


def test_the_jet_follows_the_thrust_axis_of_the_upper_drone():
    """Turning both drones and the line between them turns the wrench along: in the body frame it stays."""
    start = on_lower(hovering((0.02, -0.01, 0.4)))
    assert start.force[2] < 0
    for q in Rotation.random(5, rng=0).as_quat():
        turned = hovering(to_world(rotation.rotate, jnp.array(q), jnp.array([0.02, -0.01, 0.4])), q)
        assert_close(on_lower(turned, hovering((0, 0, 0), q)), start, atol=1e-13)  # N; measured 1e-15


def test_a_tilted_upper_drone_blows_past_the_lower_one():
    tilted = rotation.from_rpy(jnp.array([0.5, 0.0, 0.0]))
    straight = on_lower(hovering((0, 0, 0.6))).force[2]
    assert straight < 10 * on_lower(hovering((0, 0, 0.6), tilted)).force[2] < 0


def test_the_jet_speed_is_the_root_of_the_upper_thrust():
    """Induced speed goes with the root of thrust, so with the rotor speed; without thrust there is no jet."""
    once, twice = (on_lower(hovering((0, 0, 0.4), rpm=k * params.hover_rpm)).force[2] for k in (1, 2))
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-12)
    np.testing.assert_array_equal(on_lower(hovering((0, 0, 0.4), rpm=0.0)).force, 0)


def test_the_loss_is_a_share_of_the_lower_thrust():
    upper = hovering((0, 0, 0.4))
    np.testing.assert_allclose(
        on_lower(upper, hovering((0, 0, 0), rpm=2 * params.hover_rpm)).force, 4 * on_lower(upper).force, rtol=1e-12
    )


def test_a_drone_half_in_the_jet_tilts_into_it():
    """A jet on the front rotors (x > 0) makes the nose drop, a positive pitch; one on the left a negative roll."""
    for side in 0.08, -0.08:
        pitch = on_lower(hovering((side, 0, 0.3))).torque
        roll = on_lower(hovering((0, side, 0.3))).torque
        assert pitch[1] * side > 0 and roll[0] * side < 0
        np.testing.assert_allclose([pitch[0], roll[1]], 0, atol=1e-15)


def test_downwash_differs_between_vehicles():
    """The jet is that of the upper drone, the loss that of the lower."""
    racer = jaxdrones.load_params("racer")
    upper = lower.replace(pos=jnp.array([0, 0, 0.5]), rpm=jnp.full(4, racer.hover_rpm))
    below_racer = on_lower(upper, other=racer).force[2]
    assert below_racer < on_lower(hovering((0, 0, 0.5))).force[2] < 0
    numb = params.replace(inflow_loss=jnp.zeros(()))
    assert on_lower(upper, params=numb, other=racer).force[2] == 0


def test_the_loss_is_a_share_of_the_own_thrust_and_the_jet_that_of_the_other():
    """Four times the thrust coefficient: four times the own loss, twice the speed of the other's jet."""
    loss = float(downwash(params, lower, params, hovering((0, 0, 1.5))).force[2])
    stronger = params.replace(kf=4 * params.kf)
    np.testing.assert_allclose(downwash(stronger, lower, params, hovering((0, 0, 1.5))).force[2], 4 * loss, rtol=1e-12)
    np.testing.assert_allclose(downwash(params, lower, stronger, hovering((0, 0, 1.5))).force[2], 2 * loss, rtol=1e-12)


def test_no_jet_takes_more_than_the_thrust():
    racer = jaxdrones.load_params("racer")
    force = downwash(params, lower, racer, hovering((0, 0, 0.4), rpm=racer.max_rpm)).force[2]
    assert -params.weight < force < -0.6 * params.weight
