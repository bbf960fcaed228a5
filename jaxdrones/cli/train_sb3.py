"""`jaxdrones train --library sb3`: training by Stable-Baselines3, as in the paper."""

import argparse
import dataclasses
import time

from jaxdrones.checks import check_choice
from jaxdrones.cli.budget import Deadlines, parse_budget
from jaxdrones.cli.common import INTERRUPTED, print_error, print_warning, run_folder
from jaxdrones.cli.evaluate import described
from jaxdrones.cli.names import SB3_ALGORITHMS
from jaxdrones.cli.settings import asked_settings, user_mistakes
from jaxdrones.cli.training import (
    ProgressDisplay,
    check_free,
    draw_curves,
    merge_budget,
    quiet,
    remaining_best,
    show_results,
    warn_of_unknown_settings,
)
from jaxdrones.errors import UserError
from jaxdrones.limits import LARGEST_COUNT, check_at_most, check_seed
from jaxdrones.training import user_files
from jaxdrones.visualization import plots

_EPISODES = 100  # of an evaluation


def train(options: argparse.Namespace) -> int:
    """Train by Stable-Baselines3.

    Raises:
        ValueError: a mistake in the options.
        ImportError: Stable-Baselines3 is not installed; says which extra to install.
    """
    begin = time.perf_counter()
    _refuse(options)
    algorithm = "ppo" if options.algo is None else options.algo
    check_choice("algorithm of sb3", algorithm, SB3_ALGORITHMS)
    episodes, seed = _EPISODES if options.episodes is None else options.episodes, options.seed or 0
    check_at_most("episodes", episodes, LARGEST_COUNT)
    check_seed("seed", seed)
    steps, seconds = parse_budget(options.budget, "control steps", 100_000)
    asked = merge_budget("steps", asked_settings(options), steps, seconds)
    if not options.no_figure:
        plots.check_matplotlib()
    user_files.task_of(*user_files.take_task(options.task))  # a wrong name is said before what is not installed
    from jaxdrones.training.stable_baselines import PRESET_TASK, SB3Recipe, SB3Run  # says which extra to install

    # isort: split
    from jaxdrones.learning import Diverged
    from jaxdrones.training.lock import locked
    from jaxdrones.training.stable_baselines_trainer import SB3Trainer

    run = SB3Run(options.output or run_folder(options.task, f"-sb3-{algorithm}"))
    deadlines = Deadlines(options, begin, seconds, 1)
    print_line = quiet if options.json else print
    with locked(run.folder, print_warning):
        with user_mistakes(asked, options.task):
            recipe = SB3Recipe.of(options.task, algorithm, options.realistic, **asked)
            recipe = dataclasses.replace(recipe, stop_at=options.stop_at)
        check_free(run, options.overwrite)
        print_line(f"{_headline(recipe)}; compiling")
        with user_mistakes(asked, options.task):
            trainer = SB3Trainer(recipe, seed, episodes)
        trainer.prepare(run)
        if recipe.task != PRESET_TASK or recipe.realistic == "any":
            warn_of_unknown_settings(recipe)
        deadlines.start(resumable=False)
        run.clear()
        total = recipe.config["steps"] if seconds is None else None
        print_line(
            f"compiled in {trainer.compile_seconds:.1f} s; control steps: {total or 'as many as the time allows'}"
        )
        try:
            with ProgressDisplay(total, "training", episodes, print_line, "step") as display:
                trainer.train(run, display.update, deadlines.next())
        except KeyboardInterrupt:
            if not run.files:
                return print_error("interrupted before the first evaluation; nothing is kept", INTERRUPTED)
            draw_curves(options, {seed: run}, run.folder)
            return print_error(f"interrupted; {remaining_best(run)}", INTERRUPTED)
        except Diverged as error:
            draw_curves(options, {seed: run}, run.folder)
            return print_error(
                f"training diverged: {error}, for example --set learning_rate=1e-4; {remaining_best(run)}", 1
            )
        code = show_results(options, {seed: run}, run.folder)
        deadlines.warn_if_missed()
        return code


def _refuse(options: argparse.Namespace) -> None:
    """Raise for options that Stable-Baselines3 does not support here."""
    if options.resume:
        raise UserError("--resume is given with --library sb3, whose trainings keep no state; leave it out")
    if options.live is not None:
        raise UserError("--live is given with --library sb3, whose trainings are not shown; leave it out")
    if options.seeds != 1:
        raise UserError(
            f"--seeds {options.seeds} is given with --library sb3, which trains one; leave it out, choose with --seed"
        )


def _headline(recipe) -> str:
    config, network = recipe.config, "-".join(map(str, recipe.config["net_arch"]))
    summary = recipe.env().task.summary
    return f"{described(recipe)}: {summary}; {config['worlds']} worlds, network {network}"
