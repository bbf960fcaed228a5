"""Interfaces of teams in which the episode of one drone ends before that of the others."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones import envs
from jaxdrones.adapters import jaxmarl

pytestmark = pytest.mark.float32
STEPS = 4


@pytest.fixture
def env():
    """Three drones; the episode of the second one ends in the second of four steps."""
    task = envs.make("hover", drones=3, duration=STEPS / 100).task
    over = {"over": lambda task, world: (world.step >= 2) & (jnp.arange(3) == 1)}
    return envs.make(dataclasses.replace(task, terminations=over, ends="drone"))


@pytest.mark.slow
def test_an_agent_of_pettingzoo_leaves(env):
    from pettingzoo.test import parallel_api_test

    from jaxdrones.adapters.pettingzoo import parallel_env

    agents = parallel_env(env)
    parallel_api_test(agents, num_cycles=10)
    agents.reset(seed=0)
    everyone = list(agents.possible_agents)
    for k in range(STEPS):
        flying = everyone if k < 2 else ["drone_0", "drone_2"]
        assert agents.agents == flying
        answer = agents.step({agent: np.zeros(4) for agent in flying})
        assert all(list(part) == flying for part in answer)
        _, _, terminated, truncated, infos = answer
        assert terminated == {agent: k == 1 and agent == "drone_1" for agent in flying}
        assert truncated == dict.fromkeys(flying, k == STEPS - 1)
        assert all(infos[agent]["termination_over"] == terminated[agent] for agent in flying)
    assert agents.agents == []


def test_an_agent_of_rllib_leaves(env):
    pytest.importorskip("ray.rllib")
    from jaxdrones.adapters.rllib import MultiAgentEnv

    agents = MultiAgentEnv(env)
    agents.reset(seed=0)
    for k in range(STEPS):
        flying = ["drone_0", "drone_1", "drone_2"] if k < 2 else ["drone_0", "drone_2"]
        obs, reward, terminated, truncated, _ = agents.step({agent: np.zeros(4) for agent in flying})
        assert list(obs) == list(reward) == flying
        assert terminated == {agent: k == 1 and agent == "drone_1" for agent in (*flying, "__all__")}
        assert truncated == dict.fromkeys((*flying, "__all__"), k == STEPS - 1)


@pytest.mark.slow
def test_an_agent_of_jaxmarl_is_done_until_the_next_episode(env):
    agents = jaxmarl.wrap(env)
    key = jax.random.key(0)
    _, state = agents.reset(key)
    for k in range(STEPS):
        actions = {agent: jnp.zeros(4) for agent in agents.agents}
        _, state, rewards, dones, _ = agents.step(key, state, actions)
        last = k == STEPS - 1
        assert jax.tree.map(bool, dones) == {"drone_0": last, "drone_1": k >= 1, "drone_2": last, "__all__": last}
        assert (rewards["drone_1"] == 0) == (k > 1) and rewards["drone_0"] != 0
    assert np.all(state.world.active)
