"""The league: who flies whom, who learns, and when a policy is kept."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from double_integrator import DoubleIntegrator, Point, PointWorld
from helpers import assert_close, jit_unoptimized

import jaxdrones as jd
from jaxdrones.learning import bptt, league

SMALL = dict(updates=4, worlds=4, horizon=3, hidden_sizes=(8,))
CONFIG = league.Config(**SMALL, past_policies=2, snapshot_interval=2)
KEY = jax.random.key(0)


def scaled(policy, factor):
    return policy.replace(params=jax.tree.map(lambda x: factor * x, policy.params))


def test_the_first_drones_are_flown_by_the_policy_and_the_others_by_the_past_policies_of_their_worlds():
    env = jd.make("hover", drones=3)
    policy = jit_unoptimized(lambda: league.init(KEY, env, CONFIG).policy)()
    past = jax.tree.map(lambda *x: jnp.stack(x), scaled(policy, 2.0), scaled(policy, -3.0))
    obs = jax.random.normal(KEY, (4, 3, env.observation_size))
    against = jit_unoptimized(lambda obs: league.against(past, policy)(None, None, obs)[1])
    action = against(obs)
    act = jit_unoptimized(lambda policy: policy(obs))
    np.testing.assert_allclose(action[:, 0], act(policy)[:, 0], rtol=1e-6)
    np.testing.assert_allclose(action[::2, 1:], act(scaled(policy, 2.0))[::2, 1:], rtol=1e-6)
    np.testing.assert_allclose(action[1::2, 1:], act(scaled(policy, -3.0))[1::2, 1:], rtol=1e-6)
    halves = jnp.concatenate([against(obs[:2]), against(obs[2:])])  # as on two devices
    np.testing.assert_allclose(halves, action, rtol=1e-6)


class Pair(DoubleIntegrator):
    """The first drone is rewarded for the actions of both, and the second one for `share` of that of the first."""

    drones = 2

    def __init__(self, share):
        self.share = share

    def reset(self, key):
        return jnp.zeros((2, 2)), PointWorld(Point(jnp.zeros((2, 2))), jnp.zeros((), jnp.int32))

    begin = reset

    def step(self, key, world, action):
        obs, world, _, *rest = super().step(key, world, action)
        first, second = action[:, 0]
        return obs, world, jnp.stack([first + second, self.share * first]), *rest


def test_an_update_flies_the_others_by_past_policies_and_learns_from_the_rewards_of_the_first_drones_alone():
    """The policies have constant actions: that of the present one is 0."""

    def constant(policy, action):
        return policy.replace(
            params=jax.tree.map(lambda x: jnp.full_like(x, 0 if x.ndim > 1 else jnp.arctanh(action)), policy.params)
        )

    def update(share):
        state = league.init(KEY, Pair(share), CONFIG)
        policy = constant(state.policy, 0.0)
        past = jax.tree.map(lambda *x: jnp.stack(x), constant(policy, 0.2), constant(policy, -0.6))
        return league.update(Pair(share), CONFIG, state.replace(policy=policy, past=past))[1]

    metrics = jit_unoptimized(jax.vmap(update))(jnp.array([0.0, 5.0]))
    np.testing.assert_allclose(metrics["reward"], (0.2 - 0.6) / 2 / 2, rtol=1e-6)  # mean of both drones
    assert metrics["gradient_norm"][0] > 0 and metrics["gradient_norm"][0] == metrics["gradient_norm"][1]


def test_a_training_from_a_policy_begins_against_that_policy():
    env = jd.make("hover", drones=2)
    first = scaled(jit_unoptimized(lambda: league.init(KEY, env, CONFIG).policy)(), 2.0)
    with_first = jit_unoptimized(lambda first: league.init(KEY, env, CONFIG).with_policy(first))(first)
    assert_close(with_first.policy, first, 0)
    for i in range(CONFIG.past_policies):
        assert_close(jax.tree.map(lambda x, i=i: x[i], with_first.past), first, 0)


@pytest.mark.slow
def test_a_league_of_single_drones_learns_what_bptt_learns():
    env = jd.make("hover")
    expected = bptt.train(KEY, env, bptt.Config(**SMALL))
    found = league.train(KEY, env, CONFIG)
    assert_close(found.policy.params, expected.policy.params, 1e-6)


@pytest.mark.slow
def test_only_the_first_drone_learns_and_the_oldest_past_policy_is_replaced():
    env = jd.make("hover", drones=2)
    start = league.init(KEY, env, CONFIG)
    result = league.train(KEY, env, CONFIG)
    assert jax.tree.all(jax.tree.map(lambda x, first: x.shape == (2, *first.shape), start.past, start.policy))
    kept = [jax.tree.map(lambda x, i=i: x[i], result.train_state.past.params) for i in range(2)]
    assert_close(kept[0], result.policy.params, 1e-12)  # kept after update 4, in the place of the first
    halfway = league.train(KEY, env, CONFIG, callback=lambda update, metrics, state: update == 2).policy
    assert_close(kept[1], halfway.params, 1e-12)

    def lost(task, world):
        """A large reward of the second drone for what the first one does."""
        return 1e3 * world.drones.vel[0, 2] * (jnp.arange(2) == 1)

    rewards = dict(env.task.rewards) | {"lost": (1.0, lost)}
    other = dataclasses.replace(env, task=dataclasses.replace(env.task, rewards=rewards))
    assert_close(league.train(KEY, other, CONFIG).policy.params, result.policy.params, 1e-12)


def test_every_snapshot_takes_the_place_of_the_oldest_past_policy(monkeypatch):
    """With two places and a snapshot after every other update."""
    monkeypatch.setattr(
        bptt, "gradient_step", lambda env, config, x, **_: (x.replace(step=x.step + 1, policy=x.policy + 1.0), {})
    )
    state = league.TrainState(jnp.asarray(0), KEY, jnp.zeros(1), None, None, past=jnp.zeros((2, 1)))
    kept = []
    for _ in range(7):
        state = league.update(None, CONFIG, state)[0]
        kept.append(state.past[:, 0].tolist())
    assert kept == [[0, 0]] + [[0, 2]] * 2 + [[4, 2]] * 2 + [[4, 6]] * 2


def test_worlds_that_past_policies_cannot_share_and_policies_with_a_memory_are_mistakes(monkeypatch):
    with pytest.raises(ValueError, match="worlds is 5; give a multiple of past_policies, 2"):
        league.Config(**SMALL | {"worlds": 5}, past_policies=2)
    with pytest.raises(ValueError, match="one policy for all drones"):
        league.Config(**SMALL, past_policies=2, per_agent=True)
    with pytest.raises(ValueError, match="without a hidden state; remove per_agent and GRU"):
        league.Config(**SMALL, past_policies=2, recurrent_size=3)
    recurrent = types.SimpleNamespace(policy=types.SimpleNamespace(is_recurrent=True))
    monkeypatch.setattr(bptt, "init", lambda *_: recurrent)
    with pytest.raises(ValueError, match="network is recurrent; give a league one without a hidden state"):
        league.init(KEY, None, CONFIG, network=None)


def test_every_device_has_worlds_for_every_past_policy(monkeypatch):
    """Three worlds of each of four past policies have no equal halves."""
    from jaxdrones.training import trainer

    two = [types.SimpleNamespace(platform="cpu")] * 2
    monkeypatch.setattr(trainer.jax, "devices", lambda: two)
    assert len(trainer._devices(league.Config(worlds=12, past_policies=4))) == 1
    assert len(trainer._devices(league.Config(worlds=16, past_policies=4))) == 2
    past = {"kernel": jnp.zeros((4, 1))}
    with pytest.raises(ValueError, match=r"each device has 6 worlds; give .* a multiple of past_policies, 4, on every"):
        league.against(past, None)(None, None, jnp.zeros((6, 2, 3)))
