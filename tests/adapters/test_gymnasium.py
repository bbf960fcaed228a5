import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics
from helpers import mostly_slow

from jaxdrones.adapters.gymnasium import GymnasiumEnv, VectorEnv, ids
from jaxdrones.envs import TASKS

pytestmark = pytest.mark.float32

SHORT = 0.05  # s, an episode of five control steps


def short(env_of):
    return env_of("hover", duration=SHORT)


def test_every_task_has_an_id_whose_entry_points_are_only_names():
    assert ids()["hover-2021"] == "jaxdrones/Hover2021-v0" and ids().keys() == TASKS.keys()
    for name in ids().values():
        spec = gymnasium.spec(name)
        assert isinstance(spec.entry_point, str) and isinstance(spec.vector_entry_point, str)


@pytest.mark.parametrize("task", mostly_slow(TASKS, ("hover", "swap-goals", "tune", "hover-2x")))
def test_gymnasium_finds_nothing_to_complain_about(task, env_of):
    env = GymnasiumEnv(env_of(task))
    env.spec = gymnasium.spec(ids()[task])  # without one it does not look at determinism
    check_env(env, skip_render_check=True, skip_close_check=True)


def test_made_by_its_id_it_passes_too_and_takes_pictures():
    pytest.importorskip("pybullet")
    check_env(gymnasium.make("jaxdrones/Hover-v0").unwrapped)


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


def test_a_teams_reward_is_the_sum_over_drones_and_terms(env_of):
    env = GymnasiumEnv(env_of("leader-follower"))
    env.reset(seed=0)
    _, reward, *_, info = env.step(env.action_space.sample())
    assert type(reward) is float
    assert reward == pytest.approx(sum(term.sum() for term in info["rewards"].values()), rel=1e-6)


def test_a_seed_fixes_the_episode_and_those_that_follow(env_of):
    first, second = GymnasiumEnv(short(env_of)), GymnasiumEnv(short(env_of))
    starts = [[env.reset(seed=5)[0], env.reset()[0], env.reset()[0]] for env in (first, second)]
    np.testing.assert_array_equal(*starts)
    assert not np.array_equal(starts[0][0], starts[0][1]) and not np.array_equal(starts[0][1], starts[0][2])


def test_an_episode_is_cut_at_its_time_limit_and_then_needs_a_reset(env_of):
    env = GymnasiumEnv(short(env_of))
    with pytest.raises(gymnasium.error.ResetNeeded, match="before reset"):
        env.step(np.zeros(4))
    env.reset(seed=0)
    for _ in range(4):
        assert env.step(np.zeros(4))[2:4] == (False, False)
    assert env.step(np.zeros(4))[2:4] == (False, True)
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
    with pytest.raises(ValueError, match=r"\(4,\); expected \(3, 4\)"):
        envs.step(np.zeros(4))
    with pytest.raises(ValueError, match="not finite"):
        envs.step(np.full((3, 4), np.inf))
    with pytest.raises(ValueError, match="options reset_mask"):
        envs.reset(options={"reset_mask": np.ones(3, bool)})
    with pytest.raises(ValueError, match="unknown option of hover 'heigth'; did you mean 'height'"):
        gymnasium.make("jaxdrones/Hover-v0", heigth=1.0)
    with pytest.raises(ValueError, match="unknown option"):
        gymnasium.make_vec("jaxdrones/Hover-v0", num_envs=2, colour="red")
    with pytest.raises(ValueError, match="num_envs is 0"):
        VectorEnv("hover", 0)
    with pytest.raises(ValueError, match="render_mode is 'human'"):
        GymnasiumEnv("hover", render_mode="human")
    with pytest.raises(ValueError, match="given beside an environment"):
        GymnasiumEnv(short(env_of), backend="explicit")
    by_drone = GymnasiumEnv(env_of("leader-follower"), dict_spaces=True)
    by_drone.reset(seed=0)
    with pytest.raises(ValueError, match="action is for 0; give a dict with one each for 0, 1"):
        by_drone.step({"0": np.zeros(1)})


def test_world_i_of_many_flies_as_one_that_is_reset_with_the_seed_plus_i(env_of):
    envs, alone = VectorEnv(short(env_of), 3), GymnasiumEnv(short(env_of))
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


def test_the_next_episode_begins_in_the_step_in_which_one_ends(env_of):
    envs = VectorEnv(short(env_of), 3)
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


def test_only_worlds_whose_episode_ended_are_masked(env_of):
    envs = VectorEnv("hover", 2, duration=0.5, reach=0.0)
    obs, _ = envs.reset(seed=0)
    state = jax.tree.map(np.array, envs._worlds)
    count, episodes = state
    episodes.world.step[1] = envs.env.steps - 1
    envs._worlds = (count, episodes)
    obs, _, _, truncated, infos = envs.step(np.zeros((2, 4)))
    assert truncated.tolist() == infos["_final_obs"].tolist() == infos["_final_info"].tolist() == [False, True]
    assert infos["_metrics"].tolist() == [True, False]
    np.testing.assert_array_equal(infos["final_obs"][0], obs[0])


def test_a_time_limit_is_that_of_the_adapter_and_not_of_the_environment_it_was_given(env_of):
    env = short(env_of)
    envs = VectorEnv(env, 2, max_episode_steps=2)
    envs.reset(seed=0)
    assert [bool(envs.step(np.zeros((2, 4)))[3].all()) for _ in range(2)] == [False, True]
    assert env.steps == 5


def test_wrappers_of_gymnasium_understand_the_infos(env_of):
    envs = RecordEpisodeStatistics(VectorEnv(short(env_of), 3))
    envs.reset(seed=0)
    for _ in range(5):
        *_, infos = envs.step(np.zeros((3, 4)))
    np.testing.assert_allclose(infos["episode"]["r"], infos["final_info"]["episode"]["r"], rtol=1e-5)
    listed = DictInfoToList(VectorEnv(short(env_of), 3))
    listed.reset(seed=0)
    for _ in range(5):
        *_, infos = listed.step(np.zeros((3, 4)))
    assert infos[2]["final_info"]["episode"]["l"] == 5 and "error" in infos[2]["final_info"]["metrics"]


def test_arrays_are_ones_own_or_not_copied_at_all(env_of):
    envs = VectorEnv(short(env_of), 3)
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
