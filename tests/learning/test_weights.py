"""Policies from the weights of other libraries."""

import itertools

import jax
import numpy as np
import pytest

from jaxdrones import envs
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.weights import mlp_policy

pytestmark = pytest.mark.float32


@pytest.mark.parametrize("per_agent", [False, True])
def test_the_policy_is_the_multilayer_perceptron_of_the_weights(per_agent):
    rng, drones = np.random.default_rng(0), 2
    shapes = [(5, 3), (4, 5), (2, 4)]
    lead = (drones,) if per_agent else ()
    layers = [(rng.normal(size=(*lead, *shape)), rng.normal(size=(*lead, shape[0]))) for shape in shapes]
    obs = rng.normal(size=(drones, 3))
    obs[:, 0] *= 1e3  # as rotor speeds, far beyond the ten standard deviations at which statistics clip
    for weight, _ in layers[:1]:
        weight[..., 0] /= 1e3
    x = obs.copy()
    for i, (weight, bias) in enumerate(layers):
        x = np.stack(
            [(weight[n] if per_agent else weight) @ x[n] + (bias[n] if per_agent else bias) for n in range(drones)]
        )
        x = np.maximum(x, 0) if i < 2 else np.tanh(x)
    policy = mlp_policy(
        [(w.astype(np.float32), b.astype(np.float32)) for w, b in layers], activation="relu", per_agent=per_agent
    )
    np.testing.assert_allclose(jax.jit(lambda obs: policy(obs))(obs.astype(np.float32)), x, atol=1e-5)
    assert policy.per_agent == per_agent and policy.network.hidden_sizes == (5, 4)


@pytest.mark.parametrize(
    ("sizes", "activation", "message"),
    [
        ([], "tanh", "layers is empty; give the weight and the bias of each linear layer"),
        (
            [(3, 5, 5), (5, 4, 4)],
            "tanh",
            r"weight 0 of layers has shape \(3, 5\); expected \(5, 5\): outputs and inputs",
        ),
        ([(5, 3, 5), (4, 6, 4)], "tanh", r"weight 1 of layers has shape \(4, 6\); expected \(4, 5\)"),
        ([(4, 3, 4)], "gelu", "unknown activation 'gelu'.*known: elu, relu, silu, tanh"),
    ],
)
def test_layers_that_do_not_follow_each_other_and_unknown_activations_are_refused(sizes, activation, message):
    layers = [(np.zeros(weight), np.zeros(bias)) for *weight, bias in sizes]
    with pytest.raises(ValueError, match=message):
        mlp_policy(layers, activation=activation)


def test_a_training_can_start_from_the_weights_of_another_library():
    """Their network is that of settings with its sizes; the statistics stay, as weights are scaled by 2^20."""
    env = envs.make("hover")
    sizes = [env.observation_size, 32, 32, env.action_size]
    policy = mlp_policy([(np.zeros((n, m), np.float32), np.zeros(n, np.float32)) for m, n in itertools.pairwise(sizes)])
    assert policy.network == jax.eval_shape(lambda key: Policy.init(key, env), jax.random.key(0)).network
    seen = jax.jit(policy.obs_stats.update)(np.full((10**6, sizes[0]), 3.0, np.float32))
    np.testing.assert_allclose(seen.scale, policy.obs_stats.scale, rtol=1e-5)
    np.testing.assert_allclose(seen.mean, policy.obs_stats.mean, atol=1e-5)
