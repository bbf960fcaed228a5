"""Randomizations of the step: teams, worlds, substeps, compilation."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    INTEGRATORS,
    STATE,
    VEHICLES,
    assert_close,
    assert_finite,
    assert_same_motion,
    fly,
    flying,
    jit_unoptimized,
    make_step,
    mostly_slow,
    name_of,
    tape,
)

import jaxdrones
from jaxdrones import (
    State,
    Wrench,
    downwash,
    downwash_2021,
    drag,
    ground_contact,
    ground_effect,
    instant_rotors,
    lagging_rotors,
    rk4,
    semi_implicit_euler,
)

ROUND_OFF = 1e-12  # float64, some tens of steps

cf2x = jaxdrones.load_params("cf2x")
mixed = jaxdrones.stack([jaxdrones.load_params(vehicle) for vehicle in VEHICLES])
full_step = make_step((drag, ground_effect), (downwash,), lagging_rotors)
single_step = make_step((drag, ground_effect))


def one(tree, i):
    """The team of drone i alone."""
    return jax.tree.map(lambda x: x[i : i + 1], tree)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_hover_speed_hovers(vehicle):
    team = jaxdrones.repeat(jaxdrones.load_params(vehicle), 1)
    start = State.at_rest([[1.0, 2, 3]], [0.5])
    rpm = jnp.full((1, 4), team.hover_rpm[0])
    end = make_step(substeps=240)(team, start, rpm)
    assert_same_motion(end, start.replace(rpm=rpm), ROUND_OFF)


def test_a_step_turns_the_rotors_as_commanded():
    team = jaxdrones.repeat(cf2x, 1)
    for rpm in jnp.full((1, 4), cf2x.max_rpm), jnp.zeros((1, 4)):
        np.testing.assert_array_equal(single_step(team, State.at_rest([[0.0, 0, 1]]), rpm).rpm, rpm)


@pytest.mark.slow
@pytest.mark.parametrize("step", [single_step, full_step], ids=["instant", "lagging"])
def test_a_command_out_of_range_flies_as_its_nearest_limit(step):
    """Of each vehicle, for a quarter of a second: twice the highest speed as that speed, -1,000 RPM as none."""
    start, top = flying(mixed), jnp.broadcast_to(mixed.max_rpm[:, None], (len(VEHICLES), 4))
    out = jnp.stack([jnp.where(jnp.arange(4) % 2 == k, 2 * top, -1000.0) for k in (0, 1)])
    within = jnp.clip(out, 0, top[None])
    flights = [fly(step, mixed, start, jnp.repeat(rpm, 30, axis=0)) for rpm in (out, within)]
    assert_close(*flights, atol=0)
    assert jnp.all((flights[0].rpm >= 0) & (flights[0].rpm <= top[None]))


@pytest.mark.slow
def test_a_start_with_rotor_speeds_out_of_range_flies_as_one_on_the_limit():
    """So a rotor that is said to turn backwards does not lift."""
    start = flying(mixed)
    out = jnp.tile(jnp.array([[-1e4, 0, 1e5, 2e3]]), (len(VEHICLES), 1))
    starts = [start.replace(rpm=rpm) for rpm in (out, jnp.clip(out, 0, mixed.max_rpm[:, None]))]
    assert_close(*(fly(full_step, mixed, s, tape(mixed, 30)) for s in starts), atol=0)


@pytest.mark.slow
@pytest.mark.parametrize("step", [single_step, full_step], ids=["instant", "lagging"])
def test_without_a_limit_motors_follow_and_the_gradient_of_a_flight_is_finite(step):
    """As recordings of versions that did not limit are flown; `rollout` takes an infinite `max_rpm` for a number."""
    team = mixed.replace(max_rpm=jnp.full(len(VEHICLES), jnp.inf))
    rpm = jnp.broadcast_to(2 * mixed.max_rpm[:, None], (len(VEHICLES), 4))
    start = flying(mixed).replace(rpm=rpm)
    end, _ = jaxdrones.rollout(step, lambda params, memory, state, k: (memory, rpm), team, start, None, 2)
    np.testing.assert_array_equal(end.rpm, rpm)

    @jit_unoptimized
    @partial(jax.grad, argnums=(0, 1, 2))
    def slopes(team, start, rpm):
        return jnp.sum(fly.__wrapped__(step, team, start, jnp.stack([rpm] * 3)).pos)

    assert_finite(slopes(team, start, rpm))


@pytest.mark.slow
def test_only_with_contact_is_there_a_floor():
    """A drone that falls from 0.1 m with its rotors at rest, after a quarter of a second and more."""
    team, start = jaxdrones.repeat(cf2x, 1), State.at_rest([[0.0, 0, 0.1]])
    for effects, floor in ((), False), ((ground_contact,), True):
        end = make_step(effects, substeps=72)(team, start, jnp.zeros((1, 4)))
        assert (end.pos[0, 2] > 0) == floor


@pytest.mark.slow
def test_whole_numbers_and_lists_are_rotor_speeds_too():
    team, start = jaxdrones.repeat(cf2x, 1), State.at_rest([[0.0, 0, 1]])
    expected = single_step(team, start, jnp.full((1, 4), 15000.0))
    assert_close(single_step(team, start, jnp.full((1, 4), 15000)), expected, atol=0)
    assert_close(single_step(team, start, [[15000] * 4]), expected, atol=0)


def test_a_call_lasts_as_many_physics_steps_as_it_has_substeps():
    fallen = jaxdrones.make_step(dt=0.01, substeps=3)(
        jaxdrones.repeat(cf2x, 1), State.at_rest([[0.0, 0, 1]]), jnp.zeros((1, 4))
    )
    np.testing.assert_allclose(fallen.vel[0, 2], -3 * 0.01 * cf2x.gravity, rtol=1e-12)


@pytest.mark.slow
def test_substeps_equal_repeated_steps():
    team = jaxdrones.repeat(cf2x, 2)
    once = make_step((drag, ground_effect), (downwash,), lagging_rotors, substeps=5)
    start, command = flying(team), tape(team, 1)
    repeated = fly(full_step, team, start, jnp.repeat(command, 5, axis=0))
    assert_close(once(team, start, command[0]), jax.tree.map(lambda x: x[-1], repeated), ROUND_OFF)


@pytest.mark.slow
def test_compiled_equals_not_compiled():
    team = jaxdrones.repeat(cf2x, 1)
    step = make_step(substeps=2)
    start, command = flying(team), tape(team, 1)[0]
    with jax.disable_jit():
        plain = step(team, start, command)
    assert_close(step(team, start, command), plain, ROUND_OFF)


@pytest.mark.slow
def test_vmap_over_worlds_equals_a_loop():
    team = jaxdrones.repeat(cf2x, 2)
    worlds = [flying(team, seed) for seed in range(4)]
    command = tape(team, 4)
    batch = jax.tree.map(lambda *x: jnp.stack(x), *worlds)
    together = jax.jit(jax.vmap(full_step, (None, 0, 0)))(team, batch, command)
    for i, world in enumerate(worlds):
        assert_close(jax.tree.map(lambda x, i=i: x[i], together), full_step(team, world, command[i]), ROUND_OFF)


@pytest.mark.slow
def test_vmap_over_vehicles_equals_a_loop():
    teams = [jaxdrones.repeat(jaxdrones.load_params(vehicle), 1) for vehicle in VEHICLES]
    start, command = flying(teams[0]), tape(teams[0], 1)[0]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *teams)
    together = jax.jit(jax.vmap(single_step, (0, None, None)))(batch, start, command)
    for i, team in enumerate(teams):
        assert_close(jax.tree.map(lambda x, i=i: x[i], together), single_step(team, start, command), 1e-11, 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("rotors", [instant_rotors, lagging_rotors], ids=name_of)
def test_a_mixed_team_flies_as_each_vehicle_alone(rotors):
    step = make_step((drag, ground_effect), rotors=rotors)
    start, command = flying(mixed), tape(mixed, 60)
    together = fly(step, mixed, start, command)
    for i in range(len(VEHICLES)):
        alone = fly(step, one(mixed, i), one(start, i), command[:, i : i + 1])
        assert_close(jax.tree.map(lambda x, i=i: x[:, i : i + 1], together), alone, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize(("pair", "x"), [(downwash, 1000.0), (downwash_2021, 10.1)], ids=["jet", "paper"])
def test_a_distant_drone_changes_nothing(pair, x):
    """The paper's downwash ends at 10 m; the jet fades with the fourth power of the distance, to 1e-14 at 1 km."""
    step = make_step((drag,), (pair,))
    team = jaxdrones.repeat(cf2x, 2)
    start = State.at_rest([[0.0, 0, 1], [x, 0, 6]])
    command = tape(team, 100)
    together = fly(step, team, start, command)
    alone = fly(step, one(team, 0), one(start, 0), command[:, :1])
    assert_close(jax.tree.map(lambda x: x[:, :1], together), alone, ROUND_OFF)


@pytest.mark.slow
def test_a_lower_drone_leaves_the_upper_one_alone():
    step = make_step(pairs=(downwash,))
    team = jaxdrones.repeat(cf2x, 2)
    start = State.at_rest([[0, 0, 1.0], [0.02, 0, 1.5]])
    rpm = jnp.full((2, 4), cf2x.hover_rpm)
    end = fly(step, team, start, jnp.tile(rpm, (60, 1, 1)))
    assert end.pos[-1, 0, 2] < 0.99
    np.testing.assert_allclose(end.pos[-1, 1], start.pos[1], atol=ROUND_OFF)


@pytest.mark.slow
@pytest.mark.parametrize("pair", [downwash, downwash_2021], ids=name_of)
def test_a_drone_is_not_its_own_neighbour(pair):
    team = jaxdrones.repeat(cf2x, 1)
    start, command = flying(team), tape(team, 1)[0]
    alone = make_step()(team, start, command)
    assert_close(make_step(pairs=(pair,))(team, start, command), alone, atol=0)


def test_pairs_act_once_for_every_other_drone():
    """A pair that lifts each drone with the other's weight: in a mixed team everyone carries all the others."""

    def lift(params, state, other, other_state):
        return Wrench.of_force(jnp.stack([jnp.zeros(()), jnp.zeros(()), other.weight]))

    start = State.at_rest(np.zeros((4, 3)))
    end = make_step(pairs=(lift,), dt=1.0)(mixed, start, jnp.zeros((4, 4)))
    others = jnp.sum(mixed.weight) - mixed.weight
    np.testing.assert_allclose(end.vel[:, 2], others / mixed.mass - 9.8, rtol=1e-12)


def test_a_pair_may_break_down_where_a_drone_meets_itself():
    """A repulsion over the distance: its gradient at no distance would be not a number."""

    def repel(params, state, other, other_state):
        away = state.pos - other_state.pos
        return Wrench.of_force(1e-3 * away / jnp.linalg.norm(away) ** 2)

    team = jaxdrones.repeat(cf2x, 2)
    start, command = flying(team), tape(team, 1)[0]
    step = make_step(pairs=(repel,))
    assert_finite(jit_unoptimized(jax.grad(lambda s: jnp.sum(step(team, s, command).vel)))(start))


@pytest.mark.slow
def test_effects_and_pairs_add_up():
    """Two effects give the sum of their velocity changes; 1e-15 of some m/s."""
    team = jaxdrones.repeat(cf2x, 2)
    start, command = flying(team).replace(pos=jnp.array([[0, 0, 0.05], [0.01, 0, 0.3]])), tape(team, 1)[0]
    none, first, second, both = (
        make_step(effects, pairs)(team, start, command).vel
        for effects, pairs in [
            ((), ()),
            ((drag, ground_effect), ()),
            ((), (downwash,)),
            ((drag, ground_effect), (downwash,)),
        ]
    )
    assert np.all(first != none) and np.any(second != none)
    np.testing.assert_allclose(both - none, (first - none) + (second - none), atol=1e-14)


@pytest.mark.slow
def test_a_list_of_effects_can_be_changed_afterwards_and_an_iterator_is_refused():
    effects = [drag]
    step = jaxdrones.make_step(effects)
    effects.clear()
    team = jaxdrones.repeat(cf2x, 1)
    start, command = flying(team), tape(team, 1)[0]
    with_drag = make_step((drag,))(team, start, command)
    assert_close(step(team, start, command), with_drag, atol=0)
    with pytest.raises(ValueError, match=r"effects is <generator .*; give a sequence"):
        jaxdrones.make_step(effect for effect in (drag,))


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.parametrize("rotors", [instant_rotors, lagging_rotors], ids=name_of)
@pytest.mark.parametrize("integrator", INTEGRATORS, ids=name_of)
def test_float32_stays_float32(integrator, rotors):
    step = make_step((drag, ground_effect), (downwash, downwash_2021), rotors, integrator, substeps=2)
    start = State.at_rest([[0.0, 0, 1], [0, 0, 2]])
    end = jax.eval_shape(step, jaxdrones.repeat(jaxdrones.load_params("cf2x"), 2), start, jnp.zeros((2, 4)))
    assert {leaf.dtype for leaf in jax.tree.leaves(end)} == {jnp.dtype("float32")}


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.parametrize(
    "step",
    [make_step((drag, ground_effect), (downwash,)), make_step((drag,), (), lagging_rotors, rk4)],
    ids=["default", "lagging"],
)
def test_one_step_in_float32_agrees_with_float64(step):
    """1e-5 of the size of each array: dozens of roundings of 6e-8."""
    with jax.enable_x64(True):
        team = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 8)
        arguments = team, flying(team), tape(team, 1)[0]
        expected = step(*arguments)
    actual = step(*jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float32), arguments))
    for name in STATE:
        wanted = np.asarray(getattr(expected, name))
        size = float(np.max(np.abs(wanted)))
        np.testing.assert_allclose(getattr(actual, name), wanted, rtol=0, atol=1e-5 * size, err_msg=name)


@pytest.mark.float32
@pytest.mark.parametrize("integrator", mostly_slow([semi_implicit_euler, rk4], [semi_implicit_euler]), ids=name_of)
def test_ten_thousand_steps_keep_the_quaternion_at_unit_length_in_float32(integrator):
    """In hover with a slow spin, so that every step rounds; a drift of one rounding per step would be 6e-4."""
    team = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 1)
    start = State.at_rest([[0, 0, 1.0]], [0.3]).replace(omega=jnp.array([[0.0, 0, 0.7]]))
    end = make_step(integrator=integrator, substeps=10_000)(team, start, jnp.full((1, 4), team.hover_rpm[0]))
    assert end.quat.dtype == jnp.float32
    np.testing.assert_allclose(np.linalg.norm(end.quat), 1, atol=1e-5)
