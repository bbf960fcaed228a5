import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_same_kind, mostly_slow

from jaxdrones.adapters import jaxmarl
from jaxdrones.envs import TASKS, AutoReset

pytestmark = pytest.mark.float32
KEY = jax.random.PRNGKey(0)


def sampled(env, key):
    return {agent: env.action_space(agent).sample(key) for agent in env.agents}


@pytest.mark.parametrize("task", mostly_slow(TASKS, ("swap-goals",)))
def test_a_step_returns_what_it_was_given_as_loops_scan_over_it(task, env_of):
    env = jaxmarl.wrap(env_of(task), world_state=True)
    n = env.num_agents
    obs, state = jax.eval_shape(env.reset, KEY)
    actions = jax.eval_shape(lambda key: sampled(env, key), KEY)
    next_obs, next_state, rewards, dones, infos = jax.eval_shape(env.step, KEY, state, actions)
    assert_same_kind((obs, state), (next_obs, next_state))
    assert set(rewards) == set(env.agents) and set(dones) == {*env.agents, "__all__"}
    assert all(x.shape == (n,) for x in jax.tree.leaves(infos))  # loops reshape them to one entry per agent
    assert obs["world_state"].shape == (n, env.world_state_size())
    for agent in env.agents:
        space = env.observation_space(agent)
        shapes = {k: s.shape for k, s in space.spaces.items()} if isinstance(obs[agent], dict) else space.shape
        assert jax.tree.map(jnp.shape, obs[agent]) == shapes


@pytest.mark.slow
def test_it_is_the_environment_with_autoreset(env_of):
    plain = env_of("hover", drones=2, duration=0.02)
    env, episodes = jaxmarl.wrap(plain), AutoReset(plain)
    obs, state = env.reset(KEY)
    _, episode = episodes.reset(KEY)
    for k in range(3):
        key = jax.random.fold_in(KEY, k)
        actions = sampled(env, key)
        obs, state, rewards, dones, infos = env.step(key, state, actions)
        expected, episode, reward, *_ = jax.jit(episodes.step)(key, episode, jnp.stack(list(actions.values())))
        np.testing.assert_allclose(jnp.stack(list(obs.values())), expected, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(jnp.stack(list(rewards.values())), reward, rtol=1e-5)
        assert {bool(x) for x in dones.values()} == {k == 1}
        assert infos["truncated"].tolist() == [k == 1] * 2 and not infos["terminated"].any()


def test_the_world_state_of_an_agent_starts_with_its_own_observation(env_of):
    """Those of the others follow in their order."""
    env = jaxmarl.wrap(env_of("hover", drones=3), world_state=True)
    obs = env._by_agent(jnp.array([[1.0, 2], [3, 4], [5, 6]]))
    assert obs["world_state"].tolist() == [[1, 2, 3, 4, 5, 6], [3, 4, 5, 6, 1, 2], [5, 6, 1, 2, 3, 4]]
    assert obs["drone_1"].tolist() == [3, 4]


def test_an_agent_is_done_from_its_own_end_on(env_of):
    """Though the episode of the team goes on."""
    env, no = env_of("leader-follower"), jnp.zeros(2, bool)
    info = dict(rewards={}, metrics={}, terminated=no, truncated=no, active=jnp.array([True, False]))
    dones = jaxmarl.wrap(env)._outcome(jnp.zeros((2, env.observation_size)), None, jnp.zeros(2), no[0], no[0], info)[3]
    assert jax.tree.map(bool, dones) == {"drone_0": False, "drone_1": True, "__all__": False}
    info |= dict(terminated=jnp.array([True, False]), active=jnp.ones(2, bool))
    dones = jaxmarl.wrap(env)._outcome(jnp.zeros((2, env.observation_size)), None, jnp.zeros(2), no[0], no[0], info)[3]
    assert jax.tree.map(bool, dones) == {"drone_0": True, "drone_1": False, "__all__": False}
    dones = jaxmarl.wrap(env)._outcome(jnp.zeros((2, env.observation_size)), None, jnp.zeros(2), no[0], ~no[0], info)[3]
    assert dones["__all__"]  # at the time limit


def test_a_given_state_follows_when_the_episode_of_the_team_has_ended(env_of):
    env, old, begun = jaxmarl.wrap(env_of("leader-follower")), jnp.zeros(2), jnp.ones(2)
    env.get_obs = lambda state: state
    for over in False, True:
        dones = {"drone_0": not over, "drone_1": True, "__all__": jnp.array(over)}
        env.step_env = lambda key, state, actions, dones=dones: (state, state, {}, dones, {})
        obs, state, *_ = jaxmarl.JaxMARLEnv.step.__wrapped__(env, KEY, old, {}, begun)
        assert (obs == over).all() and (state == over).all()


@pytest.mark.slow
def test_the_next_episode_may_start_at_a_given_state(env_of):
    env = jaxmarl.wrap(env_of("hover", drones=2, duration=0.02))
    begun, start = env.reset(jax.random.PRNGKey(1))
    _, state = env.reset(KEY)
    for k in range(2):
        obs, state, _, dones, _ = env.step(KEY, state, sampled(env, KEY), start)
        same = all(np.allclose(obs[agent], begun[agent]) for agent in env.agents)
        assert same == dones["__all__"] == (k == 1)
    assert state.length == 0
    obs, state, *_ = env.step_env(KEY, state, sampled(env, KEY))
    assert state.length == 1
    for agent in env.agents:
        np.testing.assert_allclose(env.get_obs(state)[agent], obs[agent], rtol=1e-6)


@pytest.mark.slow
def test_a_discrete_action_is_a_row_of_the_table(env_of):
    plain, table = env_of("hover", drones=2, duration=0.02), np.linspace(-1, 1, 12).reshape(3, 4)
    env = jaxmarl.wrap(plain, discrete_actions=table)
    assert env.action_space("drone_0").n == 3 and env.get_avail_actions(None)["drone_0"].shape == (3,)
    _, state = env.reset(KEY)
    chosen = env.step(KEY, state, {"drone_0": jnp.asarray(0), "drone_1": jnp.asarray([2])})[0]  # loops give either
    rows = {agent: jnp.asarray(table[i], jnp.float32) for agent, i in (("drone_0", 0), ("drone_1", 2))}
    given = jaxmarl.wrap(plain).step(KEY, state, rows)[0]
    jax.tree.map(np.testing.assert_array_equal, chosen, given)


def test_an_agent_without_an_action_is_named(env_of):
    env = jaxmarl.wrap(env_of("hover", drones=2, duration=0.02))
    _, state = env.reset(KEY)
    with pytest.raises(
        ValueError, match="actions are for drone_0; give a dict with an action for each of drone_0, drone_1"
    ):
        env.step(KEY, state, {"drone_0": jnp.zeros(4)})


@pytest.mark.needs("jaxmarl")
@pytest.mark.slow
def test_jaxmarls_own_wrapper_runs(env_of):
    from jaxmarl.environments import spaces
    from jaxmarl.wrappers.baselines import LogWrapper, get_space_dim

    env = LogWrapper(jaxmarl.wrap(env_of("swap-goals"), spaces=spaces))
    assert get_space_dim(env.action_space("drone_0")) == 4
    _, state = env.reset(KEY)
    *_, info = env.step(KEY, state, sampled(env, KEY))
    assert info["returned_episode_returns"].shape == (env.num_agents,)


@pytest.mark.needs("jaxmarl")
@pytest.mark.slow
def test_it_has_what_jaxmarls_base_class_promises(env_of):
    from jaxmarl.environments.multi_agent_env import MultiAgentEnv

    given, ours = MultiAgentEnv(1), jaxmarl.wrap(env_of("swap-goals"))
    assert {name for name in dir(given) if not name.startswith("_")} <= set(dir(ours))
