"""Images of any resolution go through every adapter, within the spaces that it declares."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones as jd
from jaxdrones.sensing import DepthNoise

pytestmark = pytest.mark.float32
SHAPE = (4, 5)
CAMERA = jd.Camera(resolution=SHAPE[::-1], rate=50.0, far=30.0, noise=DepthNoise(spread=0.01, dropout=0.1))


@pytest.fixture
def env(env_of):
    return env_of("hover", drones=2, vision=("rgb", "depth", "segmentation"), camera=CAMERA)


@pytest.mark.slow
def test_gymnasium_gives_what_its_spaces_promise(env):
    pytest.importorskip("gymnasium")
    from jaxdrones.adapters.gymnasium import GymnasiumEnv

    one = GymnasiumEnv(env)
    space = one.observation_space
    assert space["depth"].shape == (2, *SHAPE) and space["depth"].high.max() == 30.0
    assert space["segmentation"].high.max() == 2 and space["rgb"].dtype == np.uint8
    assert one.reset(seed=0)[0] in space
    assert one.step(one.action_space.sample())[0] in space


@pytest.mark.slow
def test_many_worlds_of_gymnasium_give_what_their_spaces_promise(env):
    pytest.importorskip("gymnasium")
    from jaxdrones.adapters.gymnasium import VectorEnv

    envs = VectorEnv(env, 3)
    space = envs.observation_space
    assert space["rgb"].shape == (3, 2, *SHAPE, 4)
    assert envs.reset(seed=0)[0] in space
    assert envs.step(envs.action_space.sample())[0] in space


@pytest.mark.slow
def test_pettingzoo_gives_what_its_spaces_promise(env):
    pytest.importorskip("pettingzoo")
    from jaxdrones.adapters.pettingzoo import parallel_env

    team = parallel_env(env)
    obs, _ = team.reset(seed=0)
    after, *_ = team.step({agent: team.action_space(agent).sample() for agent in team.agents})
    for agent in team.possible_agents:
        assert obs[agent] in team.observation_space(agent) and after[agent] in team.observation_space(agent)
    assert team.state() in team.state_space


@pytest.mark.slow
def test_brax_gives_images_by_the_names_that_its_networks_look_for(env):
    pytest.importorskip("brax")
    from jaxdrones.adapters import brax

    wrapped = brax.wrap(env)
    size = 2 * env.observation_size
    h, w = SHAPE
    shapes = {"state": (size,), "pixels/rgb": (h, w, 8), "pixels/depth": (h, w, 2), "pixels/segmentation": (h, w, 2)}
    assert wrapped.observation_size == shapes
    training = brax.wrap_for_training(wrapped, episode_length=5)
    state = jax.eval_shape(training.reset, jax.ShapeDtypeStruct((3, 2), jnp.uint32))
    after = jax.eval_shape(training.step, state, jax.ShapeDtypeStruct((3, wrapped.action_size), jnp.float32))
    assert {name: x.shape[1:] for name, x in after.obs.items()} == shapes
    assert {x.dtype for x in after.obs.values()} == {jnp.dtype("float32")}


@pytest.mark.slow
def test_the_drones_of_a_team_are_the_channels_of_an_image_of_brax(env):
    pytest.importorskip("brax")
    from jaxdrones.adapters import brax

    key = jax.random.PRNGKey(1)
    obs, _ = env.reset(jax.random.split(key)[1])
    pixels = brax.wrap(env).reset(key).obs
    np.testing.assert_array_equal(pixels["pixels/depth"], np.moveaxis(obs["depth"], 0, -1))
    np.testing.assert_array_equal(pixels["pixels/rgb"][..., 4:], obs["rgb"][1])
