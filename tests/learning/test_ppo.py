"""Loss and learning rates of PPO."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized
from jax.flatten_util import ravel_pytree

import jaxdrones as jd
from jaxdrones.learning import batch, ppo, sharding


@pytest.mark.parametrize("advantage", [1.0, -1.0])
def test_the_loss_of_ppo_has_no_gradient_where_the_clipped_ratio_is_worse_and_falls_with_the_entropy(
    advantage, monkeypatch
):
    """Where the ratio is beyond the clipping range to the side of the advantage."""
    config = ppo.Config(value_coef=0.0, clip_epsilon=0.2)
    monkeypatch.setattr(ppo, "discounted_value", lambda *_: jnp.zeros((1, 1)))
    policy, zero = SimpleNamespace(replay=lambda memory, obs, starts: obs), jnp.zeros((1, 1, 1))

    @jit_unoptimized
    @jax.grad
    def slope_of(log_std, ratio, entropy_coef):
        behavior = ppo.log_prob(zero, zero, jnp.zeros(1)) - jnp.log(ratio)
        batch = ppo.Batch(zero, zero, behavior, zero, jnp.full((1, 1), advantage), jnp.zeros((1, 1)))
        return ppo.loss(dataclasses.replace(config, entropy_coef=entropy_coef), policy, log_std, None, batch)[0]

    slopes = {ratio: slope_of(jnp.zeros(1), ratio, 0.0).item() for ratio in (0.79, 0.81, 1.19, 1.21)}
    clipped = 1.21 if advantage > 0 else 0.79
    assert [ratio for ratio, slope in slopes.items() if slope == 0] == [clipped]
    assert slope_of(jnp.zeros(1), clipped, 0.1).item() == pytest.approx(-0.1)
    assert slope_of(jnp.zeros(1), 1e30, 0.0).item() == 0  # beyond any range


def test_the_error_of_the_values_counts_by_its_weight_in_units_of_a_reward_and_the_entropy_by_its_own(monkeypatch):
    monkeypatch.setattr(ppo, "discounted_value", lambda config, critic, obs: obs)
    policy, zero = SimpleNamespace(replay=lambda memory, obs, starts: obs), jnp.zeros((2, 1))
    batch = ppo.Batch(zero[..., None], zero[..., None], zero, jnp.array([[3.0], [5.0]]), zero, zero + 1)
    for value_coef in 0.0, 0.5, 2.0:
        config = ppo.Config(gamma=0.75, value_coef=value_coef)
        loss, metrics = ppo.loss(config, policy, jnp.zeros(1), None, batch)
        assert metrics["value_loss"] == (0.5**2 + 1.0**2) / 2 and loss == value_coef * metrics["value_loss"]
    config, std = ppo.Config(value_coef=0.0, entropy_coef=2.0), np.array([0.5])
    loss, _ = ppo.loss(config, policy, jnp.log(std), None, batch)
    assert loss == pytest.approx(-2 * np.log(0.5 * np.sqrt(2 * np.pi * np.e)))


def test_the_divergence_of_ppo_is_that_of_the_updated_policy_seen_from_the_behavior_policy(monkeypatch):
    """Of two normal distributions; the mean over the behavior policy is one over equally likely actions."""
    monkeypatch.setattr(ppo, "discounted_value", lambda *_: jnp.zeros((4096, 1)))
    policy, zero = SimpleNamespace(replay=lambda memory, obs, starts: obs), jnp.zeros((4096, 1))
    action = jax.scipy.stats.norm.ppf((jnp.arange(4096.0) + 0.5) / 4096)[:, None, None]
    mean, std = 0.5, 0.5
    behavior = ppo.log_prob(action, jnp.zeros_like(action), jnp.zeros(1))
    batch = ppo.Batch(jnp.full_like(action, mean), action, behavior, action, zero, zero)
    loss = jit_unoptimized(lambda log_std: ppo.loss(ppo.Config(), policy, log_std, None, batch)[1]["kl"])
    expected = np.log(std) + (1 + mean**2) / (2 * std**2) - 0.5
    assert loss(jnp.log(jnp.array([std]))) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(("own", "expected"), [(0.0, 1e-3), (5e-3, 5e-3), (1.0, 2e-2)])
def test_the_learning_rate_of_the_critic_is_its_own_up_to_20_times_that_of_the_policy(own, expected):
    rates = ppo._rates(ppo.Config(critic_learning_rate=own), jnp.asarray(1e-3))
    np.testing.assert_allclose(rates, [1e-3, 1e-3, expected])


@pytest.mark.slow
def test_the_critic_learns_at_its_own_rate_and_the_policy_as_before():
    env = jd.make("hover", substeps=1)
    sizes = dict(worlds=8, horizon=4, minibatches=2, hidden_sizes=(4,), critic_hidden_sizes=(4,))
    config = ppo.Config(**sizes, max_grad_norm=1e9)  # a limit would couple the two by the norm of their gradients
    before = ppo.init(jax.random.key(0), env, config)

    @jit_unoptimized
    def updated(critic_learning_rate):
        changed = dataclasses.replace(config, critic_learning_rate=critic_learning_rate)
        state = ppo.update(env, changed, before)[0]
        return ravel_pytree(state.policy.params)[0], ravel_pytree(state.critic)[0]

    critic_before = ravel_pytree(before.critic)[0]
    (policy, critic), (same_policy, still), (_, other) = map(updated, (config.learning_rate, 1e-30, 1e-2))
    np.testing.assert_allclose(still, critic_before, atol=1e-20)
    np.testing.assert_allclose(same_policy, policy, rtol=1e-5)
    changes = jnp.linalg.norm(other - critic_before) / jnp.linalg.norm(critic - critic_before)
    assert changes == pytest.approx(1e-2 / config.learning_rate, rel=0.2)


def test_a_step_that_counts_has_the_same_weight_on_every_device(monkeypatch):
    """Two devices, emulated by `vmap`, of which one has a single valid step: drones of the others have ended."""
    config = ppo.Config()
    monkeypatch.setattr(ppo, "discounted_value", lambda config, critic, obs: obs)
    policy, log_std = SimpleNamespace(replay=lambda memory, obs, starts: obs), jnp.zeros(1)
    keys = jax.random.split(jax.random.key(0), 5)
    obs, action = (jax.random.normal(key, (2, 3, 1)) for key in keys[:2])
    log_prob, value, advantage = (jax.random.normal(key, (2, 3)) for key in keys[2:])
    valid = jnp.array([[True, True, True], [False, True, False]])
    batch = ppo.Batch(obs, action, log_prob - 1, value, advantage, -value, valid=valid)
    loss = jit_unoptimized(lambda batch: ppo.loss(config, policy, log_std, None, batch))
    expected = loss(jax.tree.map(lambda x: x.reshape(6, *x.shape[2:]), batch))
    monkeypatch.setattr(sharding, "mean_over_devices", lambda tree: jax.lax.pmean(tree, "devices"))
    shares = jax.vmap(lambda batch: ppo.loss(config, policy, log_std, None, batch), axis_name="devices")(batch)
    for mean, one in zip(jax.tree.leaves(shares), jax.tree.leaves(expected), strict=True):
        assert jnp.mean(mean) == pytest.approx(one.item(), rel=1e-5)


def test_a_step_is_followed_by_the_next_one_or_by_what_was_seen_last(monkeypatch):
    """The value after a step is that before the next one, and at a cut or in the end that of the last observation.

    The latter has the memory after that observation. Only the first of two drones is cut.
    """
    monkeypatch.setattr(batch, "critic_observation", lambda policy, obs, hidden, *_: obs + hidden)
    monkeypatch.setattr(batch, "discounted_value", lambda config, critic, obs: obs[..., 0])
    obs = jnp.arange(16.0).reshape(4, 2, 2, 1)
    terminated, truncated = np.zeros((2, 4, 2, 2), bool)
    terminated[1, 0], truncated[::2, 1, 0] = True, True
    flight = SimpleNamespace(
        **dict(obs=obs, final_obs=100 + obs, action=obs, extras=obs, reward=jnp.ones((4, 2, 2)), hidden_state=0 * obs),
        **dict(terminated=jnp.asarray(terminated), truncated=jnp.asarray(truncated)),
        was_done=jnp.zeros((4, 2, 2), bool).at[2:, 0, 1].set(True),
        **dict(done=jnp.array([[0, 1], [1, 0], [0, 1], [0, 1]]) == 1, privileged=None, final_privileged=None),
    )
    policy = SimpleNamespace(
        act=lambda hidden, obs: (hidden + 1000, obs), obs_stats=SimpleNamespace(normalize=lambda x: x)
    )
    state = SimpleNamespace(policy=policy, critic=None, log_std=jnp.zeros(1))
    noise = jnp.zeros((3, 2, 2, 1))
    config = ppo.Config(gae_lambda=0.0, gamma=0.5)
    found, alone = jit_unoptimized(
        lambda: [batch.batch_of(config, state, obs[0], flight, noise, ends_alone) for ends_alone in (False, True)]
    )()
    following = np.array([[4, 1102], [0, 10], [12, 1110], [1112, 1114]])[..., None] + np.arange(2)
    following[1, 0] = 0  # after a termination
    np.testing.assert_allclose(found.value_target, 1 + 0.5 * following)
    np.testing.assert_array_equal(found.starts, [[0, 0], [0, 1], [1, 0], [0, 1]])
    advantage = found.value_target - obs[..., 0]
    normalized = (advantage - np.mean(advantage)) / np.std(advantage)  # over all steps of all worlds
    np.testing.assert_allclose(found.advantage, normalized, rtol=1e-6)
    advantage = advantage[alone.valid]
    np.testing.assert_allclose(alone.advantage[alone.valid], (advantage - np.mean(advantage)) / np.std(advantage), 1e-6)


def test_a_minibatch_has_all_steps_of_equally_spaced_worlds():
    number = jnp.arange(24).reshape(2, 4, 3)
    expected = np.stack([number[:, i::2] for i in range(2)])
    for starts, per_agent, shape in (
        (None, False, (2, 12)),
        (None, True, (2, 4, 3)),
        (number[..., 0], True, (2, 2, 2, 3)),
    ):
        cut = batch.minibatches(
            SimpleNamespace(minibatches=2, per_agent=per_agent), ppo.Batch(*6 * [number], starts=starts)
        )
        np.testing.assert_array_equal(cut.advantage, expected.reshape(shape))


def test_no_noise_of_an_update_is_used_twice(monkeypatch):
    """The actions of the trajectory and those with which the critic is bootstrapped are drawn independently."""
    env = SimpleNamespace(drones=2, action_size=3, steps=5, task=SimpleNamespace(truncations=(), ends="team"))
    config, drawn = ppo.Config(worlds=4, horizon=12, minibatches=2, privileged_critic=True), []
    state = ppo.TrainState(0, jax.random.key(0), None, None, None, jnp.zeros(3), None, None)

    def learn(state, hidden_state, trajectory, noise):
        drawn.append(noise)
        assert trajectory is config.privileged_critic
        raise StopIteration

    for name in ("draw_starts", "progress_of"):
        monkeypatch.setattr(ppo.collect, name, lambda *_: None)
    monkeypatch.setattr(ppo.collect, "restart", lambda *_: SimpleNamespace(hidden_state=None))
    monkeypatch.setattr(ppo.collect, "collect", lambda *_, noise, privileged, **__: (drawn.append(noise), privileged))
    monkeypatch.setattr(ppo.sharding, "map_worlds", lambda *_: learn)
    with pytest.raises(StopIteration):
        ppo.update(env, config, state)
    assert [x.shape for x in drawn] == [(12, 4, 2, 3), (4, 4, 2, 3)]  # at most 3 truncations, and the last step
    assert len(np.unique(np.concatenate(drawn))) == 16 * 4 * 2 * 3
    env.task.truncations = ("lost",)
    assert ppo._most_truncations(env, 12) == 12  # in every step
