"""Training by Stable-Baselines3: progress, evaluations, the best model."""

from __future__ import annotations

import contextlib
import math
import time

import jax
import numpy as np

from jaxdrones.adapters.sb3 import VecEnv
from jaxdrones.learning.evaluation import Report, check_episodes, evaluate
from jaxdrones.training.loop import CHOICE, REPORT, Diverged, Tell
from jaxdrones.training.runs import Progress, as_dict
from jaxdrones.training.sb3 import Actor, Recipe, Run

# isort: split
import torch
from stable_baselines3.common.callbacks import BaseCallback

_EVALUATIONS = 20  # in the course of training
_PROBE = 6  # times the size of the model that must fit on the disk: two checkpoints, each with Adam's moments


class Trainer:
    """A recipe's worlds, compiled, and SB3's model of them."""

    def __init__(self, recipe: Recipe, seed: int = 0, episodes: int = 100):
        """Prepare and compile.

        Args:
            recipe: what to train.
            seed: of all that is random.
            episodes: of an evaluation.

        Raises:
            ValueError: settings that SB3 refuses.
        """
        self.recipe, self.seed, self.episodes = recipe, seed, episodes
        start = time.perf_counter()
        self.env = recipe.env()
        check_episodes(self.env, episodes)
        self.worlds = VecEnv(self.env, recipe.config["worlds"])
        self.model = recipe.model(self.worlds, seed)
        self.worlds.reset()
        self.worlds.step(np.zeros((self.worlds.num_envs, *self.worlds.action_space.shape), np.float32))
        self.worlds.seed(seed)
        self.compile_seconds = time.perf_counter() - start

    def prepare(self, run: Run) -> None:
        """See that a run can be written.

        Raises:
            OSError: it cannot.
        """
        run.prepare(_PROBE * sum(x.nbytes for x in self.model.policy.parameters()))

    def train(self, run: Run, tell: Tell, deadline: float | None = None) -> None:
        """Train to the end, and evaluate the best model.

        Args:
            run: a folder that was prepared.
            tell: progress, by control steps.
            deadline: when to stop, s of `time.perf_counter`; else after the `steps` of the recipe.

        Raises:
            Diverged: numbers that are not finite; the best model so far is kept.
            KeyboardInterrupt: as it came; the newest model is saved.
        """
        steps = self.recipe.config["steps"] if deadline is None else np.iinfo(np.int64).max
        with _one_thread(), Progress(run, _COLUMNS, 0) as progress:
            course = _Course(self, run, tell, progress, deadline)
            try:
                self.model.learn(steps, callback=course)
            except KeyboardInterrupt:
                course.save()
                raise
            except ValueError as error:  # torch's of a distribution, or the environment's of an action
                raise Diverged(f"numbers that are not finite at update {course.update}, or shortly before") from error
            course.finish()


@contextlib.contextmanager
def _one_thread():
    """Of torch: with batches this small, more of them wait for each other and for JAX's."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


_COLUMNS = ["update", "steps", "seconds", "reward", "success", "evaluated_return", "evaluated_error"]


class _Course(BaseCallback):
    """One training: where it is, and what it has come to."""

    def __init__(self, trainer: Trainer, run: Run, tell: Tell, progress: Progress, deadline: float | None):
        super().__init__()
        self.trainer, self.run, self.tell, self.progress, self.deadline = trainer, run, tell, progress, deadline
        self.about = {"recipe": trainer.recipe.as_dict(), "seed": trainer.seed, "episodes": trainer.episodes}
        self.choice, self.report = (jax.random.fold_in(jax.random.key(trainer.seed), x) for x in (CHOICE, REPORT))
        self.best: float | None = None  # score
        self.update = 0
        self.due = 0.0  # share of the budget, of the next evaluation
        self.evaluating = 0.0  # s
        self.reward, self.counted = 0.0, 0  # sum since the last evaluation, and of how many steps
        self.begun = time.perf_counter()

    def _on_rollout_start(self) -> None:
        """The model is as the last update left it."""
        if self._share() >= self.due:
            self.judge()

    def _on_step(self) -> bool:
        self.reward += float(self.locals["rewards"].sum())
        self.counted += self.trainer.worlds.num_envs * self.trainer.env.drones
        return self.deadline is None or self.update == 0 or self._share() < 1

    def _on_rollout_end(self) -> None:
        self.update += 1
        self.tell(self.num_timesteps, self._now())

    def _on_training_end(self) -> None:
        self.judge()
        self.save()

    def judge(self) -> None:
        """Evaluate the model, always on the same episodes; keep it if its return is the best, as the paper does."""
        self.due = self._share() + 1 / _EVALUATIONS
        now = self._now()
        report = self._evaluate(Actor.of(self.model), self.choice)
        score = report.returned if math.isfinite(report.returned) else -math.inf
        if self.best is None or score > self.best:
            self.best = score
            self.run.save_model("best", self.model, **self.about, update=self.update, score=score)
        now |= {"success": report.success, "evaluated_return": report.returned}
        now |= {"evaluated_error": report.error_percentiles[50]}
        steps = self.num_timesteps * self.trainer.env.drones
        self.progress.add([{"update": self.update, "steps": steps} | {k: now[k] for k in _COLUMNS if k in now}])
        self.reward, self.counted = 0.0, 0
        self.tell(self.num_timesteps, now)

    def save(self) -> None:
        """Write the newest model."""
        self.run.save_model("last", self.model, **self.about, update=self.update)

    def finish(self) -> None:
        """Evaluate the best model on other episodes than it was chosen by, and write the report."""
        seconds = {"training": self._seconds(), "compiling": self.trainer.compile_seconds}
        report = self._evaluate(self.run.policy(), self.report)
        self.run.save_report(
            self.about
            | {"best_update": self.run.about()["update"], "updates": self.update, "steps": self.num_timesteps}
            | {"seconds": seconds | {"evaluating": self.evaluating}, "evaluation": as_dict(report)}
        )

    def _share(self) -> float:
        """Of the budget that is spent."""
        if self.deadline is not None:
            return (time.perf_counter() - self.begun) / max(self.deadline - self.begun, 1e-9)
        return self.num_timesteps / self.trainer.recipe.config["steps"]

    def _seconds(self) -> float:
        """Of training alone."""
        return time.perf_counter() - self.begun - self.evaluating

    def _now(self) -> dict[str, float]:
        seconds = self._seconds()
        steps = self.num_timesteps * self.trainer.env.drones
        reward = self.reward / self.counted if self.counted else math.nan
        return {"seconds": seconds, "steps_per_s": steps / seconds, "reward": reward}

    def _evaluate(self, actor: Actor, key: jax.Array) -> Report:
        start = time.perf_counter()
        report = evaluate(self.trainer.env, actor, key, self.trainer.episodes)
        self.evaluating += time.perf_counter() - start
        return report
