import types

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones import envs
from jaxdrones.learning.critic import centralized_input
from jaxdrones.learning.layers import CNN, IMAGE_CHANNELS, _kernel_init, _orthogonal_gates, _patches, convolutions
from jaxdrones.learning.networks import Policy, apply, init_params


@pytest.fixture(scope="module")
def team():
    return envs.make("leader-follower")


@pytest.mark.slow
def test_a_new_policy_hovers(team):
    obs = jax.random.normal(jax.random.key(1), (50, 2, 12))
    action = Policy.init(jax.random.key(0), team, (16, 16))(obs)
    assert action.shape == (50, 2, 1)
    assert jnp.max(jnp.abs(action)) < 0.1


def test_observations_of_another_size_are_refused(team):
    policy = Policy.init(jax.random.key(0), team, (4,))
    with pytest.raises(ValueError, match="obs has 11 entries for each drone, and the policy takes 12"):
        policy(jnp.ones((2, 11)))


@pytest.mark.slow
def test_actions_are_bounded(team):
    policy = Policy.init(jax.random.key(0), team, (16,))
    wild = policy.replace(params=jax.tree.map(lambda p: 1e3 * jnp.ones_like(p), policy.params))
    assert jnp.max(jnp.abs(wild(jnp.ones((2, 12))))) <= 1


@pytest.mark.parametrize("per_agent", [False, True])
@pytest.mark.slow
def test_drones_share_a_network_or_have_their_own(team, per_agent):
    policy = Policy.init(jax.random.key(0), team, (16,), per_agent)
    action = policy(jnp.ones((2, 12)))
    assert (action[0] == action[1]) == (not per_agent)


@pytest.mark.slow
def test_a_policy_is_the_same_for_one_world_and_for_many(team):
    policy = Policy.init(jax.random.key(0), team, (16,), per_agent=True)
    obs = jax.random.normal(jax.random.key(1), (3, 5, 2, 12))
    np.testing.assert_allclose(policy(obs)[1, 2], policy(obs[1, 2]), rtol=1e-12)


def test_every_drone_has_its_own_parameters_and_memory_also_in_a_sequence():
    """A network of two drones in three worlds, with a memory of four numbers, over five steps."""
    drawn = types.SimpleNamespace(
        init=lambda key, example: jax.random.uniform(key) * example,
        apply=lambda params, x, memory, starts: (x, params[0] * x + memory[None, :, :1]),
    )
    params = init_params(jax.random.key(0), drawn, jnp.ones(1), agents=2)
    assert params.shape == (2, 1) and params[0] != params[1]
    x, memory = jnp.arange(30.0).reshape(5, 3, 2, 1), jnp.arange(24.0).reshape(3, 2, 4)
    output = apply(drawn, params, x, True, memory, jnp.zeros((5, 3), bool))[1]
    expected = np.asarray(x) * np.asarray(params) + np.asarray(memory)[..., :1]
    np.testing.assert_allclose(output, expected, rtol=1e-6)


def test_the_central_critic_of_the_paper_sees_25_numbers_its_own_first():
    obs = jnp.arange(24.0).reshape(2, 12)
    action = jnp.array([[100.0], [200.0]])
    seen = centralized_input(obs, action)
    np.testing.assert_array_equal(seen[0], [*range(24), 200])
    np.testing.assert_array_equal(seen[1], [*range(12, 24), *range(12), 100])


def test_the_actions_of_a_central_critic_are_in_the_order_of_its_observations():
    seen = centralized_input(jnp.arange(3.0)[:, None], 10 + jnp.arange(3.0)[:, None])
    np.testing.assert_array_equal(seen, [[0, 1, 2, 11, 12], [1, 2, 0, 12, 10], [2, 0, 1, 10, 11]])


@pytest.mark.slow
def test_a_layer_of_the_cnn_is_a_convolution():
    cnn, picture = CNN(channels=(5,), strides=(4,), features=7), jax.random.normal(jax.random.key(1), (2, 8, 12, 3))
    params = cnn.init(jax.random.key(0), picture)["params"]
    kernel, head = params["Dense_0"]["kernel"].reshape(4, 4, 3, 5), params["Dense_1"]
    found = nn.relu(nn.Conv(5, (4, 4), strides=4).apply({"params": {"kernel": kernel, "bias": jnp.ones(5)}}, picture))
    params = params | {"Dense_0": params["Dense_0"] | {"bias": jnp.ones(5)}}
    expected = nn.relu(found.reshape(2, -1) @ head["kernel"] + head["bias"][None])
    np.testing.assert_allclose(cnn.apply({"params": params}, picture), expected, rtol=1e-5, atol=1e-5)


def test_large_images_are_reduced_by_four_and_small_ones_by_two_to_at_most_20_pixels():
    assert convolutions(48, 64) == ((16, 32), (4, 4))
    assert convolutions(12, 16) == ((16,), (4,))
    assert convolutions(9, 9) == ((16, 32), (2, 2)) and convolutions(4, 5) == ((), ())


def test_squares_of_an_image_are_padded_with_nothing_on_both_sides():
    image = np.arange(1.0, 16.0).reshape(5, 3, 1)
    squares = _patches(jnp.asarray(image), 4)
    framed = np.pad(image[..., 0], ((1, 2), (0, 1)))
    np.testing.assert_array_equal(squares, [[framed[:4].ravel()], [framed[4:].ravel()]])


def test_the_first_weights_are_normal_with_the_scale_of_the_outputs():
    kernel = _kernel_init(0.1)(jax.random.key(0), (100, 50))
    assert np.std(kernel) == pytest.approx(0.1 / 100**0.5, rel=0.04)  # four standard errors


@pytest.mark.slow
def test_the_first_weights_of_the_gates_of_a_memory_are_different_orthogonal_matrices():
    gates = np.split(np.asarray(_orthogonal_gates(jax.random.key(0), 3, float)), 3, axis=1)
    for i, gate in enumerate(gates):
        np.testing.assert_allclose(gate @ gate.T, np.eye(3), atol=1e-12)
        assert np.any(gate != gates[i - 1])


QUICK = [(17, 13), (5, 3)]
SLOW = [pytest.param(*size, marks=pytest.mark.slow) for size in [(16, 12), (16, 9), (80, 60), (64, 48), (33, 1)]]


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), QUICK + SLOW)
def test_a_cnn_takes_images_of_any_resolution_and_sees_all_of_it(width, height):
    channels, strides = convolutions(height, width)
    cnn = CNN(channels, strides, features=64)
    image = jax.random.uniform(jax.random.key(1), (height, width, 1))
    params = cnn.init(jax.random.key(0), image)
    gradient = jax.grad(lambda image: jnp.sum(cnn.apply(params, image)))(image)
    assert jnp.mean(gradient != 0) > 0.9  # a pixel whose units are all off has none


@pytest.mark.slow
def test_an_image_that_is_no_multiple_of_the_strides_has_a_margin_of_nothing():
    cnn = CNN(channels=(5,), strides=(4,), features=7)
    image = jax.random.uniform(jax.random.key(1), (10, 15, 2))
    framed = jnp.pad(image, ((1, 1), (0, 1), (0, 0)))
    params = cnn.init(jax.random.key(0), framed)
    np.testing.assert_array_equal(cnn.apply(params, image), cnn.apply(params, framed))


def test_nearness_is_1_at_the_eye_and_0_where_nothing_is_with_finite_gradients_throughout():
    depth = jnp.array([[-0.1, 0.0, 0.3, 1.0, 5.0, 10.0, 24.0, 1000.0, jnp.inf]])

    def nearness(depth):
        return IMAGE_CHANNELS["depth"](depth, 3.0)[..., 0]

    seen, slope = jax.jit(lambda x: (nearness(x), jax.grad(lambda x: jnp.sum(nearness(x)))(x)))(depth)
    seen, slope = np.asarray(seen[0]), np.asarray(slope[0])
    assert seen[0] == seen[1] == 1 and seen[-1] == 0 and np.all(np.diff(seen[1:]) < 0)
    assert np.all(np.isfinite(slope)) and np.all(np.abs(slope) <= 1 / 3 + 1e-12) and np.all(slope[2:-1] < 0)
    assert seen[5] - seen[-2] > 0.2  # what is 10 m away differs clearly from nothing
