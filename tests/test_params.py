"""Derived quantities against the wrench of the rotors, and teams."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import VEHICLES, assert_close

import jaxdrones
from jaxdrones import State
from jaxdrones.dynamics.rotors import rotor_wrench

RTOL = 1e-12  # the same products in another order


def wrenches_at_full_or_no_speed(params):
    """The sixteen wrenches of rotors that stand still or turn at full speed."""
    rpm = jnp.array(list(itertools.product([0.0, 1.0], repeat=4))) * params.max_rpm
    z = jnp.zeros(3)
    return jax.vmap(lambda r: rotor_wrench(params, State(z, jnp.array([0.0, 0, 0, 1]), z, z, r)))(rpm)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_hover_speed_carries_the_weight(vehicle):
    params = jaxdrones.load_params(vehicle)
    np.testing.assert_allclose(4 * params.kf * params.hover_rpm**2, params.mass * params.gravity, rtol=RTOL)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_the_largest_thrust_and_torques_are_what_the_rotors_can_do(vehicle):
    params = jaxdrones.load_params(vehicle)
    able = wrenches_at_full_or_no_speed(params)
    np.testing.assert_allclose(params.max_thrust, jnp.max(able.force[:, 2]), rtol=RTOL)
    np.testing.assert_allclose(params.max_xy_torque, jnp.max(able.torque[:, 0]), rtol=RTOL)
    np.testing.assert_allclose(params.max_z_torque, jnp.max(able.torque[:, 2]), rtol=RTOL)


def test_a_heavier_drone_gets_no_stronger_motors():
    params = jaxdrones.load_params("cf2x")
    heavier = params.replace(mass=2 * params.mass)
    assert heavier.max_thrust == params.max_thrust
    np.testing.assert_allclose(heavier.hover_rpm, np.sqrt(2) * params.hover_rpm, rtol=RTOL)


def test_derived_quantities_of_a_team_are_those_of_its_members():
    members = [jaxdrones.load_params(vehicle) for vehicle in VEHICLES]
    team = jaxdrones.stack(members)
    for name in "weight", "arm", "hover_rpm", "max_thrust", "max_xy_torque", "max_z_torque":
        np.testing.assert_allclose(getattr(team, name), [getattr(member, name) for member in members], rtol=RTOL)


def test_constants_of_a_team_are_real_numbers_also_where_they_are_given_as_whole_ones():
    params = jaxdrones.load_params("hb").replace(mass=1, gravity=np.int64(10), aux={"cells": jnp.array(3)})
    for team in jaxdrones.repeat(params, 2), jaxdrones.stack([params, params]):
        assert team.mass.dtype == team.gravity.dtype == team.kf.dtype and team.aux["cells"].dtype == int
        np.testing.assert_array_equal(team.mass, [1.0, 1.0])


def test_a_repeated_drone_is_a_stack_of_itself():
    params = jaxdrones.load_params("hb")
    assert_close(jaxdrones.repeat(params, 3), jaxdrones.stack([params] * 3), atol=0)


@pytest.mark.parametrize("n", [0, -1, 2.0])
def test_a_team_has_a_whole_number_of_drones_and_at_least_one(n):
    with pytest.raises(ValueError, match=rf"number of drones is {n}.*at least 1"):
        jaxdrones.repeat(jaxdrones.load_params("cf2x"), n)


def test_drones_with_other_constants_cannot_be_stacked():
    plain = jaxdrones.load_params("cf2x")
    one, three = (plain.replace(aux={"tether": jnp.ones(shape)}) for shape in ((), (3,)))
    with pytest.raises(
        ValueError, match=r"aux of drone 1 has nothing, and that of drone 0 \['tether'\] \(\); give all"
    ):
        jaxdrones.stack([one, plain])
    with pytest.raises(
        ValueError, match=r"aux of drone 1 has \['tether'\] \(3,\), and that of drone 0 \['tether'\] \(\)"
    ):
        jaxdrones.stack([one, three])


def test_an_empty_team_cannot_be_stacked():
    with pytest.raises(ValueError, match=r"number of drones is 0.*at least 1"):
        jaxdrones.stack([])


def test_a_team_is_not_made_of_teams():
    team = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 2)
    with pytest.raises(ValueError, match=r"mass has shape \(2,\).*single drone"):
        jaxdrones.repeat(team, 2)
    with pytest.raises(ValueError, match=r"mass of drone 1 has shape \(2,\).*single drones"):
        jaxdrones.stack([jaxdrones.load_params("cf2x"), team])
