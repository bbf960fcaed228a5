"""Stable-Baselines3's models as policies of ours."""

import jax
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
import torch

from jaxdrones.adapters.sb3 import VecEnv
from jaxdrones.training.algorithms import SB3_ALGORITHMS
from jaxdrones.training.open_run import open_run
from jaxdrones.training.stable_baselines import SB3Recipe, SB3Run

pytestmark = pytest.mark.float32


@pytest.mark.parametrize("task", ["hover-2021", "leader-follower"])
@pytest.mark.parametrize("algorithm", list(SB3_ALGORITHMS))
def test_the_actor_does_what_sb3_predicts(algorithm, task, tmp_path):
    recipe = SB3Recipe.of(task, algorithm, worlds=2)
    env = recipe.env()
    model = recipe.model(VecEnv(env, 2), seed=0)
    with torch.no_grad():
        for x in model.policy.parameters():
            x.mul_(2)  # so that actions reach where they are cut or squashed
    run = SB3Run(tmp_path)
    run.save_model("best", model, recipe=recipe.as_dict())
    actor = run.policy(env=env)
    sizes = [bias.size for _, bias in actor.layers]
    assert sizes == [512, 512, 256, 128, env.drones * env.action_size]  # the paper's
    obs = np.random.default_rng(0).uniform(-1, 1, (1000, env.drones, env.observation_size)).astype(np.float32)
    predicted, _ = model.predict(obs.reshape(1000, *model.observation_space.shape), deterministic=True)
    action = np.asarray(jax.vmap(actor)(obs))
    np.testing.assert_allclose(action, predicted.reshape(action.shape), atol=1e-4)  # float32, summed in another order
    assert action.std() > 1e-3 and np.abs(action).max() <= 1


def test_a_recipe_survives_its_folder(tmp_path):
    recipe = SB3Recipe.of("hover", "sac", realistic=True, duration=1.0, worlds=2, ent_coef=0.1, net_arch=(8,))
    env = recipe.env()
    assert recipe.options == {"duration": 1.0} and env.steps == 100
    run = SB3Run(tmp_path)
    run.save_model("best", recipe.model(VecEnv(env, 2), seed=0), recipe=recipe.as_dict())
    again = open_run(tmp_path).recipe()
    assert again.as_dict() | {"config": None} == recipe.as_dict() | {"config": None}
    assert {k: list(x) if k == "net_arch" else x for k, x in again.config.items()} == recipe.config | {"net_arch": [8]}


def test_a_damaged_or_missing_model_is_named(tmp_path):
    recipe = SB3Recipe.of("hover-2021", net_arch=(8,), worlds=2, n_steps=4, batch_size=8)
    run = SB3Run(tmp_path)
    run.save_model("best", recipe.model(VecEnv(recipe.env(), 2), seed=0), recipe=recipe.as_dict())
    with pytest.raises(FileNotFoundError, match=r"no checkpoint at .*last"):
        run.policy("last")
    with pytest.raises(ValueError, match=r"another version of leader-follower.*train anew"):
        run.policy(env=SB3Recipe.of("leader-follower").env())
    content = (tmp_path / "best.zip").read_bytes()
    flipped = bytearray(content)
    flipped[len(content) // 2] ^= 1
    for damaged in (b"no zip", b"", content[:-1], content + b"x", bytes(flipped)):
        (tmp_path / "best.zip").write_bytes(damaged)
        with pytest.raises(ValueError, match=r"best\.zip is damaged"):
            run.policy()
    (tmp_path / "best.zip").write_bytes(content)
    run.policy()
    sidecar = (tmp_path / "best.json").read_text()
    (tmp_path / "best.json").write_text(sidecar.replace('"n_steps": 4', '"n_steps": 5'))
    with pytest.raises(ValueError, match=r"best\.json is damaged, or was edited"):
        run.recipe()


def test_a_model_with_numbers_that_are_not_finite_is_refused(tmp_path):
    recipe = SB3Recipe.of("hover-2021", net_arch=(8,), worlds=2, n_steps=4, batch_size=8)
    model = recipe.model(VecEnv(recipe.env(), 2), seed=0)
    with torch.no_grad():
        next(model.policy.parameters()).fill_(float("nan"))
    run = SB3Run(tmp_path)
    run.save_model("best", model, recipe=recipe.as_dict())
    with pytest.raises(ValueError, match=r"best\.zip holds numbers that are not finite; take another"):
        run.policy()
