"""Libraries that are too large for the tests' environment; `make test-libraries` installs them in one of their own."""

import warnings

import gymnasium
import numpy as np
import pytest

import jaxdrones.adapters.gymnasium  # noqa: F401, registers the ids

pytestmark = [pytest.mark.float32, pytest.mark.slow, pytest.mark.filterwarnings("default")]

HOVER = "jaxdrones/Hover-v0"


@pytest.mark.needs("torchrl")
def test_torchrls_checker_passes_for_gymnasiums_environment():
    from torchrl.envs.libs.gym import GymWrapper
    from torchrl.envs.utils import check_env_specs

    env = GymWrapper(gymnasium.make(HOVER))
    check_env_specs(env)
    assert env.rollout(20)["next", "reward"].shape == (20, 1)


@pytest.mark.needs("torchrl")
def test_torchrl_makes_the_environment_by_its_id():
    from torchrl.envs.libs.gym import GymEnv
    from torchrl.envs.utils import check_env_specs

    check_env_specs(GymEnv(HOVER))


@pytest.mark.needs("torchrl")
@pytest.mark.parametrize("mode", list(gymnasium.vector.AutoresetMode))
def test_torchrl_restarts_the_worlds_of_a_vector_environment(mode):
    """Each transition leads to the true next observation, and each episode begins where the environment says."""
    from torchrl.envs.libs.gym import GymWrapper
    from torchrl.envs.utils import check_env_specs

    envs = gymnasium.make_vec(HOVER, num_envs=4, duration=0.1, autoreset_mode=mode)
    if mode is gymnasium.vector.AutoresetMode.NEXT_STEP:
        with pytest.raises(RuntimeError, match="must be one of SAME_STEP or DISABLED"):
            GymWrapper(envs)
        return
    env = GymWrapper(envs)
    check_env_specs(env)
    flown = env.rollout(25, break_when_any_done=False)
    ended = flown["next", "truncated"][..., 0]
    assert ended.sum() == 8  # every 10 steps
    moved = (flown["next", "observation"][:, :-1] != flown["observation"][:, 1:]).any(-1)
    assert (moved == ended[:, :-1]).all()
    assert (flown["next", "observation"][ended].abs().amax(-1) > 0).all()


@pytest.mark.needs("torchrl")
def test_torchrl_collects_infos_of_a_vector_environment():
    from torchrl.envs.libs.gym import GymWrapper

    env = GymWrapper(gymnasium.make_vec(HOVER, num_envs=4, duration=0.1))
    flown = env.rollout(12, break_when_any_done=False)["next"]
    terms = [flown[name] for name in flown.keys() if name.startswith("reward_")]
    assert len(terms) == 5 and flown["metric_error"].shape == (4, 12)
    np.testing.assert_allclose(sum(terms), flown["reward"][..., 0], rtol=1e-4)


@pytest.mark.needs("torchrl", "pettingzoo")
def test_torchrls_checker_passes_for_pettingzoos_environment():
    from torchrl.envs.libs.pettingzoo import PettingZooWrapper
    from torchrl.envs.utils import check_env_specs

    from jaxdrones.adapters.pettingzoo import parallel_env

    env = PettingZooWrapper(parallel_env("swap-goals", drones=3), return_state=True)
    check_env_specs(env)
    assert env.rollout(10)["state"].shape == (10, env.unwrapped.state_space.shape[0])


@pytest.mark.needs("skrl")
@pytest.mark.parametrize("kind", ["torch", "jax"])
def test_skrl_wraps_the_vector_environment(kind):
    import jax.numpy as jnp
    import torch

    wrappers = pytest.importorskip(f"skrl.envs.wrappers.{kind}")
    env = wrappers.wrap_env(gymnasium.make_vec(HOVER, num_envs=4), wrapper="gymnasium")
    obs, _ = env.reset()
    action = torch.zeros(4, 4) if kind == "torch" else jnp.zeros((4, 4))
    after, reward, terminated, truncated, _ = env.step(action)
    assert obs.shape == after.shape == (4, *env.observation_space.shape)
    assert reward.shape == terminated.shape == truncated.shape == (4, 1)


@pytest.mark.needs("skrl", "pettingzoo")
def test_skrl_wraps_a_team():
    import torch
    from skrl.envs.wrappers.torch import wrap_env

    from jaxdrones.adapters.pettingzoo import parallel_env

    team = parallel_env("swap-goals", drones=2)
    env = wrap_env(team, wrapper="pettingzoo")
    obs, _ = env.reset()
    env.step({agent: torch.zeros(1, 4) for agent in env.possible_agents})
    assert set(obs) == set(env.state()) == {"drone_0", "drone_1"}
    assert env.state()["drone_1"].shape[-1] == team.state_space.shape[0]  # what its centralized critics take


@pytest.fixture(scope="module")
def tianshou_policy():
    torch = pytest.importorskip("torch")
    pytest.importorskip("tianshou")
    from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
    from tianshou.utils.net.common import Net
    from tianshou.utils.net.continuous import ContinuousActorProbabilistic

    space = gymnasium.make(HOVER)
    net = Net(state_shape=space.observation_space.shape, hidden_sizes=[8])
    return ProbabilisticActorPolicy(
        actor=ContinuousActorProbabilistic(preprocess_net=net, action_shape=(4,)),
        dist_fn=lambda x: torch.distributions.Independent(torch.distributions.Normal(*x), 1),
        action_space=space.action_space,
    )


@pytest.mark.needs("tianshou")
@pytest.mark.parametrize("batched", [False, True])
def test_tianshou_collects(batched, tianshou_policy):
    """So many steps, and then so many episodes, which some worlds begin fewer of than others."""
    from tianshou.data import Collector, VectorReplayBuffer
    from tianshou.env import DummyVectorEnv

    from jaxdrones.adapters.tianshou import VectorEnv

    if batched:
        envs = VectorEnv("hover", 2, seed=0, duration=0.1)
    else:
        envs = DummyVectorEnv([lambda: gymnasium.make(HOVER, duration=0.1) for _ in range(2)])
    collector = Collector(tianshou_policy, envs, VectorReplayBuffer(200, 2))
    collector.reset()
    collected = collector.collect(n_step=40)
    assert collected.n_collected_steps == 40 and collected.n_collected_episodes == 4
    assert np.isfinite(collected.returns).all() and (collected.lens == 10).all()
    collected = collector.collect(n_episode=5)
    assert collected.n_collected_steps == 50 and collected.n_collected_episodes == 5
    batch = collector.buffer[np.flatnonzero(collector.buffer.truncated)]
    assert len(batch) == 9 and not np.isclose(batch.obs, batch.obs_next).all(-1).any()


@pytest.mark.needs("tianshou")
def test_tianshous_worlds_fly_as_gymnasiums_and_stand_still_where_not_stepped():
    from jaxdrones.adapters.tianshou import VectorEnv

    envs, alone = VectorEnv("hover", 3, duration=0.05), gymnasium.make(HOVER, duration=0.05)
    with pytest.raises(ValueError, match="before the first reset of all"):
        envs.reset([1])
    start, _ = envs.reset(seed=[3, 4, 5])
    again, _ = envs.reset(seed=3)
    np.testing.assert_array_equal(start, again)
    action = np.full((1, 4), 0.1, np.float32)
    envs.seed([int(s) for s in (9, 9, 9)])
    begun, infos = envs.reset([2, 0])
    np.testing.assert_array_equal(begun[0], begun[1])
    assert [info["env_id"] for info in infos] == [2, 0]
    alone.reset(seed=int(np.random.default_rng(9).integers(2**32)))
    for k in range(5):
        obs, reward, terminated, truncated, infos = envs.step(action, [2])
        expected, expected_reward, *_ = alone.step(action[0])
        np.testing.assert_allclose(obs[0], expected, rtol=1e-4, atol=1e-5)  # two programs round differently
        np.testing.assert_allclose(reward, expected_reward, rtol=1e-4)
        assert not terminated.any() and truncated.tolist() == [k == 4] and infos[0]["env_id"] == 2
    renewed, _ = envs.reset([2])
    one_step = envs.step(np.repeat(action, 3, 0))[0]
    expected = gymnasium.make(HOVER, duration=0.05)
    first, _ = expected.reset(seed=int(np.random.default_rng(9).integers(2**32)))
    np.testing.assert_array_equal(first, begun[1])
    np.testing.assert_allclose(one_step[0], expected.step(action[0])[0], rtol=1e-4, atol=1e-5)  # it stood still
    assert not np.allclose(renewed[0], begun[0])
    with pytest.raises(ValueError, match=r"action has shape \(1, 4\); expected \(3, 4\)"):
        envs.step(action)
    with pytest.raises(ValueError, match="give it as an option"):
        envs.set_env_attr("height", 2.0)
    assert len(envs) == len(envs.action_space) == 3


@pytest.mark.needs("stable_baselines3")
@pytest.mark.parametrize("options", [{}, {"vision": ("rgb",)}])
def test_stable_baselines3s_checker_passes(options):
    from stable_baselines3.common.env_checker import check_env

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(HOVER, **options).unwrapped)


@pytest.mark.needs("stable_baselines3")
def test_stable_baselines3s_wrappers_run(tmp_path):
    from stable_baselines3.common.vec_env import VecCheckNan, VecFrameStack, VecMonitor, VecNormalize

    from jaxdrones.adapters.sb3 import VecEnv

    envs = VecNormalize(VecFrameStack(VecCheckNan(VecMonitor(VecEnv("hover", 3, duration=0.05)), True), 2))
    assert envs.reset().shape == (3, 2 * 22)
    for _ in range(6):
        obs, reward, _, infos = envs.step(np.zeros((3, 4), np.float32))
        assert np.isfinite(obs).all() and np.isfinite(reward).all()
    assert envs.observation_space.shape == (2 * 22,) and len(infos) == 3
