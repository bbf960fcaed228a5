"""The training loop of one seed: updates, progress, evaluations, checkpoints, and resuming from them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxdrones.errors import UserError
from jaxdrones.learning import sharding
from jaxdrones.learning.evaluation import Report, evaluate
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.result import PATIENCE, Diverged, check_gradients
from jaxdrones.training import distributed
from jaxdrones.training.progress import Progress
from jaxdrones.training.run import Run, report_as_dict
from jaxdrones.training.selection import REPORT_STREAM, SELECTION_STREAM, Score, best_of, score_of
from jaxdrones.training.trainer import MAX_CALL, BaseTrainer, Trainer

EVALUATIONS = 10
"""Number of evaluations in the course of a training."""
_CALL_SECONDS = 0.3  # aimed at for one call of the compiled program, during which Ctrl-C has to wait
_SAVE_SECONDS = 30.0  # longest time between two training states on disk
_EVALUATED = ("success", "evaluated_return", "evaluated_error")

OnProgress = Callable[[int, dict[str, float]], None]
"""(number of updates made, newest metrics) -> None: shows progress."""


def train(trainer: BaseTrainer, run: Run, seed: int, on_progress: OnProgress) -> None:
    """Train one seed to the end, from the start or from the state that the run holds; evaluate the best policy.

    Args:
        trainer: compiled programs.
        run: run whose folder was prepared.
        seed: seed of everything that is random.
        on_progress: function that shows progress.

    Raises:
        Diverged: parameters, or the gradients of `PATIENCE` updates in a row, are not finite; the best policy so far is
            kept.
        KeyboardInterrupt: passed on after the state was saved, unless other hosts would have to help.
    """
    loop = _Loop(trainer, run, seed)
    run.remove_report()
    loop.save()
    try:
        loop.run_updates(on_progress)
    except KeyboardInterrupt:
        if jax.process_count() == 1:
            loop.save()
        raise
    loop.finish()


def check_resumable(trainer: Trainer, run: Run) -> None:
    """Check that training can continue from the files of a run.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is damaged, or the files belong to different runs.
    """
    _load(trainer, run)
    run.history()


def _load(trainer: Trainer, run: Run) -> tuple[Any, float, Score, float]:
    """State, seconds of training, score of the best policy and highest success rate of a run."""
    state = run.load_state(trainer.shapes)
    if not _is_finite(state):
        raise UserError(f"{run.folder / 'state'} holds numbers that are not finite; train anew with --overwrite")
    run.policy("best", trainer.env)
    for entry in ("seed", "episodes"):
        if run.sidecar_entry("best", entry) != run.sidecar_entry("state", entry):
            raise _different_runs(run)
    if _without_updates(run.sidecar_entry("best", "recipe")) != _without_updates(run.sidecar_entry("state", "recipe")):
        raise _different_runs(run)
    score = tuple(run.sidecar_entry("best", "score"))
    highest_success = max(score[0], run.sidecar_entry("state", "highest_success"))
    return state, run.sidecar_entry("state", "seconds"), score, highest_success


class _Loop:
    """The training of one seed: its state, and the results so far."""

    def __init__(self, trainer: BaseTrainer, run: Run, seed: int):
        """Start a training, or continue the one that the run holds."""
        self.trainer, self.run, self.config = trainer, run, trainer.recipe.config
        self.key = jax.random.key(seed)
        self.about = {"recipe": trainer.recipe.as_dict(), "seed": seed, "episodes": trainer.episodes}
        self.evaluation_seconds = 0.0
        self.nonfinite_streak = 0  # updates in a row, up to the newest, with numbers that were not finite
        self.best: Score | None = None
        self.highest_success = 0.0
        if run.started:
            assert isinstance(trainer, Trainer)
            state, self.seconds, self.best, self.highest_success = _load(trainer, run)
            self.state = sharding.shard_state(trainer.mesh, state)
            self.update = int(self.state.step)
        else:
            self.state, self.seconds, self.update = trainer.start(self.key), 0.0, 0
            self.evaluate(self.state.policy, 0)

    def run_updates(self, on_progress: OnProgress) -> None:
        """Make all updates that remain."""
        updates, saved, length = self.config.updates, self.seconds, 1
        evaluations = {updates * (i + 1) // EVALUATIONS for i in range(EVALUATIONS)}
        with Progress(self.run, self._columns(), self.update) as progress:
            while self.update < updates:
                next_evaluation = min(update for update in evaluations if update > self.update)
                length = min(length, next_evaluation - self.update, MAX_CALL)
                state, rows, seconds = self.advance(length)
                self.seconds += seconds
                if self.update + length in evaluations:
                    rows[-1] |= self.evaluate(state.policy, self.update + length)
                    if self.nonfinite_streak and not math.isfinite(rows[-1]["evaluated_return"]):
                        raise _diverged("the return of an evaluation is not finite", self.update + length)
                progress.add(rows)
                self.state, self.update = state, self.update + length
                if self.update in evaluations or self.seconds - saved > _SAVE_SECONDS:
                    self.save()
                    saved = self.seconds
                on_progress(self.update, rows[-1] | {"steps_per_s": length * self._steps / seconds})
                length = max(1, round(_CALL_SECONDS / seconds * length))

    def advance(self, length: int) -> tuple[Any, list[dict[str, float]], float]:
        """The state after some more updates, a row of progress for each, and the seconds that they took.

        Raises:
            Diverged: parameters are not finite, or too many updates in a row had numbers that were not finite.
        """
        start = time.perf_counter()
        state, metrics = self.trainer.advance(self.state, length)
        seconds = distributed.from_first_host(time.perf_counter() - start)
        nonfinite = metrics["nonfinite_gradients"] + np.any([~np.isfinite(x) for x in metrics.values()], axis=0)
        self.nonfinite_streak = check_gradients(nonfinite, min(PATIENCE, self.config.updates), self.nonfinite_streak)
        if not _is_finite(state):
            raise _diverged("parameters are not finite", self.update + length)
        rows = [
            {
                "update": self.update + i,
                "steps": (self.update + i) * self._steps,
                "seconds": self.seconds + seconds * i / length,
                **{name: float(x[i - 1]) for name, x in metrics.items()},
            }
            for i in range(1, length + 1)
        ]
        return state, rows, seconds

    def evaluate(self, policy: Policy, update: int) -> dict[str, float]:
        """Evaluate a policy, always in the same episodes, and save it if it is the best."""
        policy = sharding.gather(self.trainer.mesh, policy)
        report = self._evaluate(policy, SELECTION_STREAM)
        score = score_of(report.success, report.mean_return)
        self.highest_success = max(self.highest_success, report.success)
        if self.best is None or best_of([self.best, score], self.trainer.episodes, self.highest_success) == 1:
            self.best = score
            self.run.save_policy("best", policy, **self.about, update=update, score=score)
        results = (report.success, report.mean_return, report.final_error_percentiles[50])
        return dict(zip(_EVALUATED, results, strict=True))

    def save(self) -> None:
        """Write the newest policy and the training state."""
        state = sharding.gather(self.trainer.mesh, self.state)
        about = self.about | {"update": self.update}
        self.run.save_policy("last", state.policy, **about)
        self.trainer.save(self.run, state, **about, seconds=self.seconds, highest_success=self.highest_success)

    def finish(self) -> None:
        """Evaluate the best policy, in other episodes than those that chose it, and write the report."""
        report = self._evaluate(self.run.policy(), REPORT_STREAM)
        seconds = {
            "training": self.seconds,
            "compiling": self.trainer.compile_seconds,
            "evaluating": self.evaluation_seconds,
        }
        self.run.save_report(
            self.about
            | {"best_update": self.run.sidecar_entry("best", "update"), "updates": self.update, "seconds": seconds}
            | {"evaluation": report_as_dict(report)}
        )

    @property
    def _steps(self) -> int:
        """Control steps of an update, of all drones."""
        return self.config.worlds * self.config.horizon * self.trainer.env.drones

    def _columns(self) -> list[str]:
        return ["update", "steps", "seconds", *self.trainer.metrics, *_EVALUATED]

    def _evaluate(self, policy: Policy, stream: int) -> Report:
        start = time.perf_counter()
        report = evaluate(self.trainer.env, policy, jax.random.fold_in(self.key, stream), self.trainer.episodes)
        self.evaluation_seconds += time.perf_counter() - start
        return report


def _without_updates(recipe: dict) -> dict:
    """A recipe without the number of updates, which a longer training changes."""
    return recipe | {"config": recipe["config"] | {"updates": None}}


def _different_runs(run: Run) -> ValueError:
    return UserError(
        f"{run.folder}: best.json and state.json are of two runs; restore the files of one, or train anew with "
        "--overwrite"
    )


def _diverged(what: str, update: int) -> Diverged:
    return Diverged(f"{what} at update {update}; try a smaller learning rate")


def _is_finite(state: Any) -> bool:
    """Whether all parameters are finite. Worlds do not count: one that diverges ends its episode."""
    trained = [getattr(state, name) for name in ("policy", "critic") if hasattr(state, name)]
    return all(np.isfinite(x).all() for x in jax.tree.leaves(trained))
