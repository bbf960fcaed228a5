"""Folders of training runs.

    best, last       policies: the best one in an evaluation, and the newest
    state            complete state of the training, to continue bit for bit
    progress.csv     a row for the untrained policy and for each update
    report.json      evaluation of the best policy, and duration of the training
    history/         policies of all evaluations, by their update, with `keep_history`

Each checkpoint is a .msgpack file with a .json sidecar. All contain the id of their training, and files of different
trainings in one folder are rejected.
"""

import contextlib
import csv
import dataclasses
import itertools
import json
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

import jax

from jaxdrones import writing
from jaxdrones.envs import Env
from jaxdrones.errors import UserError
from jaxdrones.learning import checkpoint, files
from jaxdrones.learning.evaluation import Report
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.policies import check_fits
from jaxdrones.training.recipe import Recipe

CHECKPOINTS = ("best", "last", "state")
_HISTORY = "history"


class Run:
    """Folder of the training of one seed."""

    def __init__(self, folder: str | os.PathLike):
        self.folder = Path(folder)

    @property
    def files(self) -> list[Path]:
        """Existing files of a run: checkpoints, progress, report, history."""
        names = [f"{name}.{suffix}" for name in (*CHECKPOINTS, *self.kept) for suffix in ("msgpack", "json")]
        whole = [self.folder / name for name in (*names, "progress.csv", "report.json")]
        candidates = (*whole, *map(writing.beside, whole))
        return [file for file in candidates if file.exists()]

    @property
    def kept(self) -> list[str]:
        """Names of the policies in the history, in the order of their updates."""
        return [f"{_HISTORY}/{file.stem}" for file in sorted((self.folder / _HISTORY).glob("*.json"))]

    def prepare(self, size: int) -> None:
        """Create the folder and check that `size` bytes can be written to it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        probe = self.folder / ".probe"
        try:
            probe.write_bytes(bytes(size))
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.folder)) from error
        finally:
            probe.unlink(missing_ok=True)

    def clear(self) -> None:
        """Remove the files of an earlier run."""
        for file in self.files:
            file.unlink()

    def sidecar(self, name: str = "best") -> dict[str, Any]:
        """Sidecar of the checkpoint `best`, `last` or `state`, of the same training as all readable files beside it."""
        own = files.read_sidecar(self.folder / name)
        for other in (*CHECKPOINTS, "report"):
            try:
                found = self._report() if other == "report" else files.read_sidecar(self.folder / other)
            except (FileNotFoundError, ValueError):
                continue  # damaged files are rejected at their use
            if found.get("run_id") != own.get("run_id"):
                raise UserError(
                    f"{self.folder / name}.json and {other}.json are of two trainings; restore the files of one, or "
                    "train again with --overwrite"
                )
        return own

    def sidecar_entry(self, name: str, entry: str) -> Any:
        """Entry of the sidecar of a checkpoint."""
        sidecar = self.sidecar(name)
        if entry not in sidecar:
            file = self.folder / f"{name}.json"
            raise UserError(f"{file} has no entry {entry}; it is not the {name} of a run of `jaxdrones train`")
        return sidecar[entry]

    def verify(self, name: str) -> None:
        """Check that a checkpoint is intact, and of the same training as the others."""
        files.load_bytes(self.folder / f"{name}.msgpack", self.sidecar(name))

    def recipe(self, name: str = "best") -> Recipe:
        """Recipe of the training."""
        return Recipe.from_dict(self.sidecar_entry(name, "recipe"))

    def policy(self, name: str = "best", env: Env | None = None) -> Policy:
        """Policy `best`, `last` or one of `kept`."""
        self.sidecar(name)  # is of this training
        policy = checkpoint.load(self.folder / name)
        if env is not None:
            check_fits(str(self.folder / name), policy, env)
        return policy

    @property
    def started(self) -> bool:
        """Whether there is a training state."""
        return (self.folder / "state.json").exists()

    @property
    def finished(self) -> bool:
        """Whether the training is complete."""
        return (self.folder / "report.json").exists()

    def save_policy(self, name: str, policy: Policy, **about: Any) -> None:
        """Write `best` or `last` with entries of its sidecar."""
        checkpoint.save(self.folder / name, policy, **about)

    def keep_policy(self, policy: Policy, **about: Any) -> None:
        """Write a policy to the history with entries of its sidecar, among them its `update`."""
        (self.folder / _HISTORY).mkdir(exist_ok=True)
        self.save_policy(f"{_HISTORY}/{about['update']:08}", policy, **about)

    def save_state(self, state: Any, **about: Any) -> None:
        """Write the training state with entries of its sidecar."""
        checkpoint.save_tree(self.folder / "state", state, **about)

    def load_state(self, like: Any) -> Any:
        """Training state; `like` is a tree with its shapes."""
        return checkpoint.load_tree(self.folder / "state", like)

    def save_report(self, report: dict[str, Any]) -> None:
        """Write report.json, which marks the run as finished."""
        writing.write(self.folder / "report.json", writing.as_json(report, indent=2).encode())

    def remove_report(self) -> None:
        """Mark the run as not finished."""
        (self.folder / "report.json").unlink(missing_ok=True)

    def report(self) -> dict[str, Any] | None:
        """Content of report.json; `None` for an unfinished run."""
        if not self.finished:
            return None
        report = self._report()
        if (self.folder / "best.json").exists():
            self.sidecar("best")  # is of this training
        return report

    def _report(self) -> dict[str, Any]:
        file = self.folder / "report.json"
        try:
            report = json.loads(file.read_bytes())
            if not isinstance(report, dict):
                raise UserError("it holds no JSON object")
            return report
        except (OSError, ValueError, RecursionError) as error:
            why = files.one_line(error)
            raise UserError(f"{file} cannot be read: {why}; remove it and --resume, which writes it anew") from error

    def history(self) -> list[dict[str, float]]:
        """Rows of progress.csv, each without the missing values of its update.

        A truncated last line, as left by a killed process, is ignored.
        """
        path = self.folder / "progress.csv"
        if not path.exists():
            return []
        try:
            whole = path.read_text().rpartition("\n")[0].splitlines()
            lines = [{name: x for name, x in row.items() if x not in ("", None)} for row in csv.DictReader(whole)]
            rows = [{name: float(x) for name, x in line.items()} for line in lines]
            if not all(math.isfinite(row.get("update", math.nan)) for row in rows):
                raise UserError("a row has no update")
        except (OSError, ValueError, TypeError, csv.Error) as error:
            why = files.one_line(error)
            raise UserError(f"{path} is damaged: {why}; remove it, training continues without its rows") from error
        return rows


class Progress(contextlib.AbstractContextManager["Progress"]):
    """Writer of progress.csv of a run, and of the same rows to loggers."""

    def __init__(
        self, run: Run, columns: Sequence[str], update: int | None, loggers: Sequence[Callable[..., Any]] = ()
    ):
        """Continue after an update, and drop the rows of later ones; begin with `None`."""
        rows = [row for row in run.history() if row["update"] <= update] if update is not None else []
        self._columns, self._loggers, path = columns, loggers, run.folder / "progress.csv"
        with writing.replaced(path) as new, new.open("w", newline="") as file:
            csv.DictWriter(file, columns).writeheader()
            self._write(file, rows)
        self._file = path.open("a", newline="")

    def add(self, rows: list[dict[str, float]]) -> None:
        """Write rows, each with at least `update`; NaN is written as an empty field."""
        rows = [{name: x for name, x in row.items() if not math.isnan(x)} for row in rows]
        self._write(self._file, rows)
        self._file.flush()
        for logger, row in itertools.product(self._loggers, rows):
            logger(int(row["update"]), {name: x for name, x in row.items() if name != "update"}, None)

    def synchronize(self) -> None:
        """Flush all rows to the disk."""
        os.fsync(self._file.fileno())

    def _write(self, file: IO[str], rows: list[dict[str, float]]) -> None:
        writer = csv.DictWriter(file, self._columns)
        for row in rows:
            writer.writerow(row | {name: int(row[name]) for name in ("update", "steps") if name in row})

    def __exit__(self, *_) -> None:
        self._file.close()


def report_as_dict(report: Report) -> dict[str, Any]:
    """Evaluation for JSON."""
    entries = {field.name: getattr(report, field.name) for field in dataclasses.fields(report)}
    entries |= {"successes": None if report.success is None else round(report.success * report.trials)}
    percentiles = {str(q): x for q, x in report.final_error_percentiles.items()}
    return entries | {"final_error_percentiles": percentiles}


def size_of(tree: Any) -> int:
    """Bytes of the arrays of a tree, or of its shapes."""
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))
