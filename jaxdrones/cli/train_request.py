"""Request of `jaxdrones train`: validated options, runs and recipe."""

import argparse
import ast
import dataclasses
import itertools
import shlex
from pathlib import Path
from typing import Any, Self

from jaxdrones import arguments
from jaxdrones.cli.common import print_warning, run_folder
from jaxdrones.cli.policies import is_user_policy, open_policy, warn_of_code
from jaxdrones.cli.settings import given_settings, parse_value
from jaxdrones.errors import UserError
from jaxdrones.learning.loggers import logger_names
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.policies import check_terms, terms_of
from jaxdrones.limits import LARGEST_COUNT
from jaxdrones.pytree import as_tuple
from jaxdrones.training import user_files
from jaxdrones.training.presets import default_algorithm
from jaxdrones.training.recipe import Recipe
from jaxdrones.training.run import Run

_MAX_SECONDS = 3.6e6
_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}


class Request(argparse.Namespace):
    """Validated options of the command, and values derived from them.

    The derived values are `settings` (those of the learner, with the `updates` of --budget, and options of the
    environment), `seconds` (the time per run of --budget) and `row` (the settings of --sweep, for titles).
    """

    @classmethod
    def of(cls, options: argparse.Namespace) -> Self:
        """Request of a command line."""
        if options.seed is not None:
            arguments.seed("the last seed", options.seed + options.seeds - 1)
        if options.resume and options.overwrite:
            raise UserError("--resume and --overwrite are given; one continues a run, the other replaces it")
        if options.resume and options.start_from is not None:
            raise UserError("--resume and --from are given; one continues a training, the other starts a new one")
        logger_names(options.log)
        updates, seconds = parse_budget(options.budget)
        settings = given_settings(options)
        if "updates" in settings and options.budget is not None:
            raise UserError(f"--set updates={settings['updates']} is given beside --budget; give one of them")
        settings = settings if updates is None else settings | {"updates": updates}
        output = options.output or run_folder(options.task)
        return cls(**vars(options) | {"settings": settings, "seconds": seconds, "output": output, "row": ""})

    def swept(self) -> list[Self]:
        """Request for each combination of the values of --sweep, each with its own folder."""
        rows = [parse_sweep(text) for text in self.sweep]
        names = [name for name, _ in rows]
        for name in names:
            if name == "updates" and self.budget is not None:
                raise UserError(f"--sweep updates is given beside --budget {self.budget}; give one of them")
            if name in self.settings:
                raise UserError(f"{name} is given by --set and by --sweep; give one of them")
            if names.count(name) > 1:
                raise UserError(f"--sweep {name} is given twice; give all values in one, {name}=VALUE,VALUE")
        if not rows:
            return [self]
        requests: list[Self] = []
        for values in itertools.product(*(values for _, values in rows)):
            settings = dict(zip(names, values, strict=True))
            row = ",".join(f"{name}={x}".replace(" ", "").replace("/", "-") for name, x in settings.items())
            own = {"settings": self.settings | settings, "output": self.output / row, "row": row}
            if any(own["output"] == other.output for other in requests):
                raise UserError(f"--sweep has {row} twice, which would train into the same folder; give it once")
            requests.append(type(self)(**vars(self) | own))
        return requests

    @property
    def folders(self) -> dict[int, Path]:
        """Folder of each seed; for one seed that of the command."""
        first = self.seed or 0
        if self.seeds == 1:
            return {first: self.output}
        return {seed: self.output / f"seed-{seed}" for seed in range(first, first + self.seeds)}

    @property
    def again(self) -> str:
        """Command that continues this training."""
        command = shlex.join(["jaxdrones", "train", self.task, "--output", str(self.output), "--resume"])
        first = min(self.folders)
        return command + f" --seeds {self.seeds}" * (self.seeds > 1) + f" --seed {first}" * (first > 0)

    def runs(self) -> dict:
        """Run of each seed."""
        run = Run(self.output)
        if self.seeds > 1:
            if self.resume and run.started:
                raise UserError(f"{self.output} holds the training of one seed; leave out --seeds to --resume it")
            return {seed: Run(folder) for seed, folder in self.folders.items()}
        if self.resume and not run.started:
            raise _nothing_to_resume(run)
        return {run.sidecar_entry("state", "seed") if self.resume else self.seed or 0: run}

    def recipe(self, runs: dict):
        """Recipe of the runs: that of a continued training, or the requested one."""
        return self._resumed_recipe(runs) if self.resume else self._new_recipe(runs)

    def episodes_of(self, runs: dict) -> int:
        """Episodes of an evaluation; a resumed run keeps their number, for comparable evaluations."""
        started = (run.sidecar_entry("state", "episodes") for run in runs.values() if run.started and self.resume)
        return next(started, 1000 if self.episodes is None else self.episodes)

    def first_policy(self, recipe) -> Policy | None:
        """Policy of --from for a training by `recipe`."""
        if self.start_from is None:
            return None
        if is_user_policy(self.start_from):
            raise UserError(f"--from is {self.start_from}; give the folder of a run or the name of a bundled policy")
        run = open_policy(self.start_from, None, False, {})
        had = run.recipe().options.get("vehicle", "cf2x")
        if "vehicle" not in self.settings and self.realistic != "any" and had != "cf2x":
            print_warning(
                f"the policy of {self.start_from} was trained with the vehicle {had}, and --from keeps only its "
                f"parameters: this training is with cf2x; give --vehicle {had} for the same"
            )
        env = recipe.env()
        policy = run.policy(env=env)
        check_terms(f"of {self.start_from}", terms_of(run.recipe().env()), env)
        return policy

    def _new_recipe(self, runs: dict):
        algorithm = default_algorithm(self.task) if self.algo is None else self.algo
        recipe = Recipe.of(self.task, algorithm, self.realistic, **self.settings)
        for run in (*runs.values(), Run(self.output)):
            if run.files and not self.overwrite:
                raise _not_free(run)
        start_from = None if self.start_from is None else str(self.start_from)
        return dataclasses.replace(recipe, stop_at=self.stop_at, start_from=start_from)

    def _resumed_recipe(self, runs: dict):
        """Recipe of the runs with the requested number of updates; all other settings must be unchanged."""
        started = [run for run in runs.values() if run.started]
        if not started:
            raise _nothing_to_resume(next(iter(runs.values())))
        for run in started:
            for name in ("best", "state", *["last"] * (run.folder / "last.json").exists()):
                run.verify(name)
            warn_of_code(run, "state")
        recipes = [Recipe.from_dict(run.sidecar_entry("state", "recipe")) for run in started]
        folder, recipe = started[0].folder, max(recipes, key=lambda recipe: recipe.config.updates)
        had = {"task": recipe.task, "algo": recipe.algorithm, "realistic": recipe.realistic}
        had |= vars(recipe.config) | recipe.options | {"episodes": started[0].sidecar_entry("state", "episodes")}
        task, files = user_files.take_task(self.task, recipe.files)
        settings, vehicle = user_files.take_vehicle(self.settings, recipe.files)
        user_files.check_unchanged(folder, recipe.files, files | vehicle)
        given = {"algo": self.algo, "realistic": self.realistic or None, "episodes": self.episodes}
        wanted = {"task": task, **settings} | {name: x for name, x in given.items() if x is not None}
        if self.seed is not None and self.seeds == 1:
            had, wanted = had | {"seed": next(iter(runs))}, wanted | {"seed": self.seed}
        updates = wanted.pop("updates", None)
        for name, x in wanted.items():
            if as_tuple(had.get(name)) != as_tuple(x):
                raise UserError(
                    f"{folder} was started with {name} {had.get(name)}, not {x}; leave {name} out to --resume"
                )
        finished = len(started) == len(runs) and all(run.finished and _is_complete(run) for run in started)
        total = _total(recipe.config.updates, updates, self.budget is not None, finished)
        if finished and self.seconds is None and total == recipe.config.updates:
            raise UserError(
                f"the training in {folder} is complete (updates={total}); train longer with --budget N or 60s, or "
                "replace it with --overwrite instead of --resume"
            )
        stop_at = recipe.stop_at if self.stop_at is None else self.stop_at
        return dataclasses.replace(recipe, config=dataclasses.replace(recipe.config, updates=total), stop_at=stop_at)


def parse_sweep(text: str) -> tuple[str, list[Any]]:
    """Name and values of `--sweep NAME=VALUE,VALUE`."""
    name, _, values = text.partition("=")
    try:
        parsed = list(ast.literal_eval(f"[{values}]"))
    except (ValueError, SyntaxError):
        parsed = [parse_value(value) for value in values.split(",")]
    if not name or not parsed or "" in parsed:
        raise UserError(f"--sweep is {text!r}; give NAME=VALUE,VALUE, for example learning_rate=1e-3,3e-3")
    return name, parsed


def parse_budget(text: str | None) -> tuple[int | None, float | None]:
    """Number of updates, or seconds, of --budget; the other is `None`."""
    if text is None:
        return None, None
    try:
        if text[-1:] in _UNITS:
            seconds = float(text[:-1]) * _UNITS[text[-1]]
            if 0 < seconds <= _MAX_SECONDS:
                return None, seconds
        elif 0 < int(text) <= LARGEST_COUNT:
            return int(text), None
    except ValueError:
        pass
    raise UserError(
        f"--budget is {text!r}; give updates, for example 300, or a time up to 1000h, for example 60s, 5m or 2h"
    )


def remaining(runs: dict, updates: int, seconds: float | None) -> dict:
    """Runs to train: all, or without the finished ones if no more updates or time (s) are requested."""
    longer = seconds is not None or updates > max((_updates(run) for run in runs.values() if run.started), default=0)
    return {seed: run for seed, run in runs.items() if longer or not (run.finished and _is_complete(run))}


def _updates(run) -> int:
    """Number of updates of the training of a run, possibly after an early stop."""
    return run.sidecar_entry("state", "recipe")["config"]["updates"]


def _is_complete(run) -> bool:
    return run.started and run.sidecar_entry("state", "update") >= _updates(run)


def _nothing_to_resume(run) -> UserError:
    several = "give --seeds N, or " if list(run.folder.glob("seed-*/state.json")) else ""
    return UserError(f"{run.folder} holds no training to continue; {several}leave out --resume")


def _not_free(run) -> UserError:
    if run.finished:
        what, again = "a finished training", "train it longer with --resume --budget N, " if run.started else ""
    else:
        what, again = "a training that did not finish", "continue it with --resume, " if run.started else ""
    return UserError(f"{run.folder} holds {what}; {again}replace it with --overwrite, or choose another --output")


def _total(had: int, requested: int | None, more: bool, finished: bool) -> int:
    """Total number of updates of a resumed run that had `had`.

    `more` adds the requested ones to those of a finished run, as --budget does; else they are the total, as by --set.
    """
    if requested is None:
        return had
    arguments.count("updates", requested)
    if more and finished:
        requested += had
    elif requested < had or (more and requested != had):
        raise UserError(
            f"the run was started with updates {had}, not {requested}; leave updates out to --resume, or give a larger "
            "number by --set updates=N"
        )
    return requested
