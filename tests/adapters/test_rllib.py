"""RLlib's interface of a team, and RLlib on worlds of Gymnasium; these tests need ray."""

import numpy as np
import pytest

pytest.importorskip("ray.rllib")
from jaxdrones.adapters.rllib import MultiAgentEnv

pytestmark = pytest.mark.float32


def test_agents_are_drones_and_all_end_at_once():
    env = MultiAgentEnv("hover", drones=2, duration=0.25)
    obs, _ = env.reset(seed=0)
    assert list(obs) == env.possible_agents == ["drone_0", "drone_1"]
    steps, truncated = 0, {"__all__": False}
    while not truncated["__all__"]:
        actions = {agent: space.sample() for agent, space in env.action_spaces.items()}
        obs, reward, terminated, truncated, _ = env.step(actions)
        steps += 1
        assert all(env.observation_spaces[agent].contains(x) for agent, x in obs.items())
        assert set(reward) == set(env.possible_agents) and not terminated["__all__"]
    assert steps == round(0.25 / env.env.dt) and all(truncated.values())
    with pytest.raises(ValueError, match="call reset"):
        env.step(actions)


def test_a_seed_starts_the_same_episode():
    env = MultiAgentEnv("leader-follower")
    first, again = (env.reset(seed=3)[0] for _ in range(2))
    for agent in env.agents:
        np.testing.assert_array_equal(first[agent], again[agent])


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_rllib_trains_with_many_worlds_of_one_id():
    from ray.rllib.algorithms.ppo import PPOConfig

    import jaxdrones.adapters.gymnasium

    config = (
        PPOConfig()
        .environment("jaxdrones/Hover-v0", env_config={"autoreset_mode": "NextStep", "duration": 0.2})
        .env_runners(
            num_env_runners=0,
            num_envs_per_env_runner=8,
            rollout_fragment_length=32,
            gym_env_vectorize_mode="vector_entry_point",
        )
        .learners(num_learners=0)
        .training(train_batch_size=256, minibatch_size=128, num_epochs=1)
    )
    algorithm = config.build_algo()
    assert isinstance(algorithm.env_runner.env.unwrapped, jaxdrones.adapters.gymnasium.VectorEnv)
    episodes = algorithm.env_runner.sample()
    assert [len(episode) for episode in episodes if episode.is_done] == [20] * 8
    assert all(episode.is_truncated and not episode.is_terminated for episode in episodes if episode.is_done)
    result = algorithm.train()
    assert result["env_runners"]["num_env_steps_sampled"] == 512  # with those of `sample`
    algorithm.stop()
