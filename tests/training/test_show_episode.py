"""The episode of a policy in the viewer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from viewer_payload import decode

import jaxdrones as jd
from jaxdrones.training.episode import fly_episode


@pytest.mark.slow
def test_an_episode_shows_its_own_drones_scene_and_targets():
    env = jd.make("gates", duration=0.1)
    episode = fly_episode(env, lambda obs: jnp.zeros((1, env.action_size)), jax.random.key(0))
    page = decode(jd.show(episode).payload)
    world = page["worlds"][0]
    np.testing.assert_allclose(world["pos"], episode.drones.pos, rtol=0, atol=1e-4)
    np.testing.assert_allclose(world["targets"], episode.target, rtol=0, atol=1e-4)
    assert len(page["scenes"][0]["obstacles"]) == episode.scene.count > 0
    np.testing.assert_allclose(page["vehicles"][0]["mass"], episode.params.mass[0])


@pytest.mark.slow
def test_an_episode_of_a_policy_that_sees_shows_what_it_saw_once():
    camera = jd.Camera(resolution=(8, 6), rate=10.0)
    env = jd.make("hover", duration=0.3, vision=("depth",), camera=camera)
    episode = fly_episode(env, lambda obs: jnp.zeros((1, env.action_size)), jax.random.key(0))
    (images,) = decode(jd.show(episode).payload)["worlds"][0]["images"]
    assert images["name"] == "depth" and images["frames"].shape[1:] == (1, 6, 8, 1)
    assert 2 <= len(images["frames"]) <= 4  # every 0.1 s, and the start


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["explicit", pytest.param("bullet", marks=pytest.mark.needs("pybullet"))])
def test_an_episode_is_the_same_when_it_is_watched(backend):
    watched = []
    with jd.make("hover", duration=0.5, backend=backend) as env:  # at 100 Hz

        def policy(obs):
            return 0.1 * obs[:, :4]

        alone = fly_episode(env, policy, jax.random.key(0))
        episode = fly_episode(env, policy, jax.random.key(0), watch=lambda *part: watched.append(part))
    assert len(watched) == -(-len(episode.t) // 3) and {end for _, end in watched} == {0.5}
    for name in ("t", "target", "reward"):
        parts = np.concatenate([getattr(part, name) for part, _ in watched])
        np.testing.assert_array_equal(parts, getattr(episode, name))
        np.testing.assert_allclose(parts, getattr(alone, name), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(episode.drones.pos, alone.drones.pos, rtol=0, atol=1e-5)
    assert (episode.success, episode.ended_by) == (alone.success, alone.ended_by)
