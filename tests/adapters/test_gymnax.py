import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_same_kind, mostly_slow

from jaxdrones.adapters import gymnax, jax_spaces, jaxmarl
from jaxdrones.envs import TASKS, AutoReset, make

pytestmark = pytest.mark.float32
KEY = jax.random.PRNGKey(0)


@pytest.mark.parametrize("task", mostly_slow(TASKS, ("hover",)))
def test_a_step_returns_what_it_was_given_as_loops_scan_over_it(task, env_of):
    env = gymnax.wrap(env_of(task))
    obs, state = jax.eval_shape(env.reset, KEY)
    action = jax.eval_shape(env.action_space().sample, KEY)
    next_obs, next_state, reward, done, info = jax.eval_shape(env.step, KEY, state, action)
    assert_same_kind((obs, state), (next_obs, next_state))
    assert reward.shape == done.shape == info["discount"].shape == () and done.dtype == bool
    space = env.observation_space()
    shapes = {k: s.shape for k, s in space.spaces.items()} if isinstance(obs, dict) else space.shape
    assert jax.tree.map(jnp.shape, obs) == shapes
    assert action.shape == (env.num_actions,) == env.action_space(env.default_params).shape


def test_observations_have_the_type_of_their_space_in_double_precision_too():
    with jax.enable_x64(True):
        plain = make("hover", drones=2, duration=0.02)
        teams = jaxmarl.wrap(plain, world_state=True)
        obs, _ = jax.eval_shape(gymnax.wrap(plain).reset, KEY)
        of_agents, _ = jax.eval_shape(teams.reset, KEY)
    assert plain.params.mass.dtype == jnp.float64
    assert obs.dtype == gymnax.wrap(plain).observation_space().dtype == jnp.float32
    assert {x.dtype for x in of_agents.values()} == {teams.observation_space("drone_0").dtype} == {jnp.dtype("float32")}


@pytest.mark.slow
def test_it_is_the_environment_with_autoreset(env_of):
    plain = env_of("hover", drones=2, duration=0.02)
    env, episodes = gymnax.wrap(plain), AutoReset(plain)
    obs, state = env.reset(KEY)
    expected, episode = episodes.reset(KEY)
    np.testing.assert_array_equal(obs, expected.ravel())
    discounts = []
    for k in range(3):
        key = jax.random.fold_in(KEY, k)
        action = env.action_space().sample(key)
        before = state
        obs, state, reward, done, info = env.step(key, state, action)
        expected, episode, rewards, *_ = jax.jit(episodes.step)(key, episode, action.reshape(2, 4))
        np.testing.assert_allclose(obs, expected.ravel(), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(reward, rewards.sum(), rtol=1e-5)
        halved = gymnax.wrap(plain, team_reward="mean").step_env(key, before, action)[2]
        np.testing.assert_allclose(halved, rewards.mean(), rtol=1e-5)
        assert done == (k == 1)
        discounts.append(float(info["discount"]))
    assert discounts == [1, 1, 1]  # truncated, not terminated


@pytest.mark.slow
def test_truncation_may_be_separate_as_in_gymnax_1(env_of):
    env = gymnax.wrap(env_of("hover", drones=2, duration=0.02), separate_truncation=True)
    _, state = env.reset(KEY)
    for _ in range(2):
        obs, state, _, terminated, truncated, info = env.step(KEY, state, jnp.zeros(8))
    assert truncated and not terminated and info["truncated"]
    assert not np.allclose(obs, info["final_observation"])


@pytest.mark.slow
@pytest.mark.parametrize("separate_truncation", mostly_slow([False, True], [False]))
def test_a_step_without_reset_stays_in_the_episode(separate_truncation, env_of):
    env = gymnax.wrap(env_of("hover", drones=2, duration=0.02), separate_truncation=separate_truncation)
    _, state = jax.jit(env.reset_env)(KEY)
    for _ in range(2):
        *_, flag, info = env.step(KEY, state, jnp.zeros(8))
        obs, state, _, ended, last = env.step_env(KEY, state, jnp.zeros(8))
    assert state.length == 2
    if separate_truncation:
        assert last["truncated"] and not ended and flag
        np.testing.assert_allclose(obs, info["final_observation"], rtol=1e-6)
    else:
        assert ended and flag and last["discount"] == 1


@pytest.mark.slow
def test_params_are_those_of_another_environment():
    """A heavier vehicle in `params` flies as one that the environment is made with."""
    light, env = make("hover"), gymnax.wrap(make("hover"))
    heavy = light.params.replace(mass=1.3 * light.params.mass)
    params = jax.tree.map(
        lambda *x: jnp.stack([jnp.asarray(y) for y in x]),
        env.default_params,
        gymnax.EnvParams(3, heavy),
    )
    obs, state = jax.vmap(env.reset, (None, 0))(KEY, params)
    alone = gymnax.wrap(make("hover", vehicle=jax.tree.map(lambda x: x[0], heavy)))
    expected, single = alone.reset(KEY)
    np.testing.assert_array_equal(obs[0], obs[1])
    step = jax.vmap(env.step, (None, 0, None, 0))
    action, done = jnp.full(4, 0.1), []
    for _ in range(3):
        obs, state, _, ended, _ = step(KEY, state, action, params)
        done.append(ended.tolist())
        if not ended[1]:
            expected, single, *_ = alone.step(KEY, single, action)
            np.testing.assert_allclose(obs[1], expected, rtol=1e-4, atol=1e-5)
    assert not np.allclose(obs[0], obs[1])
    assert done == [[False, False], [False, False], [False, True]]


@pytest.mark.slow
def test_a_discrete_action_is_a_row_of_the_table(env_of):
    plain, table = env_of("hover", drones=2, duration=0.02), np.linspace(-1, 1, 24).reshape(3, 8)
    env = gymnax.wrap(plain, discrete_actions=table)
    assert env.num_actions == env.action_space().n == 3
    _, state = env.reset(KEY)
    chosen, _, *_ = env.step(KEY, state, jnp.asarray(2))
    given, _, *_ = gymnax.wrap(plain).step(KEY, state, jnp.asarray(table[2], jnp.float32))
    np.testing.assert_array_equal(chosen, given)
    with pytest.raises(ValueError, match=r"discrete_actions has shape \(3, 4\); expected \(k, 8\)"):
        gymnax.wrap(plain, discrete_actions=table[:, :4])
    with pytest.raises(ValueError, match="discrete_actions is not finite"):
        gymnax.wrap(plain, discrete_actions=np.full((1, 8), np.nan))


@pytest.mark.parametrize("wrap", [gymnax.wrap, jaxmarl.wrap])
def test_the_name_of_a_task_is_an_environment(wrap):
    assert wrap("hover").env.task.name == "hover"
    with pytest.raises(ValueError, match="unknown task 'hoover'"):
        wrap("hoover")


class Ends:
    """Episodes of a drone that end as their state says: whether they are terminated, and truncated."""

    def __init__(self, env):
        pass

    def reset(self, key):
        return jnp.ones((1, 2)), jnp.zeros(2, bool)

    def step_without_reset(self, key, state, action):
        return jnp.zeros((1, 2)), state, jnp.ones(1), state[0], state[1], {"final_obs": jnp.zeros((1, 2))}

    step = step_without_reset


@pytest.mark.parametrize("ends", [(False, False), (True, False), (False, True)])
def test_only_a_termination_has_no_discount_and_each_end_begins_an_episode(ends, env_of, monkeypatch):
    plain = env_of("hover", duration=0.02)
    monkeypatch.setattr(gymnax.envs, "AutoReset", Ends)
    env, separate = gymnax.wrap(plain), gymnax.wrap(plain, separate_truncation=True)
    state, action = jnp.array(ends), jnp.zeros(4)
    for step in env.step, env.step_env:
        *_, done, info = step(KEY, state, action)
        assert (done, info["discount"]) == (any(ends), not ends[0])
    *_, terminated, truncated, _ = separate.step(KEY, state, action)
    *_, of_step_env, info = separate.step_env(KEY, state, action)
    assert (terminated, truncated) == (of_step_env, info["truncated"]) == ends
    obs, after, *_ = env.step(KEY, state, action, env.default_params)
    assert obs.tolist() == [any(ends)] * 2 and not after.any()


def test_params_are_the_vehicle_and_the_time_limit(env_of):
    env = gymnax.wrap(env_of("hover", duration=0.02))
    other = env.env.params.replace(mass=2 * env.env.params.mass)
    made = env._with(gymnax.EnvParams(3, other))
    assert made.steps == 3 and made.params is other


def test_a_number_chooses_a_row_of_the_table(env_of):
    plain, table = env_of("hover", drones=2, duration=0.02), np.linspace(-1, 1, 24).reshape(3, 8)
    env = gymnax.wrap(plain, discrete_actions=table)
    np.testing.assert_allclose(env._gathered(2), table[2].reshape(2, 4), rtol=1e-6)
    of_drones = jaxmarl.wrap(plain, discrete_actions=table[:, :4])
    assert of_drones.get_avail_actions(None)["drone_1"].tolist() == [1, 1, 1]


def test_numbers_of_actions_are_from_0_and_samples_of_equal_spaces_differ():
    three = jax_spaces.Discrete(3)
    drawn = jax.vmap(three.sample)(jax.random.split(KEY, 50))
    assert set(drawn.tolist()) == {0, 1, 2} and three.contains(drawn).all() and not three.contains(3)
    box = jax_spaces.Box(-1.0, 1.0, ())
    sample = jax_spaces.Dict({"a": box, "b": box}).sample(KEY)
    assert sample["a"] != sample["b"]


def test_samples_are_in_their_spaces(env_of):
    env = gymnax.wrap(env_of("hover", drones=2, duration=0.02))
    obs, _ = env.reset(KEY)
    assert env.observation_space().contains(obs)
    assert env.action_space().contains(env.action_space().sample(KEY))
    assert not env.action_space().contains(jnp.full(8, 2.0))
    unbounded = jax_spaces.Box(jnp.array([-3.0, -jnp.inf]), jnp.array([-2.0, jnp.inf]), (2,))
    assert unbounded.contains(unbounded.sample(KEY))  # not NaN


@pytest.mark.needs("gymnax")
@pytest.mark.slow
def test_gymnaxs_own_wrappers_run(env_of):
    from gymnax.environments import spaces
    from gymnax.wrappers.purerl import FlattenObservationWrapper, LogWrapper

    env = LogWrapper(FlattenObservationWrapper(gymnax.wrap(env_of("hover"), separate_truncation=True, spaces=spaces)))
    params = env.default_params
    assert isinstance(env.action_space(params), spaces.Box)
    _, state = env.reset(KEY, params)
    *_, info = env.step(KEY, state, env.action_space(params).sample(KEY), params)
    assert "returned_episode_returns" in info


@pytest.mark.needs("gymnax")
@pytest.mark.slow
def test_gymnaxs_wrapper_for_gymnasium_runs(env_of):
    """Gymnasium's own checker finds that this wrapper does not seed gymnasium's generator, of any environment."""
    from gymnax.environments import spaces
    from gymnax.wrappers.gym import GymnaxToGymWrapper

    env = GymnaxToGymWrapper(gymnax.wrap(env_of("hover", duration=0.02), separate_truncation=True, spaces=spaces))
    obs, _ = env.reset(seed=0)
    np.testing.assert_array_equal(obs, env.reset(seed=0)[0])
    for k in range(2):
        obs, _, terminated, truncated, _ = env.step(np.zeros(4, np.float32))
        assert not terminated and truncated == (k == 1)
    assert np.shape(obs) == env.observation_space.shape and env.action_space.shape == (4,)


@pytest.mark.needs("gymnax")
@pytest.mark.slow
def test_it_has_what_gymnaxs_base_class_promises(env_of):
    from gymnax.environments.environment import Environment

    own = {name for name in vars(Environment) if not name.startswith("_")}
    gradients = {"supports_transition_gradients", "transition_gradients_enabled", "with_transition_gradients"}
    of_its_state = {"is_terminal", "is_terminated", "is_truncated", "discount", "observe", "get_obs", "state_space"}
    assert own - set(dir(gymnax.wrap(env_of("hover")))) <= gradients | of_its_state
