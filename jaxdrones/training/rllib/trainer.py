"""Training by RLlib's PPO under the loop of our own learners."""

from __future__ import annotations

import time
from typing import Any

import jax
import numpy as np

from jaxdrones.errors import UserError
from jaxdrones.learning import sharding
from jaxdrones.learning.evaluation import check_episodes, compile_evaluation
from jaxdrones.learning.networks import Policy
from jaxdrones.pytree import PyTreeNode
from jaxdrones.training.plan import check_stop_at
from jaxdrones.training.recipe import Recipe
from jaxdrones.training.rllib.algorithm import build, start_ray
from jaxdrones.training.rllib.learner import AdaptiveLearner
from jaxdrones.training.rllib.module import CentralizedCriticModule, policy_of
from jaxdrones.training.run import RLLIB_CHECKPOINT, Run, size_of
from jaxdrones.training.torch_threads import one_torch_thread
from jaxdrones.training.trainer import BaseTrainer

_DISK_FACTOR = 8  # the disk must have space for so many times the parameters
_SIMULATED = ("reward", "error", "return", "termination_rate")
_LEARNED = {"value_loss": "vf_loss", "kl": "mean_kl_loss"}  # our name of a metric of RLlib's learner: RLlib's


class TrainState(PyTreeNode):
    """What the loop of a training sees of RLlib's algorithm."""

    policy: Policy


class RLlibTrainer(BaseTrainer):
    """The algorithm of a recipe; a training of another seed makes a new one."""

    def __init__(self, recipe: Recipe, episodes: int = 1000):
        """Prepare; `compile` starts ray and compiles.

        Args:
            recipe: what to train.
            episodes: number of episodes of an evaluation.

        Raises:
            ValueError: the environment has cameras, or too little memory for the evaluation.
        """
        self.recipe, self.episodes, self.compile_seconds = recipe, episodes, 0.0
        self.mesh = sharding.make_mesh(1, jax.devices()[:1])
        self.env, self.practice_env = recipe.env(), recipe.env(practice=True)
        if self.env.vision:
            raise UserError(f"{recipe.task} has images, which --library rllib does not take; train without vision")
        check_episodes(self.env, episodes)
        check_stop_at(recipe.stop_at, self.env.task.success is not None, episodes)
        self.metrics = sorted((*_SIMULATED, *_LEARNED, "action_std", "learning_rate", "nonfinite_gradients"))
        self._agents = [f"drone_{i}" for i in range(self.env.drones)]
        self._algorithm: Any = None

    def compile(self) -> None:
        """Start ray, and compile the simulation."""
        start = time.perf_counter()
        start_ray()
        state = self.start(jax.random.key(0))
        self.evaluate = compile_evaluation(self.env, state.policy, self.episodes)
        self._algorithm.env_runner.sample()
        self.compile_seconds = time.perf_counter() - start

    def prepare(self, run: Run) -> None:
        """Make the folder of a run and check that its files can be written.

        Raises:
            OSError: they cannot be written.
        """
        env, hidden_sizes = self.env, self.recipe.config.hidden_sizes
        policy = jax.eval_shape(lambda key: Policy.init(key, env, hidden_sizes, per_agent=True), jax.random.key(0))
        run.prepare(_DISK_FACTOR * size_of(policy))

    def start(self, key: jax.Array) -> TrainState:
        """The state before the first update."""
        if self._algorithm is not None:
            self._algorithm.stop()
        seed = int(jax.random.bits(key, dtype="uint32")) % 2**31
        self._algorithm = build(self.practice_env, self.recipe.config, seed)
        return self._state()

    def advance(self, state: TrainState, updates: int) -> tuple[TrainState, dict[str, np.ndarray]]:
        """Make updates: the state after them, and (updates,) of every metric."""
        with one_torch_thread():
            rows = [self._metrics(self._algorithm.train()) for _ in range(updates)]
        return self._state(), {name: np.array([row[name] for row in rows]) for name in self.metrics}

    def save(self, run: Run, state: TrainState, **about: Any) -> None:
        """Write a checkpoint of RLlib, from which its `Algorithm.from_checkpoint` continues."""
        self._algorithm.save_to_path((run.folder / RLLIB_CHECKPOINT).absolute())

    @property
    def _learner(self) -> AdaptiveLearner:
        return self._algorithm.learner_group._learner

    def _modules(self) -> list[CentralizedCriticModule]:
        return [self._learner.module[agent].unwrapped() for agent in self._agents]

    def _state(self) -> TrainState:
        return TrainState(policy_of(self._modules(), self._algorithm.env_runner.obs_stats))

    def _metrics(self, result: dict[str, Any]) -> dict[str, float]:
        """The metrics of an update; those of the learner are means over the drones."""
        learned = [result["learners"][agent] for agent in self._agents]
        metrics = {name: float(result["env_runners"][name]) for name in _SIMULATED}
        metrics |= {name: float(np.mean([x[key] for x in learned])) for name, key in _LEARNED.items()}
        metrics["learning_rate"] = float(np.mean([self._learner.learning_rate(agent) for agent in self._agents]))
        log_std = [module.log_std.detach().numpy() for module in self._modules()]
        nonfinite, self._learner.nonfinite_gradients = float(self._learner.nonfinite_gradients), 0
        return metrics | {"action_std": float(np.mean(np.exp(log_std))), "nonfinite_gradients": nonfinite}
