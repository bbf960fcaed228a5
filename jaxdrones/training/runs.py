"""A training run as a folder: what is trained and how, checkpoints, progress.

    best, last       policies: the one that did best in an evaluation, and the newest
    state            all that training needs to go on, bit for bit
    progress.csv     a line per update; the same as an event file for TensorBoard
    report.json      how the best policy flies, and what it took

Each checkpoint is a .msgpack and a .json that says what it is.
"""

from __future__ import annotations

import csv
import dataclasses
import inspect
import json
import math
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

import jax

from jaxdrones.checks import check_choice
from jaxdrones.envs import TASKS, Env, make
from jaxdrones.learning import checkpoint
from jaxdrones.learning.evaluation import Report
from jaxdrones.learning.networks import Policy
from jaxdrones.limits import LARGEST_COUNT, check_at_most, check_memory
from jaxdrones.training.events import PREFIX, EventFile
from jaxdrones.training.presets import ALGORITHMS, preset

_DRONE_BYTES = 256  # of its parameters and state


@dataclasses.dataclass(frozen=True)
class Recipe:
    """What is trained, on what, with which settings."""

    task: str
    algorithm: str
    realistic: bool
    options: dict[str, Any]
    """Of `jaxdrones.make`."""
    config: Any
    """Settings of the learner."""

    @classmethod
    def of(cls, task: str, algorithm: str = "bptt", realistic: bool = False, **changes) -> Recipe:
        """A preset with changes.

        Args:
            task: a name of `jaxdrones.envs.TASKS`.
            algorithm: bptt, ppo or shac.
            realistic: see `preset`.
            **changes: settings of the learner (worlds, horizon, ...), and options of `jaxdrones.make` (period, ...).

        Raises:
            ValueError: an unknown name, or a value of the wrong kind.
        """
        check_choice("task", task, TASKS)
        check_choice("algorithm", algorithm, ALGORITHMS)
        fields = dataclasses.fields(ALGORITHMS[algorithm].Config)
        known = {field.name for field in fields if field.default is not None}  # a function has no place in JSON
        options, settings = divided(task, changes, known)
        _, config = fitting_preset(task, algorithm, realistic, options)
        settings = {name: checked(name, x, getattr(config, name)) for name, x in settings.items()}
        config = dataclasses.replace(config, **settings)
        for name in ("updates", "worlds", "horizon"):
            check_at_most(name, getattr(config, name), LARGEST_COUNT)
        return cls(task, algorithm, realistic, options, config)

    @property
    def learner(self) -> str:
        """The algorithm and, where that is another, its library."""
        return self.algorithm

    def env(self, practice: bool = False, **options) -> Env:
        """The environment to fly or to learn in; options of `jaxdrones.make` replace those of the recipe."""
        return preset(self.task, self.algorithm, self.realistic, practice, **self.options | options)[0]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        plain = {name: x for name, x in dataclasses.asdict(self.config).items() if x is not None}
        return dataclasses.asdict(self) | {"config": plain}

    @classmethod
    def from_dict(cls, kept: dict[str, Any]) -> Recipe:
        """What `as_dict` gave.

        Raises:
            ValueError: it is of another version of this library, or damaged.
        """
        try:
            check_choice("task", kept["task"], TASKS)
            check_choice("algorithm", kept["algorithm"], ALGORITHMS)
            config = {name: tuple(x) if isinstance(x, list) else x for name, x in kept["config"].items()}
            return cls(**kept | {"config": ALGORITHMS[kept["algorithm"]].Config(**config)})
        except (AttributeError, KeyError, TypeError) as error:
            raise ValueError(f"the recipe is not one of this version ({error!r}); train anew") from error


def divided(task: str, changes: dict[str, Any], known: Collection[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Options of the environment, and settings of the learner, whose names are `known`.

    Raises:
        ValueError: a name of neither; lists both.
    """
    environment = {*inspect.signature(make).parameters, *inspect.signature(TASKS[task]).parameters}
    environment -= {"task", "backend", "realistic", "options", "vision"}
    for name in changes:
        check_choice("setting", name, environment.union(known))
    settings = {name: x for name, x in changes.items() if name in known}
    return {name: x for name, x in changes.items() if name not in known}, settings


def fitting_preset(task: str, algorithm: str, realistic: bool, options: dict[str, Any]) -> tuple[Env, Any]:
    """`preset`, whose complaints of wrong values are a `ValueError`."""
    drones = options.get("drones")
    if isinstance(drones, int):
        check_memory(f"a team of {drones:,} drones", drones * _DRONE_BYTES, "give fewer drones")
    try:
        return preset(task, algorithm, realistic, **options)
    except TypeError as error:
        raise ValueError(f"options {options} do not fit {task}: {error}") from None


def checked(name: str, value, now):
    """A setting of the kind that it has now.

    Raises:
        ValueError: it is of another kind.
    """
    if isinstance(now, float) and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if isinstance(now, tuple) and isinstance(value, list):
        value = tuple(value)
    if now is not None and type(value) is not type(now):
        raise ValueError(f"{name} is {value!r}; give something like {now!r}")
    return value


class Run:
    """The folder of one seed."""

    policy_suffix = "msgpack"

    def __init__(self, folder: str | os.PathLike):
        """Look at a folder; nothing is read or made yet."""
        self.folder = Path(folder)

    @property
    def files(self) -> list[Path]:
        """What a run of whichever library wrote here: checkpoints, progress, report."""
        endings = [f"{suffix}{new}" for suffix in ("msgpack", "zip", "json") for new in ("", ".new")]
        names = [f"{name}.{ending}" for name in ("best", "last", "state") for ending in endings]
        names += ["progress.csv", "report.json", "report.json.new"]
        return [file for file in (*map(self.folder.joinpath, names), *self._events()) if file.exists()]

    def prepare(self, size: int) -> None:
        """Make the folder and see that `size` bytes can be written to it.

        Raises:
            OSError: they cannot; says where and why.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        probe = self.folder / ".probe"
        try:
            probe.write_bytes(bytes(size))
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.folder)) from error
        finally:
            probe.unlink(missing_ok=True)

    def clear(self) -> None:
        """Remove what an earlier run left, and nothing else."""
        for file in self.files:
            file.unlink()

    def about(self, name: str = "best") -> dict[str, Any]:
        """What is known of the checkpoint `best`, `last` or `state`."""
        return checkpoint.about(self.folder / name)

    def verify(self, name: str) -> None:
        """See that a checkpoint is whole.

        Raises:
            FileNotFoundError: there is none.
            ValueError: it is damaged.
        """
        checkpoint.load_bytes(self.folder / f"{name}.{self.policy_suffix}", self.about(name))

    def told(self, name: str, entry: str) -> Any:
        """One entry of what is known of a checkpoint.

        Raises:
            FileNotFoundError: there is no such checkpoint.
            ValueError: it lacks the entry.
        """
        about = self.about(name)
        if entry not in about:
            file = self.folder / f"{name}.json"
            raise ValueError(f"{file} names no {entry}; it is not the {name} of a run of `jaxdrones train`")
        return about[entry]

    def recipe(self, name: str = "best") -> Recipe:
        """What was trained here."""
        return Recipe.from_dict(self.told(name, "recipe"))

    def policy(self, name: str = "best", env: Env | None = None) -> Policy:
        """The policy `best` or `last`.

        Raises:
            FileNotFoundError: there is none.
            ValueError: it is damaged, or does not fit `env`.
        """
        policy = checkpoint.load(self.folder / name)
        if env is not None:
            given, wanted = (
                (policy.statistics.mean.size, policy.network.outputs),
                (env.observation_size, env.action_size),
            )
            if given != wanted:
                raise misfit(self.folder / name, env, given, wanted)
        return policy

    @property
    def started(self) -> bool:
        """Whether there is a training state to go on from."""
        return (self.folder / "state.json").exists()

    @property
    def finished(self) -> bool:
        """Whether a training came to its end here."""
        return (self.folder / "report.json").exists()

    def save_policy(self, name: str, policy: Policy, **about) -> None:
        """Write `best` or `last`."""
        checkpoint.save(self.folder / name, policy, **about)

    def save_state(self, state, **about) -> None:
        """Write the training state."""
        checkpoint.save_tree(self.folder / "state", state, **about)

    def load_state(self, like):
        """The training state; `like` has its shapes."""
        return checkpoint.load_tree(self.folder / "state", like)

    def save_report(self, report: dict[str, Any]) -> None:
        """Write report.json."""
        checkpoint.write(self.folder / "report.json", json.dumps(report, indent=2).encode())

    def drop_report(self) -> None:
        """From now on the run counts as not finished."""
        (self.folder / "report.json").unlink(missing_ok=True)

    def report(self) -> dict[str, Any] | None:
        """What `save_report` wrote; `None` of a run that did not finish.

        Raises:
            ValueError: it is damaged.
        """
        file = self.folder / "report.json"
        if not self.finished:
            return None
        try:
            return json.loads(file.read_bytes())
        except (OSError, ValueError, RecursionError) as error:
            raise ValueError(f"{file} cannot be read: {error}; remove it and --resume, which writes it anew") from error

    def history(self) -> list[dict[str, float]]:
        """The lines of progress.csv; numbers that were not measured in an update are left out.

        Raises:
            ValueError: it is damaged.
        """
        path = self.folder / "progress.csv"
        if not path.exists():
            return []
        try:
            with path.open(newline="") as file:
                lines = [{name: x for name, x in row.items() if x not in ("", None)} for row in csv.DictReader(file)]
            rows = [{name: float(x) for name, x in line.items()} for line in lines]
            if not all(math.isfinite(row.get("update", math.nan)) for row in rows):
                raise ValueError("a line lacks its update")
        except (OSError, ValueError, TypeError, csv.Error) as error:
            what = checkpoint.line(error)
            raise ValueError(f"{path} is damaged: {what}; remove it, training goes on without its lines") from error
        return rows

    def _events(self) -> list[Path]:
        return sorted(self.folder.glob(f"{PREFIX}.*.jaxdrones"))


def run_in(folder: str | os.PathLike) -> Run:
    """The run in a folder, of whichever library trained it.

    Raises:
        ImportError: it is of Stable-Baselines3, which is not installed.
    """
    if (Path(folder) / "best.zip").exists():
        from jaxdrones.training import sb3  # an optional library behind it

        return sb3.Run(folder)
    return Run(folder)


def misfit(path: Path, env: Env, given: tuple[int, int], wanted: tuple[int, int]) -> ValueError:
    """The complaint about a policy of other sizes than those of the environment."""
    return ValueError(
        f"{path} was trained on another version of {env.task.name}: it has observations and "
        f"actions of {given} numbers, the environment {wanted}; train anew"
    )


class Progress:
    """progress.csv and the event file of a run, open for more lines."""

    def __init__(self, run: Run, columns: list[str], update: int):
        """Go on after an update; later lines, of a run that was killed, are dropped."""
        rows = [row for row in run.history() if row["update"] <= update] if update else []
        for file in run._events():
            file.unlink()
        self._columns = columns
        self._file = (run.folder / "progress.csv").open("w", newline="")
        self._csv = csv.DictWriter(self._file, columns)
        self._csv.writeheader()
        self._events = EventFile(run.folder)
        self.add(rows)

    def add(self, rows: list[dict[str, float]]) -> None:
        """Write lines; each has at least `update`."""
        for row in rows:
            self._csv.writerow(row | {name: int(row[name]) for name in ("update", "steps") if name in row})
            self._events.add(int(row["update"]), {name: x for name, x in row.items() if name != "update"})
        self._file.flush()
        self._events.flush()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_) -> None:
        self._file.close()
        self._events.close()


def as_dict(report: Report) -> dict[str, Any]:
    """An evaluation for JSON."""
    kept = {field.name: getattr(report, field.name) for field in dataclasses.fields(report)}
    kept |= {"successes": round(report.success * report.episodes)}
    return kept | {"error_percentiles": {str(q): x for q, x in report.error_percentiles.items()}}


def size_of(tree) -> int:
    """Bytes of a tree of arrays, or of their shapes."""
    leaves = jax.tree.leaves(tree)
    return sum(leaf.size * (leaf.dtype.itemsize) for leaf in leaves)
