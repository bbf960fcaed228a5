"""`jaxdrones train --library sb3`: the paper's single-agent workflow."""

import argparse
import time
from pathlib import Path

from jaxdrones.checks import check_choice
from jaxdrones.cli.common import INTERRUPTED, print_error
from jaxdrones.cli.evaluate import described
from jaxdrones.cli.names import SB3_ALGORITHMS
from jaxdrones.cli.training import Shown, budget, check_free, draw, finish, fitting, kept, once, quiet, settings
from jaxdrones.envs import TASKS
from jaxdrones.limits import LARGEST_COUNT, check_at_most, check_seed
from jaxdrones.render import plots

_PAPER = {"hover": "hover-2021"}  # what the paper's own command means by the name
_EPISODES = 100


def train(options: argparse.Namespace) -> int:
    """Train by Stable-Baselines3, as `jaxdrones train` was asked to.

    Raises:
        ValueError: a mistake in what was asked.
        ImportError: Stable-Baselines3 is not installed; says which extra to install.
    """
    begin = time.perf_counter()
    _refuse(options)
    algorithm = SB3_ALGORITHMS[0] if options.algo is None else options.algo
    task = _PAPER.get(options.task, options.task)
    check_choice("algorithm of sb3", algorithm, SB3_ALGORITHMS)
    check_choice("task", task, TASKS)
    episodes, seed = _EPISODES if options.episodes is None else options.episodes, options.seed or 0
    check_at_most("episodes", episodes, LARGEST_COUNT)
    check_seed("seed", seed)
    steps, seconds = budget(options.budget, "control steps", 100_000)
    asked = once("steps", settings(options.set), steps, seconds)
    if not options.no_figure:
        plots.check_matplotlib()
    from jaxdrones.training import sb3
    from jaxdrones.training.loop import Diverged
    from jaxdrones.training.sb3_training import Trainer

    run = sb3.Run(options.output or Path("runs") / f"{options.task}-sb3-{algorithm}")
    with fitting(asked, task):
        recipe = sb3.Recipe.of(task, algorithm, options.realistic, **asked)
    check_free(run, options.overwrite)
    say = quiet if options.json else print
    say(f"{_headline(recipe)}; compiling")
    with fitting(asked, task):
        trainer = Trainer(recipe, seed, episodes)
    trainer.prepare(run)
    run.clear()
    total = recipe.config["steps"] if seconds is None else None
    say(f"compiled in {trainer.compile_seconds:.1f} s; control steps: {total or 'as many as the time allows'}")
    try:
        with Shown(total, "training", episodes, say, "step") as shown:
            trainer.train(run, shown.tell, None if seconds is None else begin + seconds)
    except KeyboardInterrupt:
        if not run.files:
            return print_error("interrupted before the first evaluation; nothing is kept", INTERRUPTED)
        draw(options, {seed: run}, run.folder)
        return print_error(f"interrupted; {kept(run)}", INTERRUPTED)
    except Diverged as error:
        draw(options, {seed: run}, run.folder)
        return print_error(f"training diverged: {error}; {kept(run)}; try a smaller --set learning_rate", 1)
    return finish(options, {seed: run}, run.folder)


def _refuse(options: argparse.Namespace) -> None:
    """Raise where our own learners do what SB3's do not."""
    if options.resume:
        raise ValueError("--resume is given with --library sb3, whose trainings keep no state; leave it out")
    if options.seeds != 1:
        raise ValueError(
            f"--seeds {options.seeds} is given with --library sb3, which trains one; leave it out, choose with --seed"
        )


def _headline(recipe) -> str:
    config, network = recipe.config, "-".join(map(str, recipe.config["net_arch"]))
    summary = recipe.env().task.summary
    return f"{described(recipe)}: {summary}; {config['worlds']} worlds, network {network}"
