import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
from jaxdrones.adapters.sb3 import VecEnv

pytestmark = pytest.mark.float32


def test_the_last_step_of_an_episode_tells_what_sb3_looks_for(env_of):
    envs = VecEnv(env_of("hover", duration=0.05), 2, seed=0)
    first = envs.reset()
    total = 0
    for _ in range(5):
        obs, reward, done, infos = envs.step(np.zeros((2, 4), np.float32))
        total += reward
    assert done.tolist() == [True, True] and obs.shape == first.shape == (2, 22)
    for i, info in enumerate(infos):
        assert info["TimeLimit.truncated"] is True
        assert info["terminal_observation"] in envs.observation_space
        assert not np.array_equal(info["terminal_observation"], obs[i])
        assert info["episode"]["l"] == 5 and info["episode"]["r"] == pytest.approx(total[i], rel=1e-5)
    assert envs.step(np.zeros((2, 4), np.float32))[-1] == [{}, {}]


def test_a_seed_fixes_the_start(env_of):
    envs = VecEnv(env_of("hover", duration=0.05), 2)
    envs.seed(3)
    first = envs.reset()
    other = envs.reset()
    envs.seed(3)
    np.testing.assert_array_equal(first, envs.reset())
    assert not np.array_equal(first, other)


def test_worlds_cannot_be_treated_one_by_one(env_of):
    envs = VecEnv(env_of("hover", duration=0.05), 2)
    assert envs.get_attr("num_envs", indices=[0]) == [2]
    assert envs.env_is_wrapped(object) == [False, False]
    with pytest.raises(ValueError, match="give it as an option"):
        envs.set_attr("height", 2.0)


def episode_return(model, envs):
    """Mean over the worlds, of one episode without exploration."""
    envs.seed(0)
    obs, total, running = envs.reset(), np.zeros(envs.num_envs), np.ones(envs.num_envs, bool)
    while running.any():
        action, _ = model.predict(obs, deterministic=True)
        obs, reward, done, _ = envs.step(action)
        total += reward * running
        running &= ~done
    return total.mean()


@pytest.mark.slow
def test_sb3s_ppo_learns_to_hover(env_of):
    from stable_baselines3 import PPO

    env = env_of("hover", action="thrust_and_rates", reach=0.5, speed=0.3, omega=0.3, tilt=15.0)
    test = VecEnv(env, 32)
    model = PPO(
        "MlpPolicy",
        VecEnv(env, 128),
        n_steps=32,
        batch_size=1024,
        n_epochs=5,
        gamma=0.98,
        learning_rate=1e-3,
        policy_kwargs={"net_arch": [64, 64], "log_std_init": -1},
        seed=0,
        device="cpu",
    )
    before = episode_return(model, test)
    model.learn(750_000)
    after = episode_return(model, test)
    assert after > before + 300, (before, after)  # of at most 1,000


def test_sb3_records_videos_of_all_worlds(env_of, tmp_path):
    pytest.importorskip("moviepy")
    from stable_baselines3.common.vec_env import VecVideoRecorder

    envs = VecEnv(env_of("hover", duration=0.05), 2, render_mode="rgb_array")
    recorder = VecVideoRecorder(envs, str(tmp_path), record_video_trigger=lambda step: step == 0, video_length=3)
    recorder.reset()
    for _ in range(4):
        recorder.step(np.zeros((2, 4), np.float32))
    assert [image.shape for image in envs.get_images()] == [(480, 640, 3)] * 2
    recorder.close()
    assert any(file.stat().st_size > 1000 for file in tmp_path.glob("*.mp4"))
