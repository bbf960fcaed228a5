"""The examples run and learn; in the tests' environment only those whose library is installed."""

import importlib.util
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from documents import ROOT

pytestmark = [pytest.mark.float32, pytest.mark.slow, pytest.mark.filterwarnings("default")]


def example(name):
    """An example as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.needs("matplotlib")
def test_the_points_of_a_word_keep_apart_and_leave_the_hole_of_an_a_free():
    module = example("word")
    points = module.letters("JAX", 150)
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1) + 9 * np.eye(150)
    assert points.shape == (150, 3) and apart.min() > 0.9 * module.SPACING
    x, _, z = module.letters("A", 200).T
    middle = np.abs(x - (x.max() + x.min()) / 2) < 0.1 * np.ptp(x)
    gaps = np.diff(np.sort(z[middle]))
    assert gaps.max() > 2.5 * module.SPACING  # between the bar and the top


@pytest.mark.needs("matplotlib")
def test_drones_take_the_points_of_a_word_and_a_page_has_fewer_rows():
    import jaxdrones as jd

    module = example("word")
    task = module.word("X", 12)
    env = jd.make(task)
    _, world = env.reset(jax.random.key(0))
    goal = np.asarray(world.variables["goal"])
    taken, points = (np.array(sorted(x.round(3).tolist())) for x in (goal, module.letters("X", 12)))
    np.testing.assert_allclose(taken, points, atol=2e-3)
    flight = module.fly_episode(env, lambda obs: jnp.zeros((12, 4)), jax.random.key(0))
    shown = module.thinned(flight)
    assert len(shown.t) == -(-len(flight.t) // module.EVERY) and shown.drones.pos.shape == (len(shown.t), 12, 3)


@pytest.mark.needs("torch")
def test_arrays_and_tensors_share_their_memory():
    import gymnasium
    import jax.numpy as jnp
    import torch

    module = example("cleanrl_ppo")
    obs, _ = gymnasium.make_vec("jaxdrones/Hover-v0", num_envs=64, numpy=False).reset(seed=0)
    tensor = module.to_torch(obs)
    assert tensor.data_ptr() == obs.unsafe_buffer_pointer() and tensor.shape == obs.shape
    action = torch.zeros(64, 4)
    assert isinstance(module.to_jax(action), jnp.ndarray)
    assert module.to_jax(action).unsafe_buffer_pointer() == action.data_ptr()


@pytest.mark.needs("torch")
def test_the_policy_that_is_evaluated_is_the_one_that_was_trained():
    import torch

    module = example("cleanrl_ppo")
    torch.manual_seed(0)
    agent, obs = module.Agent(22, 4, 0.4), torch.randn(5, 22)
    agent.update_statistics(torch.randn(100, 22) * 3 + 1)
    with torch.no_grad():
        expected = agent.distribution(obs).mean
        np.testing.assert_allclose(module.jax_policy(agent)(module.to_jax(obs)), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.needs("torch")
def test_one_episode_is_reported_without_an_interval(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["cleanrl_ppo.py", "--steps", "0", "--episodes", "1"])
    example("cleanrl_ppo").main()
    assert "(no interval) of 1 episodes" in capsys.readouterr().out


@pytest.mark.needs("torch")
def test_cleanrls_style_of_ppo_learns():
    _, returns = example("cleanrl_ppo").train(2_000_000)
    assert returns[-1] > returns[0] + 600, returns


@pytest.mark.needs("skrl")
def test_skrls_ppo_learns():
    returns = example("skrl_ppo").train(200_000)
    assert returns[-1] > 3 * returns[0], returns


@pytest.mark.needs("torchrl")
def test_torchrls_ppo_learns():
    returns = example("torchrl_ppo").train(200_000)
    assert returns[-1] > 3 * returns[0], returns


@pytest.mark.needs("torchrl")
def test_torchrls_checker_passes():
    from torchrl.envs.utils import check_env_specs

    import jaxdrones as jd

    env = example("torchrl_ppo").DroneEnv(jd.make("hover", duration=0.1), 3)
    check_env_specs(env)
    assert env.rollout(25, break_when_any_done=False)["next", "truncated"].sum() == 6  # every 10 steps


@pytest.mark.needs("ray")
def test_what_the_script_for_rllib_saves_flies_without_ray(tmp_path):
    sizes = ["--seeds", "1", "--updates", "2", "--worlds", "4", "--horizon", "150", "--output", str(tmp_path)]
    subprocess.run([sys.executable, ROOT / "examples" / "rllib_leader_follower.py", *sizes], check=True)
    flies_without(("ray", "torch"), tmp_path, "leader-follower by ppo")


@pytest.mark.needs("stable_baselines3")
def test_what_the_script_for_sb3_saves_flies_without_sb3(tmp_path, monkeypatch):
    sizes = ["--steps", "64", "--worlds", "2", "--horizon", "16", "--output", str(tmp_path)]
    monkeypatch.setattr("sys.argv", ["sb3_hover.py", *sizes])
    example("sb3_hover").main()
    flies_without(("stable_baselines3", "torch"), tmp_path, "hover-2021 by ppo")


@pytest.mark.needs("stable_baselines3")
def test_the_policy_in_jax_predicts_what_the_model_of_sb3_does():
    module = example("sb3_hover")
    import torch
    from stable_baselines3 import PPO

    env = module.RECIPE.env()
    network = {"net_arch": [8, 8], "activation_fn": torch.nn.ReLU}
    model = PPO(module.TanhPolicy, module.VecEnv(env, 2), policy_kwargs=network, device="cpu")
    for x in model.policy.parameters():
        x.data *= 2
    obs = np.random.default_rng(0).uniform(-1, 1, (100, 1, env.observation_size)).astype(np.float32)
    expected, _ = model.predict(obs.reshape(100, *model.observation_space.shape), deterministic=True)
    np.testing.assert_allclose(module.policy_of(model)(obs), expected.reshape(100, 1, 1), atol=1e-5)
    assert expected.std() > 1e-3


def flies_without(libraries, folder, title):
    """Fly the policy of a folder in a process of its own, which does not import some libraries."""
    command = ["fly", "--policy", str(folder)]
    code = f"import sys; from jaxdrones.cli import main; code = main({command}); "
    code += f"raise SystemExit(code or ', '.join({set(libraries)} & sys.modules.keys()) or None)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and title in done.stdout, done.stderr
    assert (folder / "curve.png").stat().st_size > 0 and (folder / "flight" / "flight.png").stat().st_size > 0
