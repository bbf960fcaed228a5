"""`jaxdrones train`."""

import argparse
import contextlib
import io
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxdrones import arguments
from jaxdrones.cli import machine, train_output
from jaxdrones.cli.common import INTERRUPTED, folder, print_error, print_warning, run_folder
from jaxdrones.cli.live import add_live, live_server, show_training
from jaxdrones.cli.options import add_drones, add_no_figure, add_output, add_set, add_vehicle, option, switch
from jaxdrones.cli.report import described
from jaxdrones.cli.settings import add_realistic, user_mistakes
from jaxdrones.cli.train_request import Request, remaining
from jaxdrones.envs import TASKS
from jaxdrones.errors import UserError
from jaxdrones.learning import Diverged
from jaxdrones.learning.loggers import named_loggers
from jaxdrones.training import distributed, loop
from jaxdrones.training.algorithms import ALGORITHMS
from jaxdrones.training.distributed import fail_together
from jaxdrones.training.lock import locked
from jaxdrones.training.presets import settings_known
from jaxdrones.training.run import Run
from jaxdrones.training.trainer import Trainer
from jaxdrones.visualization import plots
from jaxdrones.writing import as_json

_SEEDS = arguments.whole(limit=1000)
_HOSTS_HELP = (
    "Worlds are sharded over all devices. Each core of a CPU counts as a device, up to four; JAX_NUM_CPU_DEVICES=N\n"
    "sets another number. On several hosts, start the same command on each, with a\n"
    "different --host. Host 0 writes the files; to --resume, each host needs a copy of the folder:\n"
    "  jaxdrones train hover --hosts 2 --host 0 --coordinator 127.0.0.1:9911"
)


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "train",
        help="train a policy for a task",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Train a policy with tuned settings, and evaluate the best one.\n\n"
        "The command writes these files:\n\n"
        "  best, last     policies, each a .msgpack and a .json\n"
        "  state          complete state of the training, for --resume\n"
        "  progress.csv   a row for the untrained policy and for each update\n"
        "  curve.png      learning curves\n"
        "  report.json    evaluation of the best policy, and duration of the training\n"
        "  history        policies of all evaluations, with --keep-history\n\n"
        "Ctrl-C or SIGTERM keeps the best policy and the state. A run in --output, finished or not, is replaced only\n"
        "with --overwrite.\n\n"
        "  --resume                     continue a run that was stopped, with its own settings\n"
        "  --resume --budget 100        train a finished run for 100 more updates\n"
        "  --resume --budget 60s        train a stopped or finished run for 60 s more\n"
        "  --resume --set updates=400   train to 400 updates in total\n\n"
        "An extended training follows the schedule of its new length: the learning rate rises to its value at this\n"
        "point of that schedule. The best policy is replaced only by a better one.\n\n"
        "A run with your own task or vehicle keeps the text of its file, and executes that text when it is resumed,\n"
        "evaluated or flown: open only runs that you trust.",
        epilog=_HOSTS_HELP,
    )
    option(parser, "task TASK", "{}; or file.py:function, a function that returns a task", known=TASKS)
    task = parser.add_argument_group("task and learner")
    schedule = parser.add_argument_group("schedule")
    files = parser.add_argument_group("files and output")
    several = parser.add_argument_group("several hosts")
    add_drones(task)
    add_vehicle(task)
    add_realistic(task)
    option(task, "--algo NAME", "{} (bptt; gates: ppo)", known=ALGORITHMS)
    add_set(
        task, "setting of the learner (worlds, horizon, learning_rate) or option of the environment (period, action)"
    )
    option(schedule, "--seeds N", "train N seeds, each in DIR/seed-K", int, 1, check=_SEEDS)
    option(schedule, "--seed K", "first seed (0)", int, check=arguments.seed)
    option(
        schedule,
        "--from RUN",
        "start from the best policy of a run or a bundled one, with a new optimizer, not from random parameters; "
        "vehicle and options are those of this command, not of RUN",
        folder,
        dest="start_from",
    )
    option(schedule, "--budget N|Ns", "number of updates, such as 300, or total time per seed, such as 60s, 5m or 2h")
    option(
        schedule,
        "--stop-at RATE",
        "stop when three consecutive evaluations reach this lower bound of the success rate, such as 0.99; "
        "evaluates more often",
        float,
    )
    option(
        schedule,
        "--sweep NAME=VALUE,VALUE",
        "train once for each value of a setting, such as learning_rate=1e-3,3e-3, each in its own folder in DIR; "
        "several sweeps train all combinations",
        default=[],
        action="append",
    )
    option(schedule, "--episodes N", "episodes per evaluation (1000)", int, check=arguments.count)
    option(
        files,
        "--config FILE",
        "TOML file of options by their long names, such as seeds = 3, with tables [set] and [sweep]; options of "
        "the command line override it",
    )
    add_output(files, "folder of the run (runs/TASK)")
    switch(files, "--resume", "continue the run in --output; with --budget train a finished one longer")
    switch(files, "--overwrite", "replace the run in --output, finished or not")
    switch(files, "--keep-history", "keep the policies of all evaluations, for `jaxdrones view RUN --history`")
    option(files, "--log NAME,NAME", "log the metrics of every update with tensorboard, wandb or mlflow, if installed")
    add_live(files, "show learning curve and an episode in the browser after every evaluation")
    add_no_figure(files)
    option(several, "--hosts N", "number of processes (1)", int)
    option(several, "--host I", "number of this process, from 0", int)
    option(several, "--coordinator ADDRESS:PORT", "address and free port of host 0")
    parser.set_defaults(run=_on_hosts)


def _on_hosts(options: argparse.Namespace) -> int:
    """Train on one or several hosts; only the first one prints and keeps its files."""
    hosts = (options.hosts, options.host, options.coordinator)
    if hosts == (None, None, None):
        machine.use_all_cores()
        return _train(options)
    if None in hosts:
        raise UserError("give all of --hosts, --host and --coordinator, or none; see jaxdrones train --help")
    if options.live is not None:
        raise UserError("--live is given with --hosts; leave one of them out")
    with contextlib.ExitStack() as stack:
        stack.enter_context(distributed.join_hosts(*hosts))
        if options.host > 0:
            stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
            copy = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "run"
            output = options.output or run_folder(options.task)
            if options.resume and output.is_dir():
                shutil.copytree(output, copy)
            options.output, options.no_figure, options.log = copy, True, None
        distributed.wait_for_hosts("copied")
        return _train(options)


def _train(options: argparse.Namespace) -> int:
    begin = time.perf_counter()
    with fail_together():
        if not options.no_figure:
            plots.check_matplotlib()
        requests = Request.of(options).swept()
        for request in requests if len(requests) > 1 else ():  # a mistake in the last one is found before the first
            with user_mistakes(request.settings, request.task):
                request.recipe(request.runs())
    results: list[dict[str, Any]] = []
    code = 0
    for request in requests:
        code = _train_row(request, begin, results)
        if code:
            break
        begin = time.perf_counter()
    if options.json and results:
        print(as_json({"runs": results} if options.sweep else results[0]))
    elif len(results) > 1:
        print(train_output.sweep_table(results))
    return code


def _train_row(request: Request, begin: float, results: list) -> int:
    with contextlib.ExitStack() as stack:
        with fail_together():
            for folder in dict.fromkeys((request.output, *request.folders.values())):
                stack.enter_context(locked(folder, print_warning))
            runs = request.runs()
            with user_mistakes(request.settings, request.task):
                recipe = request.recipe(runs)
                trainer = Trainer(recipe, request.episodes_of(runs), request.first_policy(recipe))
            for run in runs.values():
                if run.started and request.resume:
                    loop.check_resumable(trainer, run)
            for run in (*runs.values(), Run(request.output)):
                run.prepare(trainer.disk_size)
        return _train_runs(request, runs, trainer, train_output.Deadlines(request, begin), results)


def _train_runs(
    request: Request, runs: dict, trainer: Any, deadlines: train_output.Deadlines, results: list[dict[str, Any]]
) -> int:
    print_line = train_output.quiet if request.json else print
    config, what = trainer.recipe.config, described(trainer.recipe) + f", {request.row}" * bool(request.row)
    _compile(request, runs, trainer, what, print_line)
    deadlines.start()
    replaced = [] if request.resume else [*runs.values(), Run(request.output)]
    to_train = remaining(runs, config.updates, request.seconds) if request.resume else runs

    with live_server(request.live, request.json) as live:
        for seed, run in to_train.items():
            label = f"seed {seed}" if len(runs) > 1 else "training"
            display = train_output.ProgressDisplay(_updates(request, config), label, trainer.episodes, print_line)
            on_progress: Callable = display.update
            if live:
                title = what + f", seed {seed}" * (len(runs) > 1)
                on_progress = show_training(live, trainer, run, title, on_progress)
            try:
                with named_loggers(request.log, run.folder) as loggers, display:
                    while replaced:  # the first loggers have started
                        replaced.pop().clear()
                    loop.train(trainer, run, seed, on_progress, deadlines.next(), loggers, request.keep_history)
            except KeyboardInterrupt:
                return _interrupted(request, seed, run)
            except Diverged as error:
                train_output.draw_curves(request, {seed: run}, run.folder)
                return print_error(f"training diverged: {error}; {train_output.remaining_best(run)}", 1)
    results.append(train_output.show_results(request, runs))
    deadlines.warn_if_missed()
    return 0


def _compile(request: Request, runs: dict, trainer: Any, what: str, print_line: Callable) -> None:
    recipe, config = trainer.recipe, trainer.recipe.config
    if not request.resume and not settings_known(recipe.task, recipe.algorithm, recipe.realistic == "any"):
        train_output.warn_of_unknown_settings(recipe)
    print_line(f"{what}: {config.worlds} worlds x {config.horizon} control steps an update; compiling")
    trainer.compile()
    started = [run for run in runs.values() if request.resume and run.started]
    made = max((run.sidecar_entry("state", "update") for run in started), default=0)
    updates = f"{_updates(request, config) or 'as many as the time allows'}" + f", {made} of them made" * (made > 0)
    print_line(f"compiled in {trainer.compile_seconds:.1f} s; updates: {updates}")


def _updates(request: Request, config: Any) -> int | None:
    """Number of updates; `None` with a budget of time."""
    return config.updates if request.seconds is None else None


def _interrupted(request: Request, seed: int, run: Any) -> int:
    if not (run.folder / "last.json").exists():
        return print_error("interrupted before the first update; there is nothing to continue", INTERRUPTED)
    train_output.draw_curves(request, {seed: run}, run.folder)
    where = f"interrupted at update {run.sidecar_entry('last', 'update')}; {train_output.remaining_best(run)}"
    return print_error(where + f"; continue with: {request.again}" * run.started, INTERRUPTED)
