"""Callbacks of `train`: loggers for CSV, TensorBoard, Weights & Biases and MLflow, and `KeepBest`.

A logger is a function `(update, metrics, state)`, with the number of updates so far.
"""

import contextlib
import csv
import importlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from jaxdrones import writing
from jaxdrones.arguments import Count, Key, checked
from jaxdrones.envs import Env
from jaxdrones.errors import UserError
from jaxdrones.learning.evaluation import Report, Score, compile_evaluation, score_of
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.settings import check_environment


class CSV:
    """Log to a CSV file: a row per update, with the columns `update` and the metrics of the first update.

    A training that continues from a state keeps the rows of earlier updates in the file.
    """

    def __init__(self, path: str | os.PathLike):
        self._path = Path(path)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._columns: list[str] = []

    def __call__(self, update: int, metrics: dict[str, float], state: Any = None) -> None:
        """Append the metrics of an update."""
        row = {"update": update} | metrics
        if not self._columns:
            self._columns = list(row)
            earlier = self._rows_before(update)
            with writing.replaced(self._path) as new, new.open("w", newline="") as file:
                csv.writer(file).writerows([self._columns, *earlier])
        with self._path.open("a", newline="") as file:
            csv.writer(file).writerow([row.get(name, "") for name in self._columns])

    def _rows_before(self, update: int) -> list[list[str]]:
        """Rows of the file of updates before this one, without a truncated last line, as left by a killed process."""
        if update <= 1 or not self._path.exists():
            return []
        lines = self._path.read_text().rpartition("\n")[0].splitlines()
        columns, *rows = [*csv.reader(lines)] or [[]]
        if columns != self._columns:
            raise UserError(f"{self._path} has the columns {', '.join(columns) or 'of no log'}; give another file")
        return [row for row in rows if row and row[0].isdecimal() and int(row[0]) < update]


class TensorBoard:
    """Log scalars to an event file of TensorBoard in a folder, by tensorboardX."""

    def __init__(self, folder: str | os.PathLike):
        self._writer = _library("tensorboardX").SummaryWriter(str(folder))

    def __call__(self, update: int, metrics: dict[str, float], state: Any = None) -> None:
        """Log the metrics of an update."""
        for name, value in metrics.items():
            self._writer.add_scalar(name, value, update)
        self._writer.flush()

    def close(self) -> None:
        """Close the file."""
        self._writer.close()


class WandB:
    """Log to Weights & Biases; the keyword arguments are those of `wandb.init`.

    Close it before the next training, which otherwise logs into the same run.
    """

    def __init__(self, **options: Any):
        self.run = _library("wandb").init(**options)

    def __call__(self, update: int, metrics: dict[str, float], state: Any = None) -> None:
        """Log the metrics of an update."""
        self.run.log(metrics, step=update)

    def close(self) -> None:
        """Finish the run."""
        self.run.finish()


class MLflow:
    """Log to MLflow; the keyword arguments are those of `mlflow.start_run`.

    Close it before the next training, as MLflow refuses a second active run.
    """

    def __init__(self, **options: Any):
        self._mlflow = _library("mlflow")
        self.run = self._mlflow.start_run(**options)

    def __call__(self, update: int, metrics: dict[str, float], state: Any = None) -> None:
        """Log the metrics of an update."""
        self._mlflow.log_metrics(metrics, step=update, run_id=self.run.info.run_id)

    def close(self) -> None:
        """End the run."""
        self._mlflow.end_run()


class KeepBest:
    """Evaluate the policy periodically and keep the best one, by success and then by return."""

    policy: Policy | None = None
    """Best policy so far; `None` before the first evaluation."""
    report: Report | None = None
    """Evaluation of that policy."""

    @checked
    def __init__(self, env: Env, key: Key, every: Count = 20, episodes: Count = 200):
        """Evaluate in `env` after `every` updates, always on the same `episodes`, which depend on `key`."""
        check_environment(env)
        self._env, self._key, self._every, self._episodes = env, key, every, episodes
        self._evaluate: Any = None
        self._score: Score | None = None

    def __call__(self, update: int, metrics: dict[str, float], state: Any) -> None:
        """Evaluate the policy of a training state if an evaluation is due."""
        if update % self._every:
            return
        if self._evaluate is None:
            self._evaluate = compile_evaluation(self._env, state.policy, self._episodes)
        report = self._evaluate(state.policy, self._key)
        score = score_of(report.success, report.mean_return)
        if self._score is None or score > self._score:
            self.policy, self.report, self._score = state.policy, report, score


_NAMED: dict[str, Callable[[Path], Any]] = {
    "tensorboard": TensorBoard,
    "wandb": lambda folder: WandB(project="jaxdrones", name=str(folder)),
    "mlflow": lambda folder: MLflow(run_name=str(folder)),
}


_LIBRARIES = {"tensorboard": "tensorboardX", "wandb": "wandb", "mlflow": "mlflow"}


def logger_names(names: str | None) -> list[str]:
    """The names in a text such as `tensorboard,wandb`, whose libraries are installed; none for `None`."""
    wanted = names.split(",") if names else []
    for name in wanted:
        if name not in _NAMED:
            raise UserError(f"--log is {names!r}; give names of {', '.join(_NAMED)}, for example --log tensorboard")
    for name in wanted:
        _library(_LIBRARIES[name])
    return wanted


@contextlib.contextmanager
def named_loggers(names: str | None, folder: Path) -> Iterator[list[Any]]:
    """Context of the loggers of a run, for names as of `logger_names`; `folder` is that of the run.

    They are closed at its end: W&B and MLflow have one active run at a time.
    """
    with contextlib.ExitStack() as stack:
        yield [stack.enter_context(contextlib.closing(_NAMED[name](folder))) for name in logger_names(names)]


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise UserError(f"{name} is not installed; run: pip install {name}") from error
