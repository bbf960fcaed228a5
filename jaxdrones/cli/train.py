"""`jaxdrones train`."""

import argparse
import dataclasses
import time
from pathlib import Path

from jaxdrones.checks import check_choice
from jaxdrones.cli import hosts
from jaxdrones.cli.common import INTERRUPTED, folder, print_error, print_warning
from jaxdrones.cli.evaluate import described
from jaxdrones.cli.names import ALGORITHMS, LIBRARIES, SB3_ALGORITHMS
from jaxdrones.cli.training import Shown, budget, check_free, draw, finish, fitting, kept, once, quiet, settings
from jaxdrones.envs import TASKS
from jaxdrones.limits import LARGEST_COUNT, check_at_most, check_seed
from jaxdrones.render import plots

_MOST_SEEDS = 1000


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "train",
        help="train a policy for a task",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Train a policy with settings that were found to work; evaluate the best over many episodes.\n\n"
        "  best, last     policies, each a .msgpack and a .json; with sb3 a .zip\n"
        "  state          to --resume from, bit for bit\n"
        "  progress.csv   a line per update; the events file beside it is for TensorBoard\n"
        "  curve.png      how training went\n"
        "  report.json    the evaluation, and what it took\n\n"
        "Ctrl-C keeps the best policy and the state. A run that is in --output, finished or not, is never replaced\n"
        "without --overwrite.\n\n"
        "  --resume                     go on with a run that was stopped, as it was asked for\n"
        "  --resume --budget 100        train a finished run 100 updates longer\n"
        "  --resume --budget 60s        train on for 60 s, without compiling, a run that was stopped or finished\n"
        "  --resume --set updates=400   train on to 400 updates in all\n\n"
        "A run that is trained longer goes on as if all updates had been asked for at the start: the learning rate\n"
        "rises to what it would be then, and falls to the new end. The best policy stays unless a better one comes.\n\n"
        "With --library sb3, Stable-Baselines3 trains the paper's network (512-512-256-128, ReLU); `hover` then is\n"
        "`hover-2021`, the one-dimensional hover of the paper's equation 12, and there is no state to resume from.",
        epilog="JAX_COMPILATION_CACHE_DIR=folder keeps compiled programs, so that a second training starts sooner.\n\n"
        + hosts.HELP,
        allow_abbrev=False,
    )
    parser.add_argument("task", metavar="TASK", help=", ".join(TASKS))
    parser.add_argument("--library", default=LIBRARIES[0], help=f"{', '.join(LIBRARIES)} ({LIBRARIES[0]})")
    parser.add_argument(
        "--algo",
        help=f"{', '.join(ALGORITHMS)} (bptt; gates: ppo); with sb3 {', '.join(SB3_ALGORITHMS)} ({SB3_ALGORITHMS[0]})",
    )
    parser.add_argument(
        "--realistic", action="store_true", help="rotor lag, drag, delay, sensor noise, parameter ranges"
    )
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="train so many times, in DIR/seed-K (1)")
    parser.add_argument("--seed", type=int, metavar="K", help="the first seed (0)")
    parser.add_argument(
        "--budget",
        metavar="N|Ns",
        help="updates of the policy, 300 (with sb3 control steps, 100000), or time a seed with compiling, 60s, 5m, 2h",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="setting of the learner (worlds, horizon, learning_rate; with sb3 net_arch and arguments of its class) or "
        "of the environment (vehicle, period, drones)",
    )
    parser.add_argument("--episodes", type=int, metavar="N", help="of every evaluation (1000, with sb3 100)")
    parser.add_argument(
        "--output", type=folder, metavar="DIR", help="folder of the run (runs/TASK, runs/TASK-sb3-ALGO)"
    )
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on with the run in --output; with --budget train a finished one longer",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace the run in --output, finished or not")
    hosts.add_options(parser)
    parser.add_argument("--no-figure", action="store_true", help="draw no learning curve; needs no matplotlib")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else on stdout")
    parser.set_defaults(run=hosts.together(_train))


def _train(options: argparse.Namespace) -> int:
    check_choice("library", options.library, LIBRARIES)
    if options.library == "sb3":
        from jaxdrones.cli import train_sb3

        return train_sb3.train(options)
    from jaxdrones.training.hosts import checked
    from jaxdrones.training.loop import Diverged, Trainer
    from jaxdrones.training.runs import Run

    begin = time.perf_counter()
    with checked():
        if not options.no_figure:
            plots.check_matplotlib()
        output = options.output or Path("runs") / options.task
        _check_numbers(options)
        updates, seconds = budget(options.budget, "updates", 300)
        asked = once("updates", settings(options.set), updates, seconds)
        runs = _runs(options, output)
        with fitting(asked, options.task):
            recipe = _resumed(options, runs, asked, seconds) if options.resume else _fresh(options, runs, output, asked)
            trainer = Trainer(recipe, _episodes(options, runs))
        for run in runs.values():
            if run.started and options.resume:
                trainer.check(run)
        for run in (*runs.values(), Run(output)):
            trainer.prepare(run)
    say = quiet if options.json else print
    say(f"{_headline(recipe)}; compiling")
    trainer.compile()
    made = max((run.told("state", "update") for run in runs.values() if run.started and options.resume), default=0)
    if seconds is not None:
        spent = 0.0 if options.resume else time.perf_counter() - begin
        if spent > seconds:
            print_warning(
                f"compiling took all of --budget {options.budget}, so one update is made; --resume trains it longer"
            )
        trainer.fit(seconds - spent, made)
    total = trainer.recipe.config.updates
    say(f"compiled in {trainer.compile_seconds:.1f} s; updates: {total}{f', {made} of them made' * bool(made)}")
    if not options.resume:
        for run in (*runs.values(), Run(output)):
            run.clear()

    for seed, run in runs.items():
        if run.finished and run.told("state", "update") >= total:
            continue
        shown = Shown(total, f"seed {seed}" if len(runs) > 1 else "training", trainer.episodes, say)
        try:
            with shown:
                trainer.train(run, seed, shown.tell)
        except KeyboardInterrupt:
            if not run.started:
                return print_error("interrupted before the first update; there is nothing to go on with", INTERRUPTED)
            draw(options, {seed: run}, run.folder)
            again = f"jaxdrones train {options.task} --output {output} --resume"
            again += f" --seeds {options.seeds}" * (options.seeds > 1) + f" --seed {min(runs)}" * (min(runs) > 0)
            return print_error(
                f"interrupted at update {run.told('state', 'update')}; {kept(run)}; go on with: {again}", INTERRUPTED
            )
        except Diverged as error:
            draw(options, {seed: run}, run.folder)
            return print_error(
                f"training diverged: {error}; {kept(run)}; try smaller steps, for example --set learning_rate=1e-3", 1
            )
    return finish(options, runs, output)


def _headline(recipe) -> str:
    config = recipe.config
    what = described(recipe)
    return f"{what}: {config.worlds} worlds x {config.horizon} control steps an update"


def _check_numbers(options: argparse.Namespace) -> None:
    check_at_most("seeds", options.seeds, _MOST_SEEDS)
    if options.seed is not None:
        check_seed("seed", options.seed)
        check_seed("the last seed", options.seed + options.seeds - 1)
    if options.episodes is not None:
        check_at_most("episodes", options.episodes, LARGEST_COUNT)
    if options.resume and options.overwrite:
        raise ValueError("--resume and --overwrite are given; one goes on with a run, the other replaces it")


def _runs(options: argparse.Namespace, output: Path) -> dict:
    """Seed -> run."""
    from jaxdrones.training.runs import Run

    run = Run(output)
    if options.seeds > 1:
        if options.resume and run.started:
            raise ValueError(f"{output} holds the training of one seed; leave out --seeds to --resume it")
        first = options.seed or 0
        return {seed: Run(output / f"seed-{seed}") for seed in range(first, first + options.seeds)}
    if options.resume and not run.started:
        raise _nothing(run)
    seed = run.told("state", "seed") if options.resume else options.seed or 0
    return {seed: run}


def _nothing(run) -> ValueError:
    several = "give --seeds N, or " if list(run.folder.glob("seed-*/state.json")) else ""
    return ValueError(f"{run.folder} holds no training to go on with; {several}leave out --resume")


def _fresh(options: argparse.Namespace, runs: dict, output: Path, asked: dict):
    """The recipe that is asked for, if it may be written where it is to go."""
    from jaxdrones.training.presets import algorithm_for
    from jaxdrones.training.runs import Recipe, Run

    algorithm = algorithm_for(options.task) if options.algo is None else options.algo
    recipe = Recipe.of(options.task, algorithm, options.realistic, **asked)
    for run in (*runs.values(), Run(output)):
        check_free(run, options.overwrite)
    return recipe


def _resumed(options: argparse.Namespace, runs: dict, asked: dict, seconds: float | None):
    """The recipe that the runs began with, and maybe more updates; nothing else that is asked for may differ."""
    from jaxdrones.training.runs import Recipe

    started = [run for run in runs.values() if run.started]
    if not started:
        raise _nothing(next(iter(runs.values())))
    for run in started:
        run.verify("best")
        run.verify("state")
    recipes = [Recipe.from_dict(run.told("state", "recipe")) for run in started]
    folder, recipe = started[0].folder, max(recipes, key=lambda recipe: recipe.config.updates)
    had = {"task": recipe.task, "algo": recipe.algorithm, "realistic": recipe.realistic}
    had |= vars(recipe.config) | recipe.options | {"episodes": started[0].told("state", "episodes")}
    wanted = {"task": options.task, **asked}
    wanted |= {} if options.algo is None else {"algo": options.algo}
    wanted |= {"realistic": True} if options.realistic else {}
    wanted |= {} if options.episodes is None else {"episodes": options.episodes}
    if options.seed is not None and options.seeds == 1:
        had, wanted = had | {"seed": next(iter(runs))}, wanted | {"seed": options.seed}
    updates = wanted.pop("updates", None)
    for name, x in wanted.items():
        if had.get(name) != x:
            raise ValueError(f"{folder} began with {name} {had.get(name)}, not {x}; leave that out to --resume")
    finished = len(started) == len(runs) and all(
        run.finished and run.told("state", "update") >= recipe.config.updates for run in started
    )
    total = _total(recipe.config.updates, updates, options.budget is not None, finished)
    if finished and seconds is None and total == recipe.config.updates:
        raise ValueError(
            f"{folder} is trained to the end, {total} updates; train longer with --budget N more or 60s, or anew with "
            "--overwrite in place of --resume"
        )
    return dataclasses.replace(recipe, config=dataclasses.replace(recipe.config, updates=total))


def _total(had: int, asked: int | None, more: bool, finished: bool) -> int:
    """Updates of a run that goes on.

    Args:
        had: updates that it was begun with.
        asked: updates that are asked for.
        more: whether they come on top of those of a finished run, as --budget says, or are all, as --set says.
        finished: whether it made all that it was begun with.
    """
    if asked is None:
        return had
    check_at_most("updates", asked, LARGEST_COUNT)
    if more and finished:
        asked += had
    elif asked < had or (more and asked != had):
        raise ValueError(
            f"the run began with updates {had}, not {asked}; leave that out to --resume, or give a larger number by "
            "--set updates=N"
        )
    check_at_most("updates", asked, LARGEST_COUNT)
    return asked


def _episodes(options: argparse.Namespace, runs: dict) -> int:
    """Of an evaluation; when resuming, as many as before, so that the best stays comparable."""
    begun = (run.told("state", "episodes") for run in runs.values() if run.started and options.resume)
    return next(begun, 1000 if options.episodes is None else options.episodes)
