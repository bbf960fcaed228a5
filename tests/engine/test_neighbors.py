"""Pair effects of large teams, limited to drones near each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, jit_unoptimized

import jaxdrones as jd
from jaxdrones.engine.physics import Physics
from jaxdrones.sensing import Scene

N, REACH = 60, 2.0
rng = np.random.default_rng(0)


def team(spread):
    """Drones on several heights within +-spread (m), turning rotors of several speeds, no two vehicles alike."""
    params = jd.repeat(jd.load_params("cf2x"), N)
    params = params.replace(kf=params.kf * jnp.linspace(0.9, 1.1, N), mass=params.mass * jnp.linspace(1.1, 0.9, N))
    pos = np.column_stack([rng.uniform(-spread, spread, (N, 2)), rng.uniform(0, 3, N)])
    state = jd.State.at_rest(jnp.asarray(pos))
    return params, state.replace(rpm=jnp.asarray(rng.uniform(10_000, 20_000, (N, 4))))


def cut_off(pair):
    """The same effect, for the plain sum over all pairs, but nothing beyond the reach."""

    def within(params, state, other, other_state):
        near = jnp.hypot(*(other_state.pos - state.pos)[:2]) < REACH
        return jax.tree.map(lambda x: jnp.where(near, x, 0), pair(params, state, other, other_state))

    return within


def total_wrench(pairs, neighbors=None):
    physics = Physics(pairs=pairs, neighbors=neighbors)
    return lambda params, state: physics.wrench(params, state, Scene())


@pytest.mark.slow
@pytest.mark.parametrize("spread", [1.0, 8.0, 100.0], ids=["more than fit: all pairs", "some near", "hardly any"])
def test_nobody_within_reach_is_left_out_and_nobody_else_counts(spread):
    params, state = team(spread)
    cells = jd.NeighborGrid(REACH, capacity=16)
    assert bool(cells.near(state.pos)[2]) == (spread > 1.0)
    by_cells = jit_unoptimized(total_wrench((jd.downwash,), cells))(params, state)
    by_pairs = jit_unoptimized(total_wrench((cut_off(jd.downwash),)))(params, state)
    assert_close(by_cells, by_pairs, 1e-13)
    alone = jit_unoptimized(total_wrench(()))(params, state)
    assert (np.max(np.abs(by_cells.force - alone.force)) > 1e-6) == (spread < 100)


@pytest.mark.slow
def test_many_worlds_compute_near_pairs_or_all_pairs_and_not_both():
    cells = jd.NeighborGrid(REACH, capacity=16)
    (params, near), (_, crowded) = team(8.0), team(1.0)
    worlds = jax.tree.map(lambda *x: jnp.stack(x), near, crowded)
    force = jax.vmap(total_wrench((jd.downwash,), cells), (None, 0))
    program = str(jax.make_jaxpr(force)(params, worlds))
    assert " cond[" in program  # not a selection, which computes both branches
    alone = total_wrench((cut_off(jd.downwash),))
    for wrench, state in zip((force(params, worlds).force), (near, crowded), strict=True):
        assert_close(wrench, jit_unoptimized(alone)(params, state).force, 1e-13)


@pytest.mark.parametrize("drones, complete", [(3, True), (4, False)])
def test_a_list_is_complete_up_to_its_capacity(drones, complete):
    pos = np.stack([0.1 * np.arange(drones), np.zeros(drones), np.ones(drones)], axis=-1)
    near, meant, all_there = jax.device_get(jit_unoptimized(jd.NeighborGrid(2.0, capacity=3).near)(pos))
    assert bool(all_there) == complete
    found = [set(near[:, i][meant[:, i]].tolist()) for i in range(drones)]
    assert all(found_by_one == set(range(drones)) for found_by_one in found) == complete


@pytest.mark.slow
def test_gradients_are_those_of_all_pairs():
    params, state = team(8.0)

    def lift(state, pairs, cells=None):
        return jnp.sum(total_wrench(pairs, cells)(params, state).force[:, 2] ** 2)

    by_cells = jit_unoptimized(jax.grad(lambda s: lift(s, (jd.downwash,), jd.NeighborGrid(REACH))))(state)
    by_pairs = jit_unoptimized(jax.grad(lambda s: lift(s, (cut_off(jd.downwash),))))(state)
    assert_close(by_cells, by_pairs, 1e-12)
    assert np.max(np.abs(by_cells.pos)) > 1e-6


@pytest.mark.slow
def test_a_drone_that_is_lost_does_not_change_the_others():
    """Whose position is not a number or infinite, compared with one 10,000 km away."""
    params, state = team(8.0)
    wrench = jit_unoptimized(total_wrench((jd.downwash,), jd.NeighborGrid(REACH)))
    away, nowhere, infinitely_far = (
        jax.tree.map(lambda x: x[1:], wrench(params, state.replace(pos=state.pos.at[0, 0].set(x).at[0, 1:].set(0))))
        for x in (1e7, jnp.nan, jnp.inf)
    )
    assert_close(nowhere, away, 1e-13)
    assert_close(infinitely_far, away, 1e-13)


@pytest.mark.parametrize("settings, message", [({"cutoff": 0}, "cutoff"), ({"cutoff": 2.0, "capacity": 0}, "capacity")])
def test_cells_have_a_size_and_room(settings, message):
    with pytest.raises(ValueError, match=message):
        jd.NeighborGrid(**settings)


def test_cells_are_asked_for_by_name_and_with_pairs():
    with pytest.raises(ValueError, match=r"neighbors is 3\.0"):
        jd.make_step(pairs=(jd.downwash,), neighbors=3.0)
    with pytest.raises(ValueError, match="neighbors is given without pairs"):
        jd.make_step(neighbors=jd.NeighborGrid(3.0))
