"""Episodes that follow one another."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close

from jaxdrones.envs import AutoReset, make
from jaxdrones.envs.autoreset import Episode
from jaxdrones.envs.episode import RESET
from jaxdrones.envs.randomize import scaled

env = make("hover", duration=0.05)
auto = AutoReset(env)
KEYS = jax.random.split(jax.random.key(0), 13)


@functools.cache
def flown():
    """What each step was given and returned, and the numbers of the steps in which an episode ends."""
    obs, episode = auto.reset(KEYS[0])
    rows = []
    for key in KEYS[1:]:
        before = episode
        obs, episode, reward, terminated, truncated, info = auto.step(key, episode, jnp.zeros((1, 4)))
        rows.append((before, obs, episode, reward, terminated | truncated, info))
    return rows, [k for k, row in enumerate(rows) if row[4]]


def test_episodes_end_when_theirs_do():
    assert flown()[1] == [4, 9]


def test_after_an_end_a_fresh_episode_is_seen_and_the_last_observation_is_kept():
    rows, (end, _) = flown()
    before, obs, episode, _, _, info = rows[end]
    expected, _, *_ = env.step(KEYS[1 + end], before.world, jnp.zeros((1, 4)))
    np.testing.assert_array_equal(info["final_obs"], expected)
    assert episode.world.step == 0 and not np.allclose(obs, expected)
    assert not np.allclose(obs, env.reset(KEYS[1 + end])[0]), "the key of the step has been used"


def test_images_of_a_start_draw_from_the_key_of_the_reset():
    keys = []
    seeing = SimpleNamespace(
        begin=env.begin,
        drones=1,
        constant_fields=env.constant_fields,
        vision=True,
        with_images=lambda method, key, world, ended: keys.append(key) or world,
    )
    AutoReset(seeing).renewed(jnp.asarray(True), KEYS[0], *auto.reset(KEYS[1]))
    assert keys == [jax.random.fold_in(KEYS[0], RESET)]


def test_parameters_are_constant_unless_something_changes_them():
    """A disturbance without memory does, too, though nothing is drawn at a start."""
    pushed = make("hover", disturbance=lambda key, params, dt: params.replace(external_force=params.external_force + 1))
    drawn = make("hover", randomize=(scaled("mass", 0.9, 1.1),))
    assert [e.constant_fields for e in (env, pushed, drawn)] == [("params", "scene"), ("scene",), ("scene",)]


def test_the_return_of_a_drone_has_the_reward_of_its_last_step():
    """After which it is not in the world."""
    world = SimpleNamespace(active=jnp.array([False, True]))
    no = jnp.zeros((), bool)
    step = lambda key, world, action: (None, world, jnp.array([3.0, 5.0]), no, no, {})  # noqa: E731
    before = Episode(world, jnp.array([10.0, 20.0]), jnp.asarray(4))
    after, *_, info = AutoReset(SimpleNamespace(step=step)).step_without_reset(KEYS[0], before, jnp.zeros((2, 4)))[1:]
    assert after.episode_return.tolist() == info["episode"]["return"].tolist() == [13, 25]
    assert after.length == info["episode"]["length"] == 5


def test_every_episode_starts_elsewhere():
    rows, last = flown()
    starts = [np.asarray(rows[k][2].world.drones.pos) for k in last]
    assert not np.allclose(starts[0], starts[1])


def test_statistics_are_those_of_the_episode():
    rows, ends = flown()
    for first, last in (0, ends[0]), (ends[0] + 1, ends[1]):
        info = rows[last][5]
        assert info["episode"]["length"] == 5
        np.testing.assert_allclose(info["episode"]["return"], sum(row[3] for row in rows[first : last + 1]), rtol=1e-12)


@pytest.mark.slow
def test_of_many_worlds_those_that_end_start_as_each_would_alone():
    """A few at once, and all at once."""
    keys = jax.random.split(jax.random.key(1), 130)
    _, episodes = jax.jit(jax.vmap(auto.reset))(keys)
    step = jax.jit(auto.step)
    for ending in ([7, 100], range(130)):
        age = jnp.zeros(130, jnp.int32).at[jnp.array(list(ending))].set(env.steps - 1)
        aged = episodes.replace(world=episodes.world.replace(step=age))
        zeros = jnp.zeros((130, 1, 4))
        together = jax.jit(jax.vmap(auto.step))(keys, aged, zeros)
        np.testing.assert_array_equal(np.flatnonzero(together[4]), list(ending))
        for i in (7, 8, 100):
            alone = step(keys[i], jax.tree.map(lambda x, i=i: x[i], aged), zeros[i])
            assert_close(jax.tree.map(lambda x, i=i: x[i], together[:5]), alone[:5], 1e-12)


@pytest.mark.slow
def test_gradients_pass_through_autoreset_the_same_way_in_and_out_of_vmap():
    keys = jax.random.split(jax.random.key(1), 70)
    _, episodes = jax.vmap(auto.reset)(keys)

    def returned(action, key, episode):
        def advance(episode, k):
            _, episode, reward, *_ = auto.step(jax.random.fold_in(key, k), episode, action)
            return episode, jnp.sum(reward)

        return jnp.sum(jax.lax.scan(advance, episode, jnp.arange(7))[1])

    actions = 0.1 * jax.random.normal(jax.random.key(2), (70, 1, 4))
    inside = jax.jit(jax.vmap(jax.grad(returned)))(actions, keys, episodes)
    outside = jax.jit(jax.grad(lambda a: jnp.sum(jax.vmap(returned)(a, keys, episodes))))(actions)
    assert_close(inside, outside, 1e-12)
    assert np.abs(inside).max() > 1e-3
