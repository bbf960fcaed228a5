"""One-dimensional hover of Panerati et al. 2021 by PPO of Stable-Baselines3, with the paper's network.

`make sb3` trains a policy, saves it in the format of `jaxdrones train`, and flies it with `jaxdrones fly --policy`,
without Stable-Baselines3 and torch. The learning curve is in curve.png.
"""

import argparse
import math
import time
from pathlib import Path

import jax
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy

from jaxdrones.adapters.sb3 import VecEnv
from jaxdrones.learning import evaluate
from jaxdrones.learning.weights import mlp_policy
from jaxdrones.training.recipe import Recipe
from jaxdrones.training.run import Run
from jaxdrones.visualization.learning_curves import save_curves

RECIPE = Recipe.of("hover-2021", "ppo")
HIDDEN = (512, 512, 256, 128)  # with ReLU; in the paper actor and critic share the first two layers
SETTINGS = dict(batch_size=256, n_epochs=5, gamma=0.98, device="cpu")
EVALUATIONS = 20


class TanhPolicy(ActorCriticPolicy):
    """Actor with a tanh mean, as in the policies of jaxdrones."""

    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        self.action_net = torch.nn.Sequential(self.action_net, torch.nn.Tanh())


def policy_of(model: PPO):
    """Actor of a model in JAX, without exploration."""
    layers = [*model.policy.mlp_extractor.policy_net, *model.policy.action_net]
    weights = [(x.weight.detach().numpy(), x.bias.detach().numpy()) for x in layers if hasattr(x, "weight")]
    return mlp_policy(weights, activation="relu")


class Evaluation(BaseCallback):
    """Evaluate the actor between updates, and keep the one with the highest return."""

    def __init__(self, seed: int, steps: int, folder: Path):
        super().__init__()
        self.seed, self.steps, self.run = seed, steps, Run(folder)
        self.env, self.rows, self.best, self.start = RECIPE.env(), [], -math.inf, time.perf_counter()
        self.update = self.kept = 0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= len(self.rows) * self.steps / EVALUATIONS:
            self.evaluate()
        self.update += 1

    def _on_training_end(self) -> None:
        self.evaluate()

    def evaluate(self) -> None:
        """Add a row of progress; save the actor if it is the best."""
        policy = policy_of(self.model)
        report = evaluate(self.env, policy, jax.random.key(self.seed), episodes=1)  # starts and physics are not random
        error = report.final_error_percentiles[50]
        self.rows.append(
            {"update": self.update, "steps": self.num_timesteps, "seconds": time.perf_counter() - self.start}
            | {"evaluated_return": report.mean_return, "success": report.success, "evaluated_error": error}
        )
        if report.mean_return > self.best:
            self.best, self.kept = report.mean_return, self.update
            self.run.save_policy("best", policy, recipe=RECIPE.as_dict(), update=self.update, seed=self.seed)
        print(
            f"{self.num_timesteps} steps, {self.rows[-1]['seconds']:.0f} s: return {report.mean_return:.1f}, "
            f"{100 * error:.2f} cm from the goal in the end",
            flush=True,
        )


def main() -> None:
    """Train at the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=120_000, help="control steps of all worlds together")
    parser.add_argument("--worlds", type=int, default=16)
    parser.add_argument("--horizon", type=int, default=128, help="control steps of an update in each world")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("runs/hover-2021-sb3"))
    options = parser.parse_args()
    torch.set_num_threads(1)  # JAX uses the other cores
    network = {"net_arch": list(HIDDEN), "activation_fn": torch.nn.ReLU}
    worlds = VecEnv(RECIPE.env(), options.worlds)
    model = PPO(TanhPolicy, worlds, n_steps=options.horizon, seed=options.seed, policy_kwargs=network, **SETTINGS)
    evaluation = Evaluation(options.seed, options.steps, options.output)
    model.learn(options.steps, callback=evaluation)
    title, kept = "hover-2021 by PPO of Stable-Baselines3", {"ppo": evaluation.kept}
    save_curves({"ppo": evaluation.rows}, options.output / "curve.png", title, kept=kept)


if __name__ == "__main__":
    main()
