import functools
from types import SimpleNamespace

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics
from helpers import mostly_slow

from jaxdrones.adapters.gymnasium import GymnasiumEnv, VectorEnv, ids
from jaxdrones.adapters.session import as_numpy
from jaxdrones.adapters.spaces import Layout
from jaxdrones.envs import TASKS

pytestmark = pytest.mark.float32

SHORT = 0.05  # s, an episode of five control steps


def short(env_of):
    return env_of("hover", duration=SHORT)


@pytest.fixture(scope="module")
def vector_of(env_of):
    """Three short worlds in an autoreset mode, compiled once; to be reset by the test that asks for them."""
    return functools.cache(lambda mode=AutoresetMode.SAME_STEP: VectorEnv(short(env_of), 3, autoreset_mode=mode))


def test_every_task_has_an_id_whose_entry_points_are_only_names():
    assert ids()["hover-2021"] == "jaxdrones/Hover2021-v0" and ids().keys() == TASKS.keys()
    for name in ids().values():
        spec = gymnasium.spec(name)
        assert isinstance(spec.entry_point, str) and isinstance(spec.vector_entry_point, str)


@pytest.mark.parametrize("task", mostly_slow(TASKS, ["hover"]))
def test_gymnasium_finds_nothing_to_complain_about(task, env_of):
    env = GymnasiumEnv(env_of(task))
    env.spec = gymnasium.spec(ids()[task])  # without one it does not look at determinism
    check_env(env, skip_render_check=True, skip_close_check=True)


@pytest.mark.slow
def test_made_by_its_id_it_passes_too_and_takes_pictures():
    pytest.importorskip("pybullet")
    check_env(gymnasium.make("jaxdrones/Hover-v0").unwrapped)


@pytest.mark.slow
def test_dict_spaces_by_drone_pass_and_show_what_the_boxes_show(env_of):
    stacked, by_drone = (GymnasiumEnv(env_of("leader-follower"), dict_spaces=choice) for choice in (False, True))
    by_drone.spec = gymnasium.spec("jaxdrones/LeaderFollower-v0")
    check_env(by_drone, skip_render_check=True, skip_close_check=True)
    obs, _ = stacked.reset(seed=1)
    obs_by_drone, _ = by_drone.reset(seed=1)
    assert list(obs_by_drone) == ["0", "1"]
    np.testing.assert_array_equal(obs, np.stack(list(obs_by_drone.values())))
    action = stacked.action_space.sample()
    obs, reward, *_ = stacked.step(action)
    obs_by_drone, reward_by_drone, *_ = by_drone.step({"0": action[0], "1": action[1]})
    np.testing.assert_array_equal(obs, np.stack(list(obs_by_drone.values())))
    assert reward == reward_by_drone


@pytest.mark.slow
@pytest.mark.parametrize(
    "one_rule, many_rule", [("sum", "mean"), *(pytest.param(x, x, marks=pytest.mark.slow) for x in ("sum", "mean"))]
)
def test_a_teams_reward_is_the_sum_or_the_mean_over_drones_of_all_terms(env_of, one_rule, many_rule):
    """Also for many worlds, as Stable-Baselines3 and Tianshou see them; the sum where nothing is said."""
    env, share = env_of("hover", drones=2, duration=0.02), {"sum": 1.0, "mean": 0.5}
    one, many = (
        make(*args, **({} if rule == "sum" else {"team_reward": rule}))
        for make, args, rule in ((GymnasiumEnv, (env,), one_rule), (VectorEnv, (env, 1), many_rule))
    )
    one.reset(seed=0), many.reset(seed=0)
    rewards = []
    for _ in range(2):
        _, reward, *_, info = one.step(np.full((2, 4), 0.1))
        assert type(reward) is float
        terms = sum(x.sum() for name, x in info.items() if name.startswith("reward_"))
        assert reward == pytest.approx(share[one_rule] * terms, rel=1e-5)
        _, of_worlds, *_, infos = many.step(np.full((1, 2, 4), 0.1))
        np.testing.assert_allclose(of_worlds, share[many_rule] * terms, rtol=1e-5)
        rewards.append(of_worlds[0])
    np.testing.assert_allclose(infos["final_info"]["episode"]["r"], sum(rewards), rtol=1e-5)
    with pytest.raises(ValueError, match="team_reward"):
        GymnasiumEnv(env, team_reward="max")


def test_a_seed_fixes_the_episode_and_those_that_follow(env_of):
    first, second = GymnasiumEnv(short(env_of)), GymnasiumEnv(short(env_of))
    starts = [[env.reset(seed=5)[0], env.reset()[0], env.reset()[0]] for env in (first, second)]
    np.testing.assert_array_equal(*starts)
    assert not np.array_equal(starts[0][0], starts[0][1]) and not np.array_equal(starts[0][1], starts[0][2])
    np.testing.assert_array_equal(first.reset(seed=0)[0], first.reset(seed=2**32)[0])


def test_an_episode_is_cut_at_its_time_limit_and_then_needs_a_reset(env_of):
    env = GymnasiumEnv(short(env_of))
    with pytest.raises(gymnasium.error.ResetNeeded, match="before reset"):
        env.step(np.zeros(4))
    env.reset(seed=0)
    assert env.metadata["render_fps"] == 100
    assert env.action_space.low.tolist() == [-1] * 4 and env.action_space.high.tolist() == [1] * 4
    for _ in range(4):
        assert env.step(np.zeros(4))[2:4] == (False, False)
    *_, terminated, truncated, info = env.step(np.zeros(4))
    assert (terminated, truncated) == (False, True)
    assert {type(x) for x in info.values()} == {float, bool}  # of the only drone
    with pytest.raises(gymnasium.error.ResetNeeded, match="after the end"):
        env.step(np.zeros(4))


def test_mistakes_are_named(env_of):
    env, envs = GymnasiumEnv(short(env_of)), VectorEnv(short(env_of), 3)
    with pytest.raises(gymnasium.error.ResetNeeded, match="before reset"):
        envs.step(np.zeros((3, 4)))
    env.reset(seed=0), envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"\(3,\); expected \(4,\): 4 numbers"):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match="not finite in 1 of 4 entries, the first at"):
        env.step(np.array([0, np.nan, 0, 0]))
    with pytest.raises(ValueError, match="not finite in 1 of 4 entries, the first at"):
        env.step(jnp.array([0, jnp.nan, 0, 0]))
    assert env.step(jnp.zeros(4, int))[2:4] == (False, False)
    for option in ({"numpy": "no"}, {"dict_spaces": 1}):
        with pytest.raises(ValueError, match=f"{next(iter(option))} is .*; give True or False"):
            VectorEnv("hover", 3, **option)
    with pytest.raises(ValueError, match=r"\(4,\); expected \(3, 4\)"):
        envs.step(np.zeros(4))
    with pytest.raises(ValueError, match="not finite"):
        envs.step(np.full((3, 4), np.inf))
    with pytest.raises(ValueError, match="unknown options mask; leave them out"):
        envs.reset(options={"mask": np.ones(3, bool)})
    with pytest.raises(ValueError, match=r"reset_mask has shape \(2,\) and dtype bool; give \(3,\) of True and False"):
        envs.reset(options={"reset_mask": np.ones(2, bool)})
    with pytest.raises(ValueError, match="seed has 2 entries; give one number, or one for each of 3"):
        envs.reset(seed=[1, 2])
    for wrong in -1, 1.5:
        with pytest.raises(ValueError, match=f"an entry of seed is {wrong}; give a whole number of at least 0"):
            envs.reset(seed=[0, wrong, None])
    for wrong in -1, 1.5, True:
        with pytest.raises(ValueError, match=f"^seed is {wrong!r}; give a whole number of at least 0$"):
            envs.reset(seed=wrong)
    with pytest.raises(ValueError, match="unknown autoreset_mode 'Never'"):
        VectorEnv(short(env_of), 3, autoreset_mode="Never")
    with pytest.raises(TypeError, match="unexpected keyword argument 'heigth'; did you mean 'height'"):
        gymnasium.make("jaxdrones/Hover-v0", heigth=1.0)
    with pytest.raises(TypeError, match="unexpected keyword argument 'color'"):
        gymnasium.make_vec("jaxdrones/Hover-v0", num_envs=2, color="red")
    with pytest.raises(ValueError, match="num_envs is 0"):
        VectorEnv("hover", 0)
    with pytest.raises(ValueError, match="unknown render_mode 'human'"):
        GymnasiumEnv("hover", render_mode="human")
    with pytest.raises(TypeError, match="unexpected keyword argument 'backend' beside an environment"):
        GymnasiumEnv(short(env_of), backend="explicit")
    by_drone = GymnasiumEnv(env_of("leader-follower"), dict_spaces=True)
    by_drone.reset(seed=0)
    with pytest.raises(ValueError, match="actions are for 0; give a dict with an action for each of 0, 1"):
        by_drone.step({"0": np.zeros(1)})


@pytest.mark.slow
def test_world_i_of_many_flies_as_one_that_is_reset_with_the_seed_plus_i(env_of, vector_of):
    envs, alone = vector_of(), GymnasiumEnv(short(env_of))
    obs, _ = envs.reset(seed=7)
    alone_obs, _ = alone.reset(seed=9)
    np.testing.assert_array_equal(obs[2], alone_obs)
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 3, 4)).astype(np.float32)
    for k in range(5):
        obs, reward, _, truncated, infos = envs.step(actions[k])
        alone_obs, alone_reward, *_ = alone.step(actions[k, 2])
        seen = infos["final_obs"] if k == 4 else obs
        np.testing.assert_allclose(seen[2], alone_obs, rtol=1e-4, atol=1e-5)  # two programs round differently
        assert reward[2] == pytest.approx(alone_reward, rel=1e-4)
    assert truncated.all()


@pytest.mark.slow
def test_the_next_episode_begins_in_the_step_in_which_one_ends(vector_of):
    envs = vector_of()
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    starts = [envs.reset(seed=0)[0]]
    hover = np.zeros((3, 4), np.float32)
    for _ in range(2):
        total = 0
        for k in range(5):
            obs, reward, terminated, truncated, infos = envs.step(hover)
            total += reward
            assert ("final_obs" in infos) == ("final_info" in infos) == (k == 4)
        assert truncated.all() and not terminated.any() and infos["_final_obs"].all()
        assert not np.array_equal(infos["final_obs"], obs)
        np.testing.assert_array_equal(infos["final_info"]["episode"]["l"], 5)
        np.testing.assert_allclose(infos["final_info"]["episode"]["r"], total, rtol=1e-6)
        starts.append(obs)
    rows = np.concatenate(starts)
    assert len(np.unique(rows, axis=0)) == len(rows)  # every episode of every world begins anew


@pytest.mark.slow
def test_only_worlds_whose_episode_ended_are_masked(vector_of):
    envs = vector_of()
    envs.reset(seed=0)
    envs.step(np.zeros((3, 4)))
    envs.reset(options={"reset_mask": np.array([True, False, True])})
    for _ in range(4):
        obs, _, _, truncated, infos = envs.step(np.zeros((3, 4)))
    assert truncated.tolist() == infos["_final_obs"].tolist() == infos["_final_info"].tolist() == [False, True, False]
    assert infos["_metric_error"].tolist() == [True, False, True]
    np.testing.assert_array_equal(infos["final_obs"][0], obs[0])


@pytest.mark.slow
def test_the_next_episode_begins_in_the_step_after_the_end(vector_of):
    """The step that resets ignores its action, rewards nothing, and shows what the same-step mode shows before."""
    same, after = vector_of(), vector_of(AutoresetMode.NEXT_STEP)
    assert after.autoreset_mode is after.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    np.testing.assert_array_equal(same.reset(seed=0)[0], after.reset(seed=0)[0])
    for _ in range(5):
        _, same_reward, *_, same_infos = same.step(np.full((3, 4), 0.1))
        obs, reward, terminated, truncated, infos = after.step(np.full((3, 4), 0.1))
        assert "final_obs" not in infos and infos["_reward_position"].all()
    assert truncated.all()
    np.testing.assert_allclose(obs, same_infos["final_obs"], rtol=1e-4, atol=1e-5)  # two programs round differently
    np.testing.assert_allclose(reward, same_reward, rtol=1e-4)
    starts, reward, terminated, truncated, infos = after.step(np.ones((3, 4)))
    assert not reward.any() and not terminated.any() and not truncated.any() and not infos["_reward_position"].any()
    assert len(np.unique(np.concatenate([starts, obs]), axis=0)) == 6
    first = after.step(np.zeros((3, 4)))
    assert not first[3].any() and first[-1]["_reward_position"].all() and not np.array_equal(first[0], starts)


def test_a_world_that_a_mask_resets_is_not_reset_again_by_the_next_step(env_of):
    """In next-step mode; the other one, whose episode ended too, is."""
    envs = VectorEnv(env_of("hover", duration=0.02), 2, autoreset_mode=AutoresetMode.NEXT_STEP)
    envs.reset(seed=0)
    envs.step(np.zeros((2, 4)))
    assert envs.step(np.zeros((2, 4)))[3].all()
    start, _ = envs.reset(options={"reset_mask": np.array([True, False])})
    obs, reward, terminated, truncated, infos = envs.step(np.zeros((2, 4)))
    assert (reward != 0).tolist() == infos["_reward_position"].tolist() == [True, False]
    assert infos["reward_position"].shape == (2,)  # of the only drone of each world
    assert not terminated.any() and not truncated.any()
    assert np.abs(obs[0] - start[0]).max() < 0.2 < np.abs(obs[1] - start[1]).max()


@pytest.mark.slow
def test_without_autoreset_a_mask_says_which_worlds_begin_anew(env_of, vector_of):
    envs = vector_of(AutoresetMode.DISABLED)
    start, _ = envs.reset(seed=[5, None, 1])
    np.testing.assert_array_equal(start[0], vector_of().reset(seed=5)[0][0])
    with pytest.raises(gymnasium.error.ResetNeeded, match="before the first reset of all worlds"):
        VectorEnv(short(env_of), 3).reset(options={"reset_mask": np.ones(3, bool)})
    for _ in range(5):
        last, *_, truncated, _ = envs.step(np.zeros((3, 4)))
    assert truncated.all()
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"worlds \[0, 1, 2\] have ended"):
        envs.step(np.zeros((3, 4)))
    obs, _ = envs.reset(seed=[5, 5, 5], options={"reset_mask": np.array([True, False, True])})
    np.testing.assert_array_equal(obs, [start[0], last[1], start[0]])
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"worlds \[1\] have ended"):
        envs.step(np.zeros((3, 4)))
    envs.reset(options={"reset_mask": np.array([False, True, False])})
    for _ in range(5):
        truncated = envs.step(np.zeros((3, 4)))[3]
    assert truncated.all()


def test_real_numbers_are_of_single_precision_and_others_as_they_were():
    types = [x.dtype for x in as_numpy((np.zeros(2), np.zeros(2, np.uint8), np.zeros(2, bool)))]
    assert types == [np.float32, np.uint8, bool]


def test_actions_by_drone_have_the_drones_after_the_worlds(env_of):
    layout = Layout(env_of("leader-follower"), ["a", "b"])
    actions = layout.gather({"a": np.zeros((3, 1)), "b": np.ones((3, 1))}, (3,))
    np.testing.assert_array_equal(actions, np.tile([[0], [1]], (3, 1, 1)))
    left = layout.gather_present({"a": np.ones(1), "b": np.full(1, np.nan)}, ["a"])  # whatever is given to b
    np.testing.assert_array_equal(left, [[1], [0]])


class Keys:
    """Episodes of two drones, of two steps each, that observe the key of a step."""

    def reset(self, key):
        return key.astype(jnp.float32)[:, None], jnp.zeros((), int)

    def step(self, key, age, action):
        obs, _ = self.reset(key)
        reward = jnp.array([1.0, 2.0])
        info = {"rewards": {"a": reward}, "metrics": {}, "terminations": {}, "truncations": {}}
        info |= {"final_obs": obs, "episode": {"return": 2 * reward, "length": age + 1}}
        return obs, 1 - age, reward, jnp.zeros((), bool), age == 1, info


def test_every_step_has_a_key_of_its_own_and_the_last_one_of_an_episode_the_return_of_the_team(env_of):
    envs = VectorEnv(env_of("hover", drones=2, duration=0.02), 2)
    envs._worlds._episodes = Keys()
    start, _ = envs.reset(seed=0)
    (first, reward, *_, info), (second, *_, ended, infos) = (envs.step(np.zeros((2, 2, 4))) for _ in range(2))
    assert len(np.unique(np.concatenate([start, first, second]), axis=0)) == 6
    assert reward.tolist() == [3, 3] and ended.all() and infos["final_info"]["episode"]["r"].tolist() == [6, 6]
    assert info["_reward_a"].all() and not infos["_reward_a"].any() and infos["_final_info"].all()


def test_a_time_limit_is_that_of_the_adapter_alone(env_of):
    env = short(env_of)
    assert VectorEnv(env, 2, max_episode_steps=2).env.steps == 2 and env.steps == 5


def test_seeds_count_on_from_the_first_and_begin_again_after_32_bits(env_of):
    seeds, _ = without_worlds(VectorEnv(short(env_of), 3)).reset(seed=2**32 - 1)
    assert seeds.tolist() == [2**32 - 1, 0, 1]


def test_a_world_that_ended_needs_a_reset_until_a_mask_resets_it(env_of):
    envs = without_worlds(VectorEnv(short(env_of), 3, autoreset_mode="Disabled"))
    envs._over[:] = True
    envs.reset(options={"reset_mask": np.array([True, False, True])})
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"worlds \[1\] have ended"):
        envs.step(np.zeros((3, 4)))


def test_final_observations_and_infos_are_those_of_the_worlds_that_ended(env_of):
    envs, ended, error = VectorEnv(short(env_of), 3), np.array([True, False, False]), np.arange(3.0)
    info = {"last": {"error": error}, "not_reset": ~ended, "final_obs": error, "episode": {"r": error}}
    infos = envs._infos(info, ended)
    assert infos["_final_obs"] is infos["_final_info"] is infos["final_info"]["_error"] is ended
    assert infos["_error"].tolist() == [False, True, True] and infos["final_info"]["episode"]["_r"] is ended
    assert "final_obs" not in envs._infos(info, np.zeros(3, bool))


def without_worlds(envs):
    """Many worlds that are not simulated: their observations are their seeds."""
    envs._worlds = SimpleNamespace(started=True, reset=lambda seeds, mask: seeds)
    return envs


def test_a_list_of_seeds_is_one_for_every_world(vector_of):
    envs = vector_of()
    counted, _ = envs.reset(seed=7)
    listed, _ = envs.reset(seed=[9, 8, 7])
    np.testing.assert_array_equal(listed, counted[::-1])


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")  # gymnasium compares bounds with float64's range
@pytest.mark.parametrize(
    ("wrapper", "mode"),
    [
        ("NormalizeObservation", AutoresetMode.NEXT_STEP),  # which takes no other
        ("FlattenObservation", AutoresetMode.NEXT_STEP),
        ("FlattenObservation", AutoresetMode.DISABLED),
        ("DtypeObservation", AutoresetMode.NEXT_STEP),
    ],
)
@pytest.mark.slow
def test_observation_wrappers_of_gymnasium_run(wrapper, mode, vector_of):
    given = {"dtype": np.float64} if wrapper == "DtypeObservation" else {}
    envs = getattr(gymnasium.wrappers.vector, wrapper)(vector_of(mode), **given)
    envs.reset(seed=0)
    for _ in range(5):
        obs, *_ = envs.step(np.zeros((3, 4)))
    assert obs in envs.observation_space or wrapper == "NormalizeObservation"
    assert np.isfinite(obs).all()


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")  # gymnasium compares bounds with float64's range
@pytest.mark.parametrize(
    "wrapper",
    mostly_slow(["NormalizeObservation", "FlattenObservation", "DtypeObservation"], ["DtypeObservation"]),
)
def test_observation_wrappers_of_one_environment_run(wrapper, env_of):
    given = {"dtype": np.float64} if wrapper == "DtypeObservation" else {}
    by_drone = wrapper == "FlattenObservation"
    plain = GymnasiumEnv(env_of("leader-follower"), dict_spaces=True) if by_drone else GymnasiumEnv(short(env_of))
    env = getattr(gymnasium.wrappers, wrapper)(plain, **given)
    obs, _ = env.reset(seed=0)
    for _ in range(3):
        obs, *_ = env.step(env.action_space.sample())
    assert obs.shape == env.observation_space.shape and obs.dtype == env.observation_space.dtype
    assert obs in env.observation_space or wrapper == "NormalizeObservation"


@pytest.mark.slow
def test_a_time_limit_is_that_of_the_adapter_and_not_of_the_environment_it_was_given(env_of):
    env = short(env_of)
    envs = VectorEnv(env, 2, max_episode_steps=2)
    envs.reset(seed=0)
    assert [bool(envs.step(np.zeros((2, 4)))[3].all()) for _ in range(2)] == [False, True]
    assert env.steps == 5


@pytest.mark.slow
def test_wrappers_of_gymnasium_understand_the_infos(vector_of):
    envs = RecordEpisodeStatistics(vector_of())
    envs.reset(seed=0)
    for _ in range(5):
        *_, infos = envs.step(np.zeros((3, 4)))
    np.testing.assert_allclose(infos["episode"]["r"], infos["final_info"]["episode"]["r"], rtol=1e-5)
    listed = DictInfoToList(vector_of())
    listed.reset(seed=0)
    for _ in range(5):
        *_, infos = listed.step(np.zeros((3, 4)))
    assert infos[2]["final_info"]["episode"]["l"] == 5 and "metric_error" in infos[2]["final_info"]


@pytest.mark.slow
def test_arrays_are_ones_own_or_not_copied_at_all(env_of, vector_of):
    envs = vector_of()
    first, _ = envs.reset(seed=0)
    obs, reward, terminated, *_ = envs.step(np.zeros((3, 4)))
    assert all(type(x) is np.ndarray and x.flags.writeable for x in (first, obs, reward, terminated))
    assert obs.dtype == reward.dtype == np.float32 and terminated.dtype == bool
    kept = first.copy()
    obs[:] = reward[:] = 0
    envs.step(np.zeros((3, 4)))
    np.testing.assert_array_equal(first, kept)

    on_device = VectorEnv(short(env_of), 3, numpy=False)
    on_device.reset(seed=0)
    obs, reward, terminated, truncated, infos = on_device.step(jax.numpy.zeros((3, 4)))
    assert all(isinstance(x, jax.Array) for x in (obs, reward, terminated, truncated, infos["_final_obs"]))


@pytest.mark.slow
def test_make_vec_takes_the_options_of_both(env_of):
    envs = gymnasium.make_vec(
        "jaxdrones/LeaderFollower-v0", num_envs=2, drones=3, dict_spaces=True, max_episode_steps=2
    )
    assert envs.single_observation_space.keys() == {"0", "1", "2"}
    obs, _ = envs.reset(seed=0)
    assert obs in envs.observation_space
    for _ in range(2):
        obs, reward, _, truncated, infos = envs.step(envs.action_space.sample())
    assert obs in envs.observation_space and infos["final_obs"] in envs.observation_space
    assert truncated.all() and reward.shape == (2,)


@pytest.mark.slow
def test_bullet_flies_alone_and_many_with_cameras(env_of):
    pytest.importorskip("pybullet")
    options = dict(backend="bullet", vision=("rgb", "depth", "segmentation"), drones=2, height=2.0)
    with gymnasium.make("jaxdrones/Hover-v0", **options) as env:
        obs, _ = env.reset(seed=0)
        assert obs in env.observation_space
        obs, *_ = env.step(env.action_space.sample())
        assert obs in env.observation_space and obs["rgb"].shape == (2, 48, 64, 4)
    envs = gymnasium.make_vec("jaxdrones/Hover-v0", num_envs=2, **options)
    obs, _ = envs.reset(seed=0)
    assert obs in envs.observation_space
    obs, *_ = envs.step(envs.action_space.sample())
    assert obs in envs.observation_space
    envs.close()
