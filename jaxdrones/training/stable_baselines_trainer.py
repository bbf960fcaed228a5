"""The training loop around Stable-Baselines3: progress, evaluations, the best model."""

from __future__ import annotations

import math
import secrets
import time
from typing import Any

import jax
import numpy as np

from jaxdrones.adapters.sb3 import VecEnv
from jaxdrones.learning.evaluation import Report, check_episodes, compile_evaluation
from jaxdrones.learning.result import Diverged
from jaxdrones.training.loop import OnProgress
from jaxdrones.training.plan import IN_A_ROW, check_stop_at
from jaxdrones.training.progress import Progress
from jaxdrones.training.run import report_as_dict
from jaxdrones.training.selection import REPORT_STREAM, SELECTION_STREAM
from jaxdrones.training.stable_baselines import SB3Policy, SB3Recipe, SB3Run
from jaxdrones.training.torch_threads import one_torch_thread

# isort: split
from stable_baselines3.common.callbacks import BaseCallback

_EVALUATIONS = 20  # in the course of a training
_DISK_FACTOR = 6  # the disk must have space for two checkpoints, each with the moments of Adam
_COLUMNS = ["update", "steps", "seconds", "reward", "success", "evaluated_return", "evaluated_error"]


class SB3Trainer:
    """The compiled worlds of a recipe, and the model that is trained in them."""

    def __init__(self, recipe: SB3Recipe, seed: int = 0, episodes: int = 100):
        """Prepare and compile.

        Args:
            recipe: what to train.
            seed: seed of everything that is random.
            episodes: number of episodes of an evaluation.

        Raises:
            ValueError: Stable-Baselines3 refuses the settings, or no evaluation reaches the success rate to stop at.
        """
        self.recipe, self.seed, self.episodes = recipe, seed, episodes
        start = time.perf_counter()
        self.env = recipe.env()
        check_episodes(self.env, episodes)
        check_stop_at(recipe.stop_at, self.env.task.success is not None, episodes)
        self.worlds = VecEnv(self.env, recipe.config["worlds"])
        self.model = recipe.model(self.worlds, seed)
        self.worlds.reset()
        self.worlds.step(np.zeros((self.worlds.num_envs, *self.worlds.action_space.shape), np.float32))
        self.worlds.seed(seed)
        policy = SB3Policy.of(self.model.policy.state_dict(), recipe.algorithm)
        self.evaluate = compile_evaluation(self.env, policy, episodes)
        self.compile_seconds = time.perf_counter() - start

    def prepare(self, run: SB3Run) -> None:
        """Make the folder of a run and check that its files can be written.

        Raises:
            OSError: they cannot be written.
        """
        run.prepare(_DISK_FACTOR * sum(x.nbytes for x in self.model.policy.parameters()))

    def train(self, run: SB3Run, on_progress: OnProgress, deadline: float | None = None) -> None:
        """Train to the end, and evaluate the best model.

        Args:
            run: run whose folder was prepared.
            on_progress: function that shows progress, by control steps.
            deadline: time of `time.perf_counter` at which everything has to be written, s; when left out, training
                stops after the number of steps of the recipe.

        Raises:
            Diverged: parameters are not finite; the best model so far is kept.
            KeyboardInterrupt: passed on after the newest model was saved.
        """
        steps = self.recipe.config["steps"] if deadline is None else np.iinfo(np.int64).max
        with one_torch_thread(), Progress(run, _COLUMNS, 0) as progress:
            callback = _Callback(self, run, on_progress, progress, deadline)
            try:
                self.model.learn(steps, callback=callback)
            except KeyboardInterrupt:
                callback.save()
                raise
            except ValueError as error:  # raised by torch for a distribution, or by the environment for an action
                what = f"parameters are not finite at update {callback.update}"
                raise Diverged(f"{what}; try a smaller learning rate") from error
            callback.finish()


class _Callback(BaseCallback):
    """Evaluates, saves and reports while Stable-Baselines3 trains."""

    def __init__(
        self, trainer: SB3Trainer, run: SB3Run, on_progress: OnProgress, progress: Progress, deadline: float | None
    ):
        super().__init__()
        self.trainer, self.run, self.on_progress, self.progress, self.deadline = (
            trainer,
            run,
            on_progress,
            progress,
            deadline,
        )
        self.about: dict[str, Any] = {"run_id": secrets.token_hex(8), "recipe": trainer.recipe.as_dict()}
        self.about |= {"seed": trainer.seed, "episodes": trainer.episodes}
        key = jax.random.key(trainer.seed)
        self.selection_key, self.report_key = (jax.random.fold_in(key, x) for x in (SELECTION_STREAM, REPORT_STREAM))
        self.best: float | None = None  # return
        self.update, self.evaluated = 0, -1  # the last of each
        self.next_evaluation = 0.0  # fraction of the budget
        self.evaluation_seconds, self.last_evaluation_seconds = 0.0, 0.0
        self.reached = 0  # evaluations in a row, up to the newest, that reached the success rate to stop at
        self.reward_sum, self.reward_count = 0.0, 0  # since the last evaluation
        self.start = self.rollout_end = time.perf_counter()
        self.learning_seconds = 0.0  # of the last update, without its rollout

    def _on_rollout_start(self) -> None:
        """Evaluate between two updates, if an evaluation is due."""
        if self.update:
            self.learning_seconds = time.perf_counter() - self.rollout_end
        if self.next_evaluation <= self._spent() and (self.update == 0 or self._spent() < 1):
            self.evaluate()

    def _on_step(self) -> bool:
        self.reward_sum += float(self.locals["rewards"].sum())
        self.reward_count += self.trainer.worlds.num_envs * self.trainer.env.drones
        return self.reached < IN_A_ROW and (self.deadline is None or self.update == 0 or self._spent() < 1)

    def _on_rollout_end(self) -> None:
        self.update += 1
        self.rollout_end = time.perf_counter()
        self.on_progress(self.num_timesteps, self._metrics())

    def _on_training_end(self) -> None:
        if self.evaluated < self.update:
            self.evaluate()
        self.save()

    def evaluate(self) -> None:
        """Evaluate the model, always in the same episodes; save it if its return is the best, as in the paper."""
        self.evaluated = self.update
        metrics = self._metrics()
        policy = SB3Policy.of(self.model.policy.state_dict(), self.trainer.recipe.algorithm)
        report = self._evaluate(policy, self.selection_key)
        stop_at = self.trainer.recipe.stop_at
        self.reached = self.reached + 1 if stop_at is not None and report.success_lower_bound >= stop_at else 0
        score = report.mean_return if math.isfinite(report.mean_return) else -math.inf
        if self.best is None or score > self.best:
            self.best = score
            about = self.about | {"distinct_episodes": report.distinct_episodes, "update": self.update, "score": score}
            self.run.save_model("best", self.model, **about)
        metrics |= {} if report.success is None else {"success": report.success}
        metrics |= {"evaluated_return": report.mean_return}
        metrics |= {"evaluated_error": report.final_error_percentiles[50]}
        row = {"update": self.update, "steps": self.num_timesteps * self.trainer.env.drones}
        self.progress.add([row | {name: metrics[name] for name in _COLUMNS if name in metrics}])
        self.reward_sum, self.reward_count = 0.0, 0
        self.on_progress(self.num_timesteps, metrics)
        self.next_evaluation = self._spent() + self._interval()

    def save(self) -> None:
        """Write the newest model."""
        self.run.save_model("last", self.model, **self.about, update=self.update)

    def finish(self) -> None:
        """Evaluate the best model, in other episodes than those that chose it, and write the report."""
        seconds = {"training": self._seconds(), "compiling": self.trainer.compile_seconds}
        report = self._evaluate(self.run.policy(), self.report_key)
        self.run.save_report(
            self.about
            | {"best_update": self.run.sidecar()["update"], "updates": self.update, "steps": self.num_timesteps}
            | {"stopped_at_success": self.reached >= IN_A_ROW}
            | {"seconds": seconds | {"evaluating": self.evaluation_seconds}, "evaluation": report_as_dict(report)}
        )

    def _spent(self) -> float:
        """Fraction of the budget that is spent; of a time, one update, the last evaluation and the report are kept."""
        if self.deadline is None:
            return self.num_timesteps / self.trainer.recipe.config["steps"]
        return (time.perf_counter() - self.start) / max(self._time(), 1e-9)

    def _time(self) -> float:
        assert self.deadline is not None
        return self.deadline - self.start - self.learning_seconds - 2 * self.last_evaluation_seconds

    def _interval(self) -> float:
        """Fraction of the budget between two evaluations, which take at most a quarter of a time."""
        if self.deadline is None:
            return 1 / _EVALUATIONS
        return max(1 / _EVALUATIONS, 4 * self.last_evaluation_seconds / max(self._time(), 1e-9))

    def _seconds(self) -> float:
        """Seconds of training, without evaluations."""
        return time.perf_counter() - self.start - self.evaluation_seconds

    def _metrics(self) -> dict[str, float]:
        seconds = self._seconds()
        steps = self.num_timesteps * self.trainer.env.drones
        reward = self.reward_sum / self.reward_count if self.reward_count else math.nan
        return {"seconds": seconds, "steps_per_s": steps / seconds, "reward": reward}

    def _evaluate(self, policy: SB3Policy, key: jax.Array) -> Report:
        start = time.perf_counter()
        report = self.trainer.evaluate(policy, key)
        self.last_evaluation_seconds = time.perf_counter() - start
        self.evaluation_seconds += self.last_evaluation_seconds
        return report
