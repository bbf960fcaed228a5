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
from jaxdrones.cli.training import (
    ProgressDisplay,
    check_free,
    draw_curves,
    merge_budget,
    parse_budget,
    parse_settings,
    quiet,
    remaining_best,
    show_results,
    user_mistakes,
)
from jaxdrones.envs import TASKS
from jaxdrones.limits import LARGEST_COUNT, check_at_most, check_seed
from jaxdrones.visualization import plots

_MAX_SEEDS = 1000


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "train",
        help="train a policy for a task",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Train a policy with settings that were found to work, and evaluate the best one.\n\n"
        "The command writes these files:\n\n"
        "  best, last     policies, each a .msgpack and a .json; with sb3 a .zip\n"
        "  state          everything that --resume needs to continue, bit for bit\n"
        "  progress.csv   a row for each update; an event file holds the same for TensorBoard\n"
        "  curve.png      learning curves\n"
        "  report.json    the evaluation of the best policy, and the time that training took\n\n"
        "Ctrl-C keeps the best policy and the state. A run in --output, finished or not, is replaced only with\n"
        "--overwrite.\n\n"
        "  --resume                     continue a run that was stopped, with its own settings\n"
        "  --resume --budget 100        train a finished run for 100 more updates\n"
        "  --resume --budget 60s        train a stopped or finished run for 60 s more, without compiling\n"
        "  --resume --set updates=400   train to 400 updates in total\n\n"
        "A longer training continues as if all its updates had been asked for at the start: the learning rate rises\n"
        "to its value at this point of the longer schedule. The best policy is replaced only by a better one.\n\n"
        "With --library sb3, Stable-Baselines3 trains the paper's network (512-512-256-128, ReLU). The paper's task\n"
        "is `hover-2021`. Such a training keeps no state to resume from.",
        epilog="JAX_COMPILATION_CACHE_DIR=folder keeps compiled programs, so that the next training starts sooner.\n\n"
        + hosts.HELP,
        allow_abbrev=False,
    )
    parser.add_argument("task", metavar="TASK", help=", ".join(TASKS))
    parser.add_argument("--library", default=LIBRARIES[0], help=f"{', '.join(LIBRARIES)} ({LIBRARIES[0]})")
    algorithms, sb3_algorithms = ", ".join(ALGORITHMS), ", ".join(SB3_ALGORITHMS)
    parser.add_argument("--algo", help=f"{algorithms} (bptt; gates: ppo); with sb3 {sb3_algorithms} (ppo)")
    parser.add_argument(
        "--realistic", action="store_true", help="simulate rotor lag, drag, delay, sensor noise, random parameters"
    )
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="train N seeds, each in DIR/seed-K (1)")
    parser.add_argument("--seed", type=int, metavar="K", help="the first seed (0)")
    parser.add_argument(
        "--budget",
        metavar="N|Ns",
        help="number of updates, such as 300 (with sb3 control steps, such as 100000), or time per seed with "
        "compiling, such as 60s, 5m, 2h",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="setting of the learner (worlds, horizon, learning_rate; with sb3 net_arch and arguments of its class) or "
        "of the environment (vehicle, period, drones)",
    )
    parser.add_argument("--episodes", type=int, metavar="N", help="episodes of every evaluation (1000, with sb3 100)")
    parser.add_argument(
        "--output", type=folder, metavar="DIR", help="folder of the run (runs/TASK, runs/TASK-sb3-ALGO)"
    )
    parser.add_argument(
        "--resume", action="store_true", help="continue the run in --output; with --budget train a finished one longer"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace the run in --output, finished or not")
    hosts.add_options(parser)
    parser.add_argument("--no-figure", action="store_true", help="draw no learning curves; needs no matplotlib")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else on stdout")
    parser.set_defaults(run=hosts.on_hosts(_train))


def _train(options: argparse.Namespace) -> int:
    check_choice("library", options.library, LIBRARIES)
    if options.library == "sb3":
        from jaxdrones.cli import train_sb3

        return train_sb3.train(options)
    from jaxdrones.learning import Diverged
    from jaxdrones.training import loop
    from jaxdrones.training.distributed import fail_together
    from jaxdrones.training.run import Run
    from jaxdrones.training.trainer import Trainer

    begin = time.perf_counter()
    with fail_together():
        if not options.no_figure:
            plots.check_matplotlib()
        output = options.output or Path("runs") / options.task
        _check_numbers(options)
        updates, seconds = parse_budget(options.budget, "updates", 300)
        asked = merge_budget("updates", parse_settings(options.set), updates, seconds)
        runs = _runs(options, output)
        with user_mistakes(asked, options.task):
            recipe = _resumed(options, runs, asked, seconds) if options.resume else _fresh(options, runs, output, asked)
            trainer = Trainer(recipe, _episodes(options, runs))
        resumed = [run for run in runs.values() if run.started and options.resume]
        for run in resumed:
            loop.check_resumable(trainer, run)
        for run in (*runs.values(), Run(output)):
            trainer.prepare(run)
    print_line = quiet if options.json else print
    print_line(f"{_headline(recipe)}; compiling")
    trainer.compile()
    made = max((run.sidecar_entry("state", "update") for run in resumed), default=0)
    if seconds is not None:
        spent = 0.0 if options.resume else time.perf_counter() - begin
        if spent > seconds:
            print_warning(
                f"compiling took all of --budget {options.budget}, so one update is made; --resume continues it"
            )
        trainer.fit_budget(seconds - spent, made)
    total = trainer.recipe.config.updates
    print_line(f"compiled in {trainer.compile_seconds:.1f} s; updates: {total}{f', {made} of them made' * bool(made)}")
    if not options.resume:
        for run in (*runs.values(), Run(output)):
            run.clear()

    for seed, run in runs.items():
        if run.finished and run.sidecar_entry("state", "update") >= total:
            continue
        display = ProgressDisplay(total, f"seed {seed}" if len(runs) > 1 else "training", trainer.episodes, print_line)
        try:
            with display:
                loop.train(trainer, run, seed, display.update)
        except KeyboardInterrupt:
            if not run.started:
                return print_error("interrupted before the first update; there is nothing to continue", INTERRUPTED)
            draw_curves(options, {seed: run}, run.folder)
            again = f"jaxdrones train {options.task} --output {output} --resume"
            again += f" --seeds {options.seeds}" * (options.seeds > 1) + f" --seed {min(runs)}" * (min(runs) > 0)
            where = f"interrupted at update {run.sidecar_entry('state', 'update')}"
            return print_error(f"{where}; {remaining_best(run)}; continue with: {again}", INTERRUPTED)
        except Diverged as error:
            draw_curves(options, {seed: run}, run.folder)
            return print_error(
                f"training diverged: {error}, for example --set learning_rate=1e-3; {remaining_best(run)}", 1
            )
    return show_results(options, runs, output)


def _headline(recipe) -> str:
    config = recipe.config
    what = described(recipe)
    return f"{what}: {config.worlds} worlds x {config.horizon} control steps an update"


def _check_numbers(options: argparse.Namespace) -> None:
    check_at_most("seeds", options.seeds, _MAX_SEEDS)
    if options.seed is not None:
        check_seed("seed", options.seed)
        check_seed("the last seed", options.seed + options.seeds - 1)
    if options.episodes is not None:
        check_at_most("episodes", options.episodes, LARGEST_COUNT)
    if options.resume and options.overwrite:
        raise ValueError("--resume and --overwrite are given; one continues a run, the other replaces it")


def _runs(options: argparse.Namespace, output: Path) -> dict:
    """The run of each seed."""
    from jaxdrones.training.run import Run

    run = Run(output)
    if options.seeds > 1:
        if options.resume and run.started:
            raise ValueError(f"{output} holds the training of one seed; leave out --seeds to --resume it")
        first = options.seed or 0
        return {seed: Run(output / f"seed-{seed}") for seed in range(first, first + options.seeds)}
    if options.resume and not run.started:
        raise _nothing_to_resume(run)
    seed = run.sidecar_entry("state", "seed") if options.resume else options.seed or 0
    return {seed: run}


def _nothing_to_resume(run) -> ValueError:
    several = "give --seeds N, or " if list(run.folder.glob("seed-*/state.json")) else ""
    return ValueError(f"{run.folder} holds no training to continue; {several}leave out --resume")


def _fresh(options: argparse.Namespace, runs: dict, output: Path, asked: dict):
    """The recipe that was asked for; raises if it would replace another run."""
    from jaxdrones.training.presets import default_algorithm
    from jaxdrones.training.recipe import Recipe
    from jaxdrones.training.run import Run

    algorithm = default_algorithm(options.task) if options.algo is None else options.algo
    recipe = Recipe.of(options.task, algorithm, options.realistic, **asked)
    for run in (*runs.values(), Run(output)):
        check_free(run, options.overwrite)
    return recipe


def _resumed(options: argparse.Namespace, runs: dict, asked: dict, seconds: float | None):
    """The recipe of the runs, with the number of updates asked for; all other settings have to be the same."""
    from jaxdrones.training.recipe import Recipe

    started = [run for run in runs.values() if run.started]
    if not started:
        raise _nothing_to_resume(next(iter(runs.values())))
    for run in started:
        run.verify("best")
        run.verify("state")
    recipes = [Recipe.from_dict(run.sidecar_entry("state", "recipe")) for run in started]
    folder, recipe = started[0].folder, max(recipes, key=lambda recipe: recipe.config.updates)
    had = {"task": recipe.task, "algo": recipe.algorithm, "realistic": recipe.realistic}
    had |= vars(recipe.config) | recipe.options | {"episodes": started[0].sidecar_entry("state", "episodes")}
    wanted = {"task": options.task, **asked}
    wanted |= {} if options.algo is None else {"algo": options.algo}
    wanted |= {"realistic": True} if options.realistic else {}
    wanted |= {} if options.episodes is None else {"episodes": options.episodes}
    if options.seed is not None and options.seeds == 1:
        had, wanted = had | {"seed": next(iter(runs))}, wanted | {"seed": options.seed}
    updates = wanted.pop("updates", None)
    for name, x in wanted.items():
        if had.get(name) != x:
            raise ValueError(f"{folder} was started with {name} {had.get(name)}, not {x}; leave {name} out to --resume")
    finished = len(started) == len(runs) and all(
        run.finished and run.sidecar_entry("state", "update") >= recipe.config.updates for run in started
    )
    total = _total(recipe.config.updates, updates, options.budget is not None, finished)
    if finished and seconds is None and total == recipe.config.updates:
        raise ValueError(
            f"{folder} is trained to the end, {total} updates; train it longer with --budget N or 60s, or "
            "replace it with --overwrite instead of --resume"
        )
    return dataclasses.replace(recipe, config=dataclasses.replace(recipe.config, updates=total))


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
        raise ValueError(
            f"the run was started with updates {had}, not {asked}; leave updates out to --resume, or give a larger "
            "number by --set updates=N"
        )
    check_at_most("updates", asked, LARGEST_COUNT)
    return asked


def _episodes(options: argparse.Namespace, runs: dict) -> int:
    """Episodes of an evaluation; a resumed run keeps their number, so that its evaluations remain comparable."""
    started = (run.sidecar_entry("state", "episodes") for run in runs.values() if run.started and options.resume)
    return next(started, 1000 if options.episodes is None else options.episodes)
