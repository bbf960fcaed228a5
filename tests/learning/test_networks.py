import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones import envs
from jaxdrones.learning.networks import CNN, Policy, centralized_input


@pytest.fixture(scope="module")
def team():
    return envs.make("leader-follower")


def test_a_new_policy_hovers(team):
    obs = jax.random.normal(jax.random.key(1), (50, 2, 12))
    action = Policy.init(jax.random.key(0), team, (16, 16))(obs)
    assert action.shape == (50, 2, 1)
    assert jnp.max(jnp.abs(action)) < 0.1


def test_actions_are_bounded(team):
    policy = Policy.init(jax.random.key(0), team, (16,))
    wild = policy.replace(params=jax.tree.map(lambda p: 1e3 * jnp.ones_like(p), policy.params))
    assert jnp.max(jnp.abs(wild(jnp.ones((2, 12))))) <= 1


@pytest.mark.parametrize("per_agent", [False, True])
def test_drones_share_a_network_or_have_their_own(team, per_agent):
    policy = Policy.init(jax.random.key(0), team, (16,), per_agent)
    action = policy(jnp.ones((2, 12)))
    assert (action[0] == action[1]) == (not per_agent)


def test_a_policy_is_the_same_for_one_world_and_for_many(team):
    policy = Policy.init(jax.random.key(0), team, (16,), per_agent=True)
    obs = jax.random.normal(jax.random.key(1), (3, 5, 2, 12))
    np.testing.assert_allclose(policy(obs)[1, 2], policy(obs[1, 2]), rtol=1e-12)


def test_the_central_critic_of_the_paper_sees_25_numbers_its_own_first():
    obs = jnp.arange(24.0).reshape(2, 12)
    action = jnp.array([[100.0], [200.0]])
    seen = centralized_input(obs, action)
    np.testing.assert_array_equal(seen[0], [*range(24), 200])
    np.testing.assert_array_equal(seen[1], [*range(12, 24), *range(12), 100])


def test_a_layer_of_the_cnn_is_a_convolution():
    cnn, picture = CNN(channels=(5,), strides=(4,), features=7), jax.random.normal(jax.random.key(1), (2, 8, 12, 3))
    params = cnn.init(jax.random.key(0), picture)["params"]
    kernel, head = params["Dense_0"]["kernel"].reshape(4, 4, 3, 5), params["Dense_1"]
    found = nn.relu(nn.Conv(5, (4, 4), strides=4).apply({"params": {"kernel": kernel, "bias": jnp.ones(5)}}, picture))
    params = params | {"Dense_0": params["Dense_0"] | {"bias": jnp.ones(5)}}
    expected = nn.relu(found.reshape(2, -1) @ head["kernel"] + head["bias"][None])
    np.testing.assert_allclose(cnn.apply({"params": params}, picture), expected, rtol=1e-5, atol=1e-5)
