"""Episodes that follow one another."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.envs import autoreset, make

env = make("hover", duration=0.05)
auto = autoreset(env)
KEYS = jax.random.split(jax.random.key(0), 13)


def fly():
    obs, episode = auto.reset(KEYS[0])
    rows = []
    for key in KEYS[1:]:
        before = episode
        obs, episode, reward, terminated, truncated, info = auto.step(key, episode, jnp.zeros((1, 4)))
        rows.append((before, obs, episode, reward, terminated | truncated, info))
    return rows


ROWS = fly()
LAST = [k for k, row in enumerate(ROWS) if row[4]]


def test_episodes_end_when_theirs_do():
    assert LAST == [4, 9]


def test_after_an_end_a_fresh_episode_is_seen_and_the_last_observation_is_kept():
    before, obs, episode, _, _, info = ROWS[LAST[0]]
    expected, _, *_ = env.step(KEYS[1 + LAST[0]], before.world, jnp.zeros((1, 4)))
    np.testing.assert_array_equal(info["final_obs"], expected)
    assert episode.world.step == 0 and not np.allclose(obs, expected)


def test_every_episode_starts_elsewhere():
    starts = [np.asarray(ROWS[k][2].world.drones.pos) for k in LAST]
    assert not np.allclose(starts[0], starts[1])


def test_statistics_are_those_of_the_episode():
    for first, last in (0, LAST[0]), (LAST[0] + 1, LAST[1]):
        info = ROWS[last][5]
        assert info["episode"]["length"] == 5
        np.testing.assert_allclose(info["episode"]["return"], sum(row[3] for row in ROWS[first : last + 1]), rtol=1e-12)
