"""RLlib's modules, runner and learner with a centralized critic; these tests need ray."""

import dataclasses

import jax
import numpy as np
import pytest

pytest.importorskip("ray.rllib")
import torch
from ray.rllib.core.columns import Columns

import jaxdrones as jd
from jaxdrones.learning.normalize import RunningStatistics
from jaxdrones.training.recipe import Recipe
from jaxdrones.training.rllib import algorithm, module
from jaxdrones.training.rllib.config import Config
from jaxdrones.training.rllib.trainer import RLlibTrainer
from jaxdrones.training.run import RLLIB_CHECKPOINT, Run

pytestmark = [pytest.mark.float32, pytest.mark.filterwarnings("default")]

SMALL = Config(updates=4, worlds=2, horizon=150, hidden_sizes=(8, 8), obs_stats_freeze=0.0, restart_fraction=0.0)
OWN, CENTRALIZED = 12, 25  # numbers that the paper's policies and critics take


@pytest.fixture(scope="module")
def env():
    with jax.enable_x64(False):
        return jd.make("leader-follower")  # an episode has 242 steps


@pytest.fixture(scope="module")
def team(env):
    """RLlib's algorithm, and the module of each drone."""
    algorithm.start_ray()
    with jax.enable_x64(False):
        made = algorithm.build(env, SMALL, seed=3)
    yield made
    made.stop()


@pytest.fixture
def modules(team):
    learner = team.learner_group._learner
    return [learner.module[name].unwrapped() for name in ("drone_0", "drone_1")]


def test_a_policy_reads_its_drones_observation_and_the_critic_reads_everything(modules):
    for one in modules:
        assert one.policy[0].in_features == OWN and one.critic[0].in_features == CENTRALIZED
        obs = torch.randn(5, CENTRALIZED, requires_grad=True)
        one.forward_train({Columns.OBS: obs})[Columns.ACTION_DIST_INPUTS].sum().backward()
        assert (obs.grad[:, :OWN] != 0).all() and (obs.grad[:, OWN:] == 0).all()
        obs.grad = None
        one.compute_values({Columns.OBS: obs}).sum().backward()
        assert (obs.grad != 0).all()


def test_the_policy_of_jax_is_the_mean_of_rllibs_modules(modules):
    stats = RunningStatistics.empty(OWN)
    obs = np.random.default_rng(0).normal(size=(7, 2, CENTRALIZED)).astype(np.float32)
    action = module.policy_of(modules, stats)(obs[..., :OWN])
    for i, one in enumerate(modules):
        with torch.no_grad():
            mean = one.forward_inference({Columns.OBS: torch.tensor(obs[:, i])})[Columns.ACTION_DIST_INPUTS][:, :1]
        np.testing.assert_allclose(action[:, i], mean, atol=1e-6)
    assert np.std(action) > 1e-3


def test_trajectories_become_episodes_that_continue_and_end(team, modules, env):
    runner = team.env_runner
    first, second = runner.sample(), runner.sample()
    assert [len(episode) for episode in first] == [150] * 2
    assert [len(episode) for episode in second] == [92, 58] * 2
    assert not any(episode.is_done for episode in first)
    assert [episode.is_truncated for episode in second] == [True, False] * 2
    distribution = modules[0].get_exploration_action_dist_cls()
    for i, (before, after) in enumerate(zip(first, second[::2], strict=True)):
        leader, follower = (after.agent_episodes[name] for name in ("drone_0", "drone_1"))
        for name, one in after.agent_episodes.items():
            last = before.agent_episodes[name].get_observations()[-1]
            np.testing.assert_allclose(last[: 2 * OWN], one.get_observations()[0][: 2 * OWN], atol=1e-6)
            inputs = torch.tensor(one.get_extra_model_outputs(Columns.ACTION_DIST_INPUTS))
            chosen = distribution.from_logits(inputs).logp(torch.tensor(one.get_actions()))
            np.testing.assert_allclose(one.get_extra_model_outputs(Columns.ACTION_LOGP), chosen, atol=1e-4)
        seen, other = leader.get_observations(), follower.get_observations()
        np.testing.assert_array_equal(seen[:, OWN : 2 * OWN], other[:, :OWN])
        np.testing.assert_array_equal(other[:, OWN : 2 * OWN], seen[:, :OWN])
        np.testing.assert_array_equal(seen[:-1, 2 * OWN :], follower.get_actions())
        restarted = second[2 * i + 1].agent_episodes["drone_0"].get_observations()[0]
        assert np.abs(restarted - seen[-1])[:OWN].max() > 1e-3  # the last observation is not that of the next episode


def test_observations_and_rewards_are_those_of_the_environment(team, env):
    """The actions after a start, in the environment alone; starts and physics of this task are not random."""
    first_obs, world = env.reset(jax.random.key(0))

    def observed(episode):
        agents = list(episode.agent_episodes.values())
        return agents, np.stack([one.get_observations()[:, :OWN] for one in agents], axis=1)

    parts = [observed(episode) for _ in range(3) for episode in team.env_runner.sample()]
    agents, obs = next(part for part in parts if len(part[1]) > 20 and np.allclose(part[1][0], first_obs, atol=1e-6))
    for k, action in enumerate(np.stack([one.get_actions() for one in agents], axis=1)):
        seen, world, reward, *_ = env.step(jax.random.key(1), world, action)
        np.testing.assert_allclose(obs[k + 1], seen, atol=1e-5)
        np.testing.assert_allclose([one.get_rewards()[k] for one in agents], reward, atol=1e-5)


def test_exploration_stays_within_bounds_that_are_annealed(env):
    small = dataclasses.replace(SMALL, horizon=8)
    made = algorithm.build(env, small, seed=0)
    for update in range(1, SMALL.updates + 1):
        made.train()
        low, high = SMALL.std_bounds(update)
        for name in ("drone_0", "drone_1"):
            std = made.learner_group._learner.module[name].unwrapped().log_std.exp().detach().numpy()
            assert (std >= low - 1e-6).all() and (std <= high + 1e-6).all()
    assert SMALL.std_bounds(0) == (0.2, 0.5) and SMALL.std_bounds(4) == (pytest.approx(0.05),) * 2
    made.stop()


def test_a_gradient_that_is_not_finite_is_counted_and_replaced_by_zero(env):
    recipe = Recipe.of("leader-follower", "ppo", library="rllib", worlds=4, horizon=8, hidden_sizes=(8,), minibatches=2)
    trainer = RLlibTrainer(recipe, episodes=2)
    state = trainer.start(jax.random.key(0))
    _, metrics = trainer.advance(state, 1)
    assert metrics["nonfinite_gradients"] == [0]
    with torch.no_grad():
        for module in trainer._modules()[:1]:
            module.critic[-1].bias.fill_(1e30)  # the square of its error overflows
    _, metrics = trainer.advance(state, 1)
    assert metrics["nonfinite_gradients"][0] > recipe.config.epochs
    assert all(torch.isfinite(x).all() for module in trainer._modules() for x in module.parameters())


def test_a_seed_repeats_a_training_and_another_does_not():
    recipe = Recipe.of("leader-follower", "ppo", library="rllib", worlds=4, horizon=8, hidden_sizes=(8,), updates=2)
    trainer = RLlibTrainer(recipe, episodes=2)
    trainer.compile()
    policies = []
    for seed in (1, 1, 2):
        state = trainer.start(jax.random.key(seed))
        state, metrics = trainer.advance(state, 2)
        assert set(metrics) == set(trainer.metrics) and all(np.isfinite(x).all() for x in metrics.values())
        policies.append(np.concatenate([np.ravel(x) for x in jax.tree.leaves(state.policy)]))
    np.testing.assert_array_equal(policies[0], policies[1])
    assert np.abs(policies[0] - policies[2]).max() > 1e-2


def test_rllib_loads_the_checkpoint_of_a_run(tmp_path):
    from ray.rllib.algorithms.algorithm import Algorithm

    recipe = Recipe.of("leader-follower", "ppo", library="rllib", worlds=4, horizon=8, hidden_sizes=(8,), updates=2)
    trainer, run = RLlibTrainer(recipe, episodes=2), Run(tmp_path)
    trainer.compile()
    state, _ = trainer.advance(trainer.start(jax.random.key(0)), 1)
    trainer.save(run, state)
    loaded = Algorithm.from_checkpoint(str(tmp_path / RLLIB_CHECKPOINT))
    learner = loaded.learner_group._learner
    modules = [learner.module[name].unwrapped() for name in ("drone_0", "drone_1")]
    policy = module.policy_of(modules, loaded.env_runner.obs_stats)
    for x, y in zip(jax.tree.leaves(policy), jax.tree.leaves(state.policy), strict=True):
        np.testing.assert_array_equal(x, y)
    loaded.train()
    loaded.stop()


def test_cameras_are_refused():
    recipe = Recipe.of("forest", "ppo", library="rllib")
    with pytest.raises(ValueError, match="forest has images, which --library rllib does not take"):
        RLlibTrainer(recipe)
