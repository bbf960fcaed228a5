"""`jaxdrones train`."""

import argparse
import contextlib
import time
from pathlib import Path
from typing import Any

from jaxdrones import assets
from jaxdrones.cli import hosts
from jaxdrones.cli.budget import Deadlines, parse_budget
from jaxdrones.cli.common import INTERRUPTED, folder, print_error, print_warning, run_folder
from jaxdrones.cli.live import LiveTraining, add_live, live_server
from jaxdrones.cli.names import ALGORITHMS
from jaxdrones.cli.report import described
from jaxdrones.cli.settings import add_realistic, asked_settings, user_mistakes
from jaxdrones.cli.train_runs import episodes_of, folders_of, recipe_of, remaining, runs_of
from jaxdrones.cli.training import (
    ProgressDisplay,
    draw_curves,
    merge_budget,
    quiet,
    remaining_best,
    show_results,
    warn_of_unknown_settings,
)
from jaxdrones.envs import TASKS
from jaxdrones.errors import UserError
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
        "  best, last     policies, each a .msgpack and a .json\n"
        "  state          everything that --resume needs to continue, bit for bit\n"
        "  progress.csv   a row for each update; an event file holds the same for TensorBoard\n"
        "  curve.png      learning curves\n"
        "  report.json    the evaluation of the best policy, and the time that training took\n\n"
        "Ctrl-C keeps the best policy and the state. A run in --output, finished or not, is replaced only with\n"
        "--overwrite.\n\n"
        "  --resume                     continue a run that was stopped, with its own settings\n"
        "  --resume --budget 100        train a finished run for 100 more updates\n"
        "  --resume --budget 60s        train a stopped or finished run for 60 s more\n"
        "  --resume --set updates=400   train to 400 updates in total\n\n"
        "A longer training continues as if all its updates had been asked for at the start: the learning rate rises\n"
        "to its value at this point of the longer schedule. The best policy is replaced only by a better one.\n\n"
        "A run of a task or vehicle of your own keeps the text of its file, and flies that text when it is resumed,\n"
        "evaluated or flown: open runs of people you trust alone.",
        epilog="JAX_COMPILATION_CACHE_DIR=folder keeps compiled programs, so that the next training starts sooner.\n\n"
        + hosts.HELP,
        allow_abbrev=False,
    )
    parser.add_argument(
        "task", metavar="TASK", help=f"{', '.join(TASKS)}; or file.py:function, a function of yours that returns a task"
    )
    parser.add_argument("--vehicle", help=f"{', '.join(assets.vehicles())} or a .urdf file (cf2x)")
    parser.add_argument("--algo", help=f"{', '.join(ALGORITHMS)} (bptt; gates: ppo)")
    add_realistic(parser)
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="train N seeds, each in DIR/seed-K (1)")
    parser.add_argument("--seed", type=int, metavar="K", help="the first seed (0)")
    parser.add_argument(
        "--budget",
        metavar="N|Ns",
        help="number of updates, such as 300, or time per seed, such as "
        "60s, 5m, 2h, for everything: compiling, updates, evaluations and files",
    )
    parser.add_argument(
        "--stop-at",
        type=float,
        metavar="RATE",
        help="stop when the lower bound of the success rate, such as 0.99, was reached in three evaluations in a row; "
        "evaluates more often",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="setting of the learner (worlds, horizon, learning_rate) or of the environment (vehicle, period, drones)",
    )
    parser.add_argument("--episodes", type=int, metavar="N", help="episodes of every evaluation (1000)")
    parser.add_argument("--output", type=folder, metavar="DIR", help="folder of the run (runs/TASK)")
    parser.add_argument(
        "--resume", action="store_true", help="continue the run in --output; with --budget train a finished one longer"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace the run in --output, finished or not")
    add_live(parser, "show an episode in the browser after every evaluation, and the learning curve")
    hosts.add_options(parser)
    parser.add_argument("--no-figure", action="store_true", help="draw no learning curves; needs no matplotlib")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else on stdout")
    parser.set_defaults(run=hosts.on_hosts(_train))


def _train(options: argparse.Namespace) -> int:
    from jaxdrones.training import loop
    from jaxdrones.training.distributed import fail_together
    from jaxdrones.training.lock import locked
    from jaxdrones.training.run import Run
    from jaxdrones.training.trainer import Trainer

    begin = time.perf_counter()
    with contextlib.ExitStack() as stack:
        with fail_together():
            if not options.no_figure:
                plots.check_matplotlib()
            output = options.output or run_folder(options.task)
            _check_numbers(options)
            updates, seconds = parse_budget(options.budget)
            asked = merge_budget("updates", asked_settings(options), updates, seconds)
            for folder in folders_of(options, output):
                stack.enter_context(locked(folder, print_warning))
            runs = runs_of(options, output)
            with user_mistakes(asked, options.task):
                recipe = recipe_of(options, runs, output, asked, seconds)
                trainer = Trainer(recipe, episodes_of(options, runs))
            resumed = [run for run in runs.values() if run.started and options.resume]
            for run in resumed:
                loop.check_resumable(trainer, run)
            for run in (*runs.values(), Run(output)):
                trainer.prepare(run)
        return _train_runs(options, runs, output, trainer, Deadlines(options, begin, seconds, len(runs)))


def _train_runs(options: argparse.Namespace, runs: dict, output: Path, trainer: Any, deadlines: Deadlines) -> int:
    """Train every run in its locked folder, and print the results."""
    from jaxdrones.learning import Diverged
    from jaxdrones.training import loop
    from jaxdrones.training.presets import settings_known
    from jaxdrones.training.run import Run

    recipe, print_line = trainer.recipe, quiet if options.json else print
    known = settings_known(recipe.task, recipe.algorithm, recipe.realistic == "any")
    if not options.resume and not known:
        warn_of_unknown_settings(recipe)
    print_line(f"{_headline(recipe)}; compiling")
    trainer.compile()
    made = {
        seed: run.sidecar_entry("state", "update") if options.resume and run.started else 0
        for seed, run in runs.items()
    }
    deadlines.start()
    total = recipe.config.updates if deadlines.seconds is None else None
    so_far = f", {max(made.values())} of them made" * (max(made.values()) > 0)
    print_line(f"compiled in {trainer.compile_seconds:.1f} s; updates: {total or 'as many as the time allows'}{so_far}")
    if not options.resume:
        for run in (*runs.values(), Run(output)):
            run.clear()

    with live_server(options) as live:
        for seed, run in remaining(runs, recipe.config.updates, deadlines.seconds).items():
            display = ProgressDisplay(
                total, f"seed {seed}" if len(runs) > 1 else "training", trainer.episodes, print_line
            )
            on_progress = display.update
            if live:
                what = described(recipe) + f", seed {seed}" * (len(runs) > 1)
                on_progress = LiveTraining(live, trainer, run, what, on_progress).update
            try:
                with display:
                    loop.train(trainer, run, seed, on_progress, deadlines.next())
            except KeyboardInterrupt:
                if not (run.folder / "last.json").exists():
                    return print_error("interrupted before the first update; there is nothing to continue", INTERRUPTED)
                draw_curves(options, {seed: run}, run.folder)
                where = f"interrupted at update {run.sidecar_entry('last', 'update')}; {remaining_best(run)}"
                if not run.started:
                    return print_error(where, INTERRUPTED)
                again = f"jaxdrones train {options.task} --output {output} --resume"
                again += f" --seeds {options.seeds}" * (options.seeds > 1) + f" --seed {min(runs)}" * (min(runs) > 0)
                return print_error(f"{where}; continue with: {again}", INTERRUPTED)
            except Diverged as error:
                draw_curves(options, {seed: run}, run.folder)
                return print_error(
                    f"training diverged: {error}, for example --set learning_rate=1e-3; {remaining_best(run)}", 1
                )
    code = show_results(options, runs, output)
    deadlines.warn_if_missed()
    return code


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
        raise UserError("--resume and --overwrite are given; one continues a run, the other replaces it")
