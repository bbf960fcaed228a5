"""`jaxdrones train`."""

import argparse
import time
from pathlib import Path

from jaxdrones.checks import check_choice, check_whole
from jaxdrones.cli import hosts
from jaxdrones.cli.common import INTERRUPTED, complain
from jaxdrones.cli.evaluate import described
from jaxdrones.cli.names import ALGORITHMS, LIBRARIES, SB3_ALGORITHMS
from jaxdrones.cli.training import Shown, budget, check_free, draw, finish, kept, quiet, settings
from jaxdrones.envs import TASKS
from jaxdrones.render import plots


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
        "Ctrl-C keeps the best policy and the state.\n\n"
        "With --library sb3, Stable-Baselines3 trains the paper's network (512-512-256-128, ReLU); `hover` then is\n"
        "`paper-hover`, the one-dimensional hover of the paper's equation 12, and there is no state to resume from.",
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
    parser.add_argument("--output", type=Path, metavar="DIR", help="folder of the run (runs/TASK, runs/TASK-sb3-ALGO)")
    parser.add_argument("--resume", action="store_true", help="go on with the run in --output, as it was asked for")
    parser.add_argument("--overwrite", action="store_true", help="replace a run in --output that did not finish")
    hosts.add_options(parser)
    parser.add_argument("--no-figure", action="store_true", help="draw no learning curve; needs no matplotlib")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else on stdout")
    parser.set_defaults(run=hosts.together(_train))


def _train(options: argparse.Namespace) -> int:
    check_choice("library", options.library, LIBRARIES)
    if options.library == "sb3":
        from jaxdrones.cli import train_sb3

        return train_sb3.train(options)
    from jaxdrones.learning.hosts import checked
    from jaxdrones.learning.runs import Run
    from jaxdrones.learning.training import Diverged, Trainer

    begin = time.perf_counter()
    with checked():
        if not options.no_figure:
            plots.check_matplotlib()
        check_whole("seeds", options.seeds)
        output = options.output or Path("runs") / options.task
        updates, seconds = budget(options.budget, "updates", 300)
        asked = settings(options.set) | ({} if updates is None else {"updates": updates})
        runs = _runs(options, output)
        recipe = _resumed(options, runs, asked) if options.resume else _fresh(options, runs, output, asked)
        trainer = Trainer(recipe, _episodes(options, runs))
        for run in (*runs.values(), Run(output)):
            trainer.prepare(run)
            if not options.resume:
                run.clear()
    say = quiet if options.json else print
    say(f"{_headline(recipe)}; compiling")
    trainer.compile()
    if seconds is not None and not options.resume:
        trainer.fit(seconds - (time.perf_counter() - begin))
    say(f"compiled in {trainer.compile_seconds:.1f} s; updates: {trainer.recipe.config.updates}")

    for seed, run in runs.items():
        if options.resume and run.report() is not None:
            continue
        shown = Shown(trainer.recipe.config.updates, f"seed {seed}" if len(runs) > 1 else "training", say)
        try:
            with shown:
                trainer.train(run, seed, shown.tell)
        except KeyboardInterrupt:
            if not run.started:
                return complain("interrupted before the first update; there is nothing to go on with", INTERRUPTED)
            draw(options, {seed: run}, run.folder)
            again = f"jaxdrones train {options.task} --output {output} --resume"
            again += f" --seeds {options.seeds}" * (options.seeds > 1) + f" --seed {min(runs)}" * (min(runs) > 0)
            return complain(
                f"interrupted at update {run.about('state')['update']}; {kept(run)}; go on with: {again}", INTERRUPTED
            )
        except Diverged as error:
            draw(options, {seed: run}, run.folder)
            return complain(
                f"training diverged: {error}; {kept(run)}; try smaller steps, for example --set learning_rate=1e-3", 1
            )
    return finish(options, runs, output)


def _headline(recipe) -> str:
    config = recipe.config
    what = described(recipe)
    return f"{what}: {config.worlds} worlds x {config.horizon} control steps an update"


def _runs(options: argparse.Namespace, output: Path) -> dict:
    """Seed -> run."""
    from jaxdrones.learning.runs import Run

    if options.seeds > 1:
        first = options.seed or 0
        return {seed: Run(output / f"seed-{seed}") for seed in range(first, first + options.seeds)}
    run = Run(output)
    if options.resume and not run.started:
        raise ValueError(f"{output} holds no training to go on with; leave out --resume")
    seed = run.about("state")["seed"] if options.resume else options.seed or 0
    return {seed: run}


def _fresh(options: argparse.Namespace, runs: dict, output: Path, asked: dict):
    """The recipe that is asked for, if it may be written where it is to go."""
    from jaxdrones.learning.presets import algorithm_for
    from jaxdrones.learning.runs import Recipe, Run

    recipe = Recipe.of(options.task, options.algo or algorithm_for(options.task), options.realistic, **asked)
    for run in (*runs.values(), Run(output)):
        check_free(run, options.overwrite)
    return recipe


def _resumed(options: argparse.Namespace, runs: dict, asked: dict):
    """The recipe that the runs began with; what is asked for must not differ."""
    from jaxdrones.learning.runs import Recipe

    started = [run for run in runs.values() if run.started]
    if not started:
        raise ValueError(f"{next(iter(runs.values())).folder} holds no training to go on with; leave out --resume")
    folder, recipe = started[0].folder, Recipe.from_dict(started[0].about("state")["recipe"])
    if all(run.report() is not None for run in runs.values()):
        raise ValueError(f"{folder} is trained to the end; leave out --resume to train anew")
    had = {"task": recipe.task, "algo": recipe.algorithm, "realistic": recipe.realistic}
    had |= vars(recipe.config) | recipe.options
    wanted = {"task": options.task, **asked}
    wanted |= {"algo": options.algo} if options.algo else {}
    wanted |= {"realistic": True} if options.realistic else {}
    if options.seed is not None and options.seeds == 1:
        had, wanted = had | {"seed": next(iter(runs))}, wanted | {"seed": options.seed}
    for name, x in wanted.items():
        if had.get(name) != x:
            raise ValueError(f"{folder} began with {name} {had.get(name)}, not {x}; leave that out to --resume")
    return recipe


def _episodes(options: argparse.Namespace, runs: dict) -> int:
    """Of an evaluation; when resuming, as many as before, so that the best stays comparable."""
    if options.episodes is not None:
        check_whole("episodes", options.episodes)
        return options.episodes
    return next((run.about("state")["episodes"] for run in runs.values() if run.started and options.resume), 1000)
