"""The runs that a training makes or continues, and their recipe."""

import argparse
import dataclasses
from pathlib import Path

from jaxdrones.cli.training import check_free
from jaxdrones.errors import UserError
from jaxdrones.limits import LARGEST_COUNT, check_at_most


def runs_of(options: argparse.Namespace, output: Path) -> dict:
    """The run of each seed."""
    from jaxdrones.training.run import Run

    run = Run(output)
    if options.seeds > 1:
        if options.resume and run.started:
            raise UserError(f"{output} holds the training of one seed; leave out --seeds to --resume it")
        first = options.seed or 0
        return {seed: Run(output / f"seed-{seed}") for seed in range(first, first + options.seeds)}
    if options.resume and not run.started:
        raise _nothing_to_resume(run)
    seed = run.sidecar_entry("state", "seed") if options.resume else options.seed or 0
    return {seed: run}


def folders_of(options: argparse.Namespace, output: Path) -> list[Path]:
    """The folders that a training writes to: that of the command, and those of several seeds."""
    first = options.seed or 0
    return [output] + [output / f"seed-{seed}" for seed in range(first, first + options.seeds) if options.seeds > 1]


def remaining(runs: dict, updates: int, seconds: float | None) -> dict:
    """The runs that are to be trained, without those that are finished and not to be trained longer.

    Args:
        runs: run of each seed.
        updates: number of updates that were asked for.
        seconds: time that was asked for, s.
    """
    had = {seed: _updates(run) for seed, run in runs.items() if run.started}
    longer = seconds is not None or updates > max(had.values(), default=0)
    return {seed: run for seed, run in runs.items() if longer or not (run.finished and _is_complete(run))}


def _updates(run) -> int:
    """Number of updates that the training of a run was to make, or after which it stopped early."""
    return run.sidecar_entry("state", "recipe")["config"]["updates"]


def _is_complete(run) -> bool:
    return run.started and run.sidecar_entry("state", "update") >= _updates(run)


def _nothing_to_resume(run) -> UserError:
    several = "give --seeds N, or " if list(run.folder.glob("seed-*/state.json")) else ""
    return UserError(f"{run.folder} holds no training to continue; {several}leave out --resume")


def recipe_of(options: argparse.Namespace, runs: dict, output: Path, asked: dict, seconds: float | None):
    """The recipe of the runs: that of a training that is continued, or the one that was asked for."""
    return _resumed(options, runs, asked, seconds) if options.resume else _fresh(options, runs, output, asked)


def _fresh(options: argparse.Namespace, runs: dict, output: Path, asked: dict):
    """The recipe that was asked for; raises if it would replace another run."""
    from jaxdrones.training.presets import default_algorithm
    from jaxdrones.training.recipe import Recipe
    from jaxdrones.training.run import Run

    algorithm = default_algorithm(options.task) if options.algo is None else options.algo
    recipe = Recipe.of(options.task, algorithm, options.realistic, **asked)
    recipe = dataclasses.replace(recipe, stop_at=options.stop_at)
    for run in (*runs.values(), Run(output)):
        check_free(run, options.overwrite)
    return recipe


def _resumed(options: argparse.Namespace, runs: dict, asked: dict, seconds: float | None):
    """The recipe of the runs, with the number of updates asked for; all other settings have to be the same."""
    from jaxdrones.training import user_files
    from jaxdrones.training.recipe import Recipe

    started = [run for run in runs.values() if run.started]
    if not started:
        raise _nothing_to_resume(next(iter(runs.values())))
    for run in started:
        for name in ("best", "state", *["last"] * (run.folder / "last.json").exists()):
            run.verify(name)
    recipes = [Recipe.from_dict(run.sidecar_entry("state", "recipe")) for run in started]
    folder, recipe = started[0].folder, max(recipes, key=lambda recipe: recipe.config.updates)
    had = {"task": recipe.task, "algo": recipe.algorithm, "realistic": recipe.realistic}
    had |= vars(recipe.config) | recipe.options | {"episodes": started[0].sidecar_entry("state", "episodes")}
    task, files = user_files.take_task(options.task, recipe.files)
    asked, vehicle = user_files.take_vehicle(asked, recipe.files)
    user_files.check_unchanged(folder, recipe.files, files | vehicle)
    wanted = {"task": task, **asked}
    wanted |= {} if options.algo is None else {"algo": options.algo}
    wanted |= {"realistic": options.realistic} if options.realistic else {}
    wanted |= {} if options.episodes is None else {"episodes": options.episodes}
    if options.seed is not None and options.seeds == 1:
        had, wanted = had | {"seed": next(iter(runs))}, wanted | {"seed": options.seed}
    updates = wanted.pop("updates", None)
    for name, x in wanted.items():
        if had.get(name) != x:
            raise UserError(f"{folder} was started with {name} {had.get(name)}, not {x}; leave {name} out to --resume")
    finished = len(started) == len(runs) and all(run.finished and _is_complete(run) for run in started)
    total = _total(recipe.config.updates, updates, options.budget is not None, finished)
    if finished and seconds is None and total == recipe.config.updates:
        raise UserError(
            f"{folder} is trained to the end, {total} updates; train it longer with --budget N or 60s, or "
            "replace it with --overwrite instead of --resume"
        )
    stop_at = recipe.stop_at if options.stop_at is None else options.stop_at
    return dataclasses.replace(recipe, config=dataclasses.replace(recipe.config, updates=total), stop_at=stop_at)


def _total(had: int, asked: int | None, more: bool, finished: bool) -> int:
    """Total number of updates of a run that is resumed.

    Args:
        had: total number of updates so far.
        asked: number of updates asked for.
        more: whether it is added to those of a finished run, as with --budget; otherwise, as with --set, it is the
            total.
        finished: whether all updates so far were made.
    """
    if asked is None:
        return had
    check_at_most("updates", asked, LARGEST_COUNT)
    if more and finished:
        asked += had
    elif asked < had or (more and asked != had):
        raise UserError(
            f"the run was started with updates {had}, not {asked}; leave updates out to --resume, or give a larger "
            "number by --set updates=N"
        )
    check_at_most("updates", asked, LARGEST_COUNT)
    return asked


def episodes_of(options: argparse.Namespace, runs: dict) -> int:
    """Episodes of an evaluation; a resumed run keeps their number, so that its evaluations remain comparable."""
    started = (run.sidecar_entry("state", "episodes") for run in runs.values() if run.started and options.resume)
    return next(started, 1000 if options.episodes is None else options.episodes)
