"""Training loop of one seed: updates, progress, evaluations, checkpoints, and resumption."""

import dataclasses
import math
import secrets
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from jaxdrones.errors import UserError
from jaxdrones.learning import sharding
from jaxdrones.learning.evaluation import Report, Score, score_of
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.result import MAX_CALL, PATIENCE, SMALLER, Callback, Diverged, check_gradients
from jaxdrones.limits import LARGEST_COUNT
from jaxdrones.training import distributed
from jaxdrones.training.plan import (
    EVALUATIONS,
    IN_A_ROW,
    REPORT_STREAM,
    SELECTION_STREAM,
    STOPPING_EVALUATIONS,
    TimePlan,
    best_of,
    next_evaluation,
)
from jaxdrones.training.run import Progress, Run, report_as_dict
from jaxdrones.training.trainer import Trainer

_CALL_SECONDS = 0.3  # target duration of a call of the compiled program, which delays Ctrl-C
_SAVE_SECONDS = 30.0  # longest time between training states on disk
_EVALUATED = ("success", "evaluated_return", "evaluated_error")

OnProgress = Callable[[int, dict[str, float]], None]
"""(number of updates, newest metrics) -> None: displays progress."""


def train(
    trainer: Trainer,
    run: Run,
    seed: int,
    on_progress: OnProgress,
    deadline: float | None = None,
    loggers: Sequence[Callback] = (),
    keep_history: bool = False,
) -> None:
    """Train one seed to the end, from the start or from the state of the run; evaluate the best policy.

    The folder of the run is prepared. The deadline is the end of the training, s on the clock of `time.perf_counter`;
    the number of updates then follows from the measured durations of updates and evaluations, and is at least one more.
    Loggers are called with the metrics of every update. With `keep_history`, or if the
    run has a history, the policies of all evaluations are kept.

    Raises:
        Diverged: parameters, or the gradients of `PATIENCE` updates in a row, are not finite; the best policy so
            far is kept.
        KeyboardInterrupt: re-raised after saving the state, unless there are other hosts.
    """
    recipe = trainer.recipe
    try:
        loop = _Loop(trainer, run, seed, deadline, keep_history)
        run.remove_report()
        try:
            loop.run_updates(on_progress, loggers)
        except KeyboardInterrupt:
            if jax.process_count() == 1:
                loop.save()
            raise
        loop.finish()
    finally:
        trainer.recipe = recipe  # with the number of updates set by a deadline or a success rate


def check_resumable(trainer: Trainer, run: Run) -> None:
    """Check that training can continue from the files of a run."""
    _load(trainer, run)
    run.history()


def _load(trainer: Trainer, run: Run) -> Any:
    state = run.load_state(trainer.shapes)
    if not _is_finite(state):
        raise UserError(f"{run.folder / 'state'} holds numbers that are not finite; train again with --overwrite")
    run.policy("best", trainer.env)
    return state


class _Loop:
    """State and results of the training of one seed."""

    def __init__(self, trainer: Trainer, run: Run, seed: int, deadline: float | None, keep_history: bool):
        self.trainer, self.run, self.seed = trainer, run, seed
        self.keeps_history = keep_history or bool(run.kept)
        self.key = jax.random.key(seed)
        self.evaluation_seconds, self.last_evaluation_seconds = 0.0, 0.0
        self.nonfinite_streak = 0  # latest consecutive updates with numbers that are not finite
        self.best: Score | None = None
        self.highest_success = 0.0
        self.reached = 0  # latest consecutive evaluations with the success rate to stop at
        self.seconds, self.update = 0.0, 0
        self.first: list[dict[str, float]] = []  # row of progress of the untrained policy
        self.plan: TimePlan | None = None
        if run.started:
            self.state = sharding.shard_state(trainer.mesh, _load(trainer, run))
            self.update = int(self.state.step)
            about, best = run.sidecar("state"), run.sidecar_entry("best", "score")
            self.id, self.seconds = about["run_id"], about["seconds"]
            same_rate = about["recipe"]["stop_at"] == trainer.recipe.stop_at
            self.reached = about["reached"] if same_rate else 0
            self.best, self.highest_success = (best[0], best[1]), max(best[0], about["highest_success"])
            self.last_evaluation_seconds = about["evaluation_seconds"]
            self.evaluation_seconds = about.get("evaluating", 0.0)
        else:
            self.id, self.state = secrets.token_hex(8), trainer.start(self.key)
            results = self.evaluate(self.state.policy, 0)
            self.first = [{"update": 0, "steps": 0, "seconds": 0.0, **results}]
        self.saved_reached = self.reached  # by evaluations up to that of `state`
        if deadline is not None:
            self.plan = TimePlan(deadline, self.update, self._evaluations, self.last_evaluation_seconds)
            self._set_updates(max(self.updates, self.update + 1))  # until an update was timed

    def run_updates(self, on_progress: OnProgress, loggers: Sequence[Callback]) -> None:
        saved, length = self.seconds, 1
        begin = self.update if not self.first else None
        with Progress(self.run, self._columns(), begin, loggers) as progress:
            progress.add(self.first)
            self.save()
            for row in self.first:
                on_progress(0, row)
            while self.update < self.updates:
                length = min(length, self._next_evaluation() - self.update, MAX_CALL)
                state, rows, seconds = self.advance(length)
                self.seconds += seconds
                update = self.update + length
                if self.plan is not None:
                    self.plan.add_updates(length, seconds)
                    self._set_updates(self.plan.updates(update))
                evaluated = update == self.updates or update >= self._next_evaluation()
                if evaluated:
                    rows[-1] |= self.evaluate(state.policy, update)
                    if self.nonfinite_streak and not math.isfinite(rows[-1]["evaluated_return"]):
                        raise _diverged("the return of an evaluation is not finite", update)
                    if self.reached >= IN_A_ROW:
                        self._set_updates(update)
                    elif self.plan is not None:
                        self._set_updates(self.plan.updates(update))
                progress.add(rows)
                self.state, self.update, self.saved_reached = state, update, self.reached
                if evaluated or self.seconds - saved > _SAVE_SECONDS:
                    progress.synchronize()
                    self.save()
                    saved = self.seconds
                on_progress(self.update, rows[-1] | {"steps_per_s": length * self._steps / seconds})
                length = max(1, round(_CALL_SECONDS / seconds * length))

    def advance(self, length: int) -> tuple[Any, list[dict[str, float]], float]:
        """State after some more updates, a row of progress for each, and their duration, s."""
        start = time.perf_counter()
        state, metrics = self.trainer.advance(self.state, length)
        seconds = distributed.from_first_host(time.perf_counter() - start)
        bad = [~np.isfinite(x) for name, x in metrics.items() if name != "return"]  # NaN until an episode has ended
        nonfinite = metrics["nonfinite_gradients"] + np.any(bad, axis=0)
        self.nonfinite_streak = check_gradients(
            nonfinite, min(PATIENCE, self.updates), self.nonfinite_streak, self.update
        )
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
        """Evaluate a policy in a fixed set of episodes, and save it if it is the best."""
        policy = sharding.gather(self.trainer.mesh, policy)
        report = self._evaluate(policy, SELECTION_STREAM)
        score = score_of(report.success, report.mean_return)
        self.highest_success = max(self.highest_success, score[0])
        stop_at = self.trainer.recipe.stop_at
        self.reached = self.reached + 1 if stop_at is not None and report.success_lower_bound >= stop_at else 0
        if self.best is None or best_of([self.best, score], self.trainer.episodes, self.highest_success) == 1:
            self.best = score
            about = self._about(update) | {"distinct_episodes": report.distinct_episodes, "score": score}
            self.run.save_policy("best", policy, **about)
        if self.plan is not None:
            self.plan.add_evaluation(update, self.last_evaluation_seconds)
        values = (report.success, report.mean_return, report.final_error_percentiles[50])
        results = {name: x for name, x in zip(_EVALUATED, values, strict=True) if x is not None}
        if self.keeps_history:
            self.run.keep_policy(policy, **self._about(update), evaluation=results)
        return results

    def save(self) -> None:
        state = sharding.gather(self.trainer.mesh, self.state)
        about = self._about(self.update)
        self.run.save_policy("last", state.policy, **about)
        progress = {"seconds": self.seconds, "evaluation_seconds": self.last_evaluation_seconds}
        progress |= {"highest_success": self.highest_success, "reached": self.saved_reached}
        progress |= {"evaluating": self.evaluation_seconds}
        self.run.save_state(state, **about, **progress)

    def finish(self) -> None:
        """Evaluate the best policy in new episodes, and write the report."""
        report = self._evaluate(self.run.policy(), REPORT_STREAM)
        seconds = {
            "training": self.seconds,
            "compiling": self.trainer.compile_seconds,
            "evaluating": self.evaluation_seconds,
        }
        best_update, stopped = self.run.sidecar_entry("best", "update"), self.reached >= IN_A_ROW
        about = self._about(self.update) | {"best_update": best_update, "updates": self.update}
        about |= {"stopped_at_success": stopped, "seconds": seconds, "evaluation": report_as_dict(report)}
        self.run.save_report(about)

    @property
    def updates(self) -> int:
        return self.trainer.recipe.config.updates

    def _set_updates(self, updates: int) -> None:
        recipe = self.trainer.recipe
        config = dataclasses.replace(recipe.config, updates=min(updates, LARGEST_COUNT))
        self.trainer.recipe = dataclasses.replace(recipe, config=config)

    def _next_evaluation(self) -> int:
        if self.plan is not None:
            return self.plan.next_evaluation(self.updates, self.update)
        return next_evaluation(self.updates, self.update, self._evaluations)

    @property
    def _evaluations(self) -> int:
        return EVALUATIONS if self.trainer.recipe.stop_at is None else STOPPING_EVALUATIONS

    @property
    def _steps(self) -> int:
        """Control steps of an update, of all drones."""
        config = self.trainer.recipe.config
        return config.worlds * config.horizon * self.trainer.env.drones

    def _about(self, update: int) -> dict[str, Any]:
        """Metadata of the files of this training; `run_id` is a unique random number."""
        about = {"run_id": self.id, "recipe": self.trainer.recipe.as_dict(), "seed": self.seed}
        return about | {"episodes": self.trainer.episodes, "update": update}

    def _columns(self) -> list[str]:
        return ["update", "steps", "seconds", *self.trainer.metrics, *_EVALUATED]

    def _evaluate(self, policy: Policy, stream: int) -> Report:
        start = time.perf_counter()
        report = self.trainer.evaluate(policy, jax.random.fold_in(self.key, stream))
        self.last_evaluation_seconds = time.perf_counter() - start
        self.evaluation_seconds += self.last_evaluation_seconds
        return report


def _diverged(what: str, update: int) -> Diverged:
    return Diverged(f"{what} at update {update}; {SMALLER}")


def _is_finite(state: Any) -> bool:
    """Whether all parameters are finite. Worlds are ignored: divergence ends an episode."""
    trained = [getattr(state, name) for name in ("policy", "critic") if hasattr(state, name)]
    return all(np.isfinite(x).all() for x in jax.tree.leaves(trained))
