from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import mostly_slow

pytest.importorskip("pettingzoo")
from pettingzoo.test import parallel_api_test, parallel_seed_test

from jaxdrones.adapters.pettingzoo import parallel_env
from jaxdrones.adapters.session import TeamEpisodes, _advance, begin
from jaxdrones.envs import TASKS

pytestmark = pytest.mark.float32


@pytest.mark.parametrize("task", mostly_slow(TASKS, ("hover",)))
def test_pettingzoos_own_tests_pass(task, env_of):
    parallel_api_test(parallel_env(env_of(task)), num_cycles=20)
    parallel_seed_test(lambda: parallel_env(env_of(task)), num_cycles=5)


@pytest.mark.slow
def test_agents_are_drones_and_all_end_at_once(env_of):
    env = parallel_env(env_of("hover", drones=2, duration=0.05))
    assert env.possible_agents == ["drone_0", "drone_1"] and env.agents == []
    assert env.observation_spaces["drone_0"] is env.observation_space("drone_0")
    env.reset(seed=0)
    for k in range(5):
        obs, reward, terminated, truncated, infos = env.step({agent: np.zeros(4) for agent in env.agents})
        assert set(obs) == set(reward) == set(terminated) == set(infos) == set(env.possible_agents)
        assert truncated == dict.fromkeys(env.possible_agents, k == 4)
    assert env.agents == []
    for agent in env.possible_agents:
        assert reward[agent] == pytest.approx(
            sum(x for name, x in infos[agent].items() if name.startswith("reward_")), rel=1e-5
        )
    with pytest.raises(ValueError, match="after the end of an episode"):
        env.step({})


def test_the_state_is_what_all_agents_see(env_of):
    env = parallel_env(env_of("hover", drones=2, duration=0.05))
    with pytest.raises(ValueError, match="before reset"):
        env.state()
    obs, _ = env.reset(seed=0)
    np.testing.assert_array_equal(env.state(), np.concatenate([obs["drone_0"], obs["drone_1"]]))
    assert env.state() in env.state_space
    env.state()[:] = 0  # a copy
    np.testing.assert_array_equal(env.state()[-22:], obs["drone_1"])
    bounds = [env.observation_space(agent).high for agent in env.agents]
    np.testing.assert_array_equal(env.state_space.high, np.concatenate(bounds))
    starts = [env.reset(seed) and env.reset()[0]["drone_0"] for seed in (3, 3, 4)]  # of the episode after it
    assert np.array_equal(starts[0], starts[1]) and not np.array_equal(starts[0], starts[2])


def test_mistakes_are_named(env_of):
    env = parallel_env(env_of("hover", drones=2, duration=0.05))
    env.reset(seed=0)
    with pytest.raises(
        ValueError, match="actions are for drone_0; give a dict with an action for each of drone_0, drone_1"
    ):
        env.step({"drone_0": np.zeros(4)})
    with pytest.raises(ValueError, match="give a dict with an action for each of drone_0, drone_1"):
        env.step([np.zeros(4), np.zeros(4)])
    with pytest.raises(ValueError, match=r"action of drone_1 has shape \(3,\); expected \(4,\): 4 numbers"):
        env.step({"drone_0": np.zeros(4), "drone_1": np.zeros(3)})
    with pytest.raises(ValueError, match="action of drone_1 is not finite"):
        env.step({"drone_0": np.zeros(4), "drone_1": np.full(4, np.nan)})
    with pytest.raises(ValueError, match="action of drone_1 is not finite"):
        env.step({"drone_0": np.zeros(4), "drone_1": jnp.full(4, jnp.nan)})
    for wrong in -1, 1.5:
        with pytest.raises(ValueError, match=f"^seed is {wrong}; give a whole number of at least 0$"):
            env.reset(seed=wrong)
    with pytest.raises(TypeError, match="unexpected keyword argument 'color'"):
        parallel_env("leader-follower", color="red")


def test_an_agent_leaves_when_it_is_terminated_or_cut():
    """While the third one flies on; of an environment that does nothing else."""
    names, no = ["drone_0", "drone_1", "drone_2"], np.zeros(3, bool)
    ended = dict(terminated=np.array([False, True, False]), truncated=np.array([True, False, False]))
    answers = iter([ended, dict(terminated=no, truncated=no)])
    agents = TeamEpisodes()
    agents.possible_agents, agents.agents = names, list(names)
    agents._session = SimpleNamespace(running=True, step=lambda _: (None, np.zeros(3), False, False, next(answers)))
    agents._layout = SimpleNamespace(
        gather_present=lambda actions, present: None, arrange=lambda obs: dict.fromkeys(names, 0)
    )
    for flying, flags in (names, ended), (["drone_2"], dict(terminated=no[2:], truncated=no[2:])):
        assert agents.agents == flying
        results = agents._step({})[0]
        assert all(list(part) == flying for part in results)
        for found, flag in zip(results[2:], flags.values(), strict=True):
            assert list(found.values()) == flag.tolist()


def test_infos_are_those_of_each_drone(env_of):
    env, both = parallel_env(env_of("hover", drones=2, duration=0.05)), {"drone_0": 0, "drone_1": 0}
    info = {"rewards": {"a": np.array([1.0, 2.0])}, "metrics": {}, "terminations": {}, "truncations": {}}
    env._step = lambda actions: ((both, {}, {}, {}), None, info)
    assert env.step({})[4] == {"drone_0": {"reward_a": 1.0}, "drone_1": {"reward_a": 2.0}}


def test_every_step_of_an_episode_has_a_key_of_its_own():
    env = SimpleNamespace(step=lambda key, world, action: (jax.random.key_data(key).tolist(), world))
    first, second = (_advance(env, jax.random.key(0), SimpleNamespace(step=k), None)[1][0] for k in range(2))
    assert first != second
    key, start, _ = begin(SimpleNamespace(reset=lambda key: (None, key)), 0)  # which is not that of the start
    assert key.tolist() != start.tolist()
