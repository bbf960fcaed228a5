"""`jaxdrones train`."""

import argparse
import ast
import contextlib
import json
import sys
import time
from pathlib import Path

from jaxdrones.cli.common import INTERRUPTED, bar, complain
from jaxdrones.cli.evaluate import described, evaluation_table
from jaxdrones.cli.names import ALGORITHMS
from jaxdrones.envs import TASKS
from jaxdrones.render import plots

_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "train",
        help="train a policy for a task",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Train a policy with settings that were found to work; evaluate the best over many episodes.\n\n"
        "  best, last     policies, each a .msgpack and a .json\n"
        "  state          to --resume from, bit for bit\n"
        "  progress.csv   a line per update; the events file beside it is for TensorBoard\n"
        "  curve.png      how training went\n"
        "  report.json    the evaluation, and what it took\n\n"
        "Ctrl-C keeps the best policy and the state.",
        epilog="JAX_COMPILATION_CACHE_DIR=folder keeps compiled programs, so that a second training starts sooner.",
        allow_abbrev=False,
    )
    parser.add_argument("task", metavar="TASK", help=", ".join(TASKS))
    parser.add_argument("--algo", help=f"{', '.join(ALGORITHMS)} (bptt)")
    parser.add_argument(
        "--realistic", action="store_true", help="rotor lag, drag, delay, sensor noise, parameter ranges"
    )
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="train so many times, in DIR/seed-K (1)")
    parser.add_argument("--seed", type=int, metavar="K", help="the first seed (0)")
    parser.add_argument(
        "--budget", metavar="N|Ns", help="updates of the policy, 300, or time a seed with compiling, 60s, 5m, 2h"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="setting of the learner (worlds, horizon, learning_rate) or of the environment (vehicle, period, drones)",
    )
    parser.add_argument("--episodes", type=int, metavar="N", help="of every evaluation (1000)")
    parser.add_argument("--output", type=Path, metavar="DIR", help="folder of the run (runs/TASK)")
    parser.add_argument("--resume", action="store_true", help="go on with the run in --output, as it was asked for")
    parser.add_argument("--overwrite", action="store_true", help="replace a run in --output that did not finish")
    parser.add_argument("--no-figure", action="store_true", help="draw no learning curve; needs no matplotlib")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else on stdout")
    parser.set_defaults(run=_train)


def _train(options: argparse.Namespace) -> int:
    from jaxdrones.checks import check_whole
    from jaxdrones.learning.runs import Run
    from jaxdrones.learning.training import Diverged, Trainer

    begin = time.perf_counter()
    if not options.no_figure:
        plots.check_matplotlib()
    check_whole("seeds", options.seeds)
    output = options.output or Path("runs") / options.task
    updates, seconds = _budget(options.budget)
    asked = _asked(options, updates)
    runs = _runs(options, output)
    recipe = _resumed(options, runs, asked) if options.resume else _fresh(options, runs, output, asked)
    trainer = Trainer(recipe, _episodes(options, runs))
    for run in (*runs.values(), Run(output)):
        trainer.prepare(run)
        if not options.resume:
            run.clear()
    say = _quiet if options.json else print
    say(f"{_headline(recipe)}; compiling")
    trainer.compile()
    if seconds is not None and not options.resume:
        trainer.fit(seconds - (time.perf_counter() - begin))
    say(f"compiled in {trainer.compile_seconds:.1f} s; updates: {trainer.recipe.config.updates}")

    for seed, run in runs.items():
        if options.resume and run.report() is not None:
            continue
        shown = _Shown(trainer.recipe.config.updates, f"seed {seed}" if len(runs) > 1 else "training", say)
        try:
            with shown:
                trainer.train(run, seed, shown.tell)
        except KeyboardInterrupt:
            if not run.started:
                return complain("interrupted before the first update; there is nothing to go on with", INTERRUPTED)
            _draw(options, {seed: run}, run.folder)
            again = f"jaxdrones train {options.task} --output {output} --resume"
            again += f" --seeds {options.seeds}" * (options.seeds > 1) + f" --seed {min(runs)}" * (min(runs) > 0)
            return complain(
                f"interrupted at update {run.about('state')['update']}; {_kept(run)}; go on with: {again}", INTERRUPTED
            )
        except Diverged as error:
            _draw(options, {seed: run}, run.folder)
            return complain(
                f"training diverged: {error}; {_kept(run)}; try smaller steps, for example --set learning_rate=1e-3", 1
            )
    return _finish(options, runs, output, trainer)


def _finish(options: argparse.Namespace, runs: dict, output: Path, trainer) -> int:
    """Draw, choose the best seed, print."""
    reports = {seed: run.report() for seed, run in runs.items()}
    best = max(reports, key=lambda s: (reports[s]["evaluation"]["success"], reports[s]["evaluation"]["returned"]))
    if len(runs) > 1:
        from jaxdrones.learning.runs import Run

        about = runs[best].about()
        Run(output).save_policy("best", runs[best].policy(), **{k: about[k] for k in ("recipe", "seed", "update")})
        (output / "report.json").write_text(json.dumps({"best_seed": best, "seeds": list(reports.values())}, indent=2))
    files = [output / "best.msgpack", output / "report.json", *_draw(options, runs, output)]
    if options.json:
        result = {"task": options.task, "output": str(output), "best_seed": best, "seeds": list(reports.values())}
        print(json.dumps(result | {"files": list(map(str, files))}))
        return 0
    for seed, report in reports.items():
        spent = report["seconds"]
        if len(runs) > 1:
            print(f"seed {seed}:")
        print(
            f"trained in {spent['training']:.1f} s, {spent['training'] + spent['compiling']:.1f} s with compiling; "
            f"{spent['evaluating']:.1f} s for evaluations. Best of update {report['best_update']}:"
        )
        print(evaluation_table(report["evaluation"]))
    print("wrote " + ", ".join(map(str, files)))
    print(f"fly it: jaxdrones fly --policy {output}")
    return 0


class _Shown(contextlib.ExitStack):
    """A live bar from the first news on, and a line for every evaluation."""

    def __init__(self, total: int, what: str, say):
        super().__init__()
        self._total, self._what, self._say = total, what, say
        self._bar, self._evaluated, self._begun = None, "", False

    def tell(self, update: int, now: dict[str, float]) -> None:
        """Move the bar; say what an evaluation came to."""
        if not self._begun:
            self._begun = True
            self._bar = self.enter_context(bar(self._total, self._what, "update", initial=update))
        pace = f"{now['steps_per_s'] / 1e6:.2f} M steps/s"
        if "success" in now:
            self._evaluated = f"return {now['evaluated_return']:.1f}, success {now['success']:.3f}"
            line = f"{self._what}: update {update:4}/{self._total}  {self._evaluated}, "
            line += f"median error {now['evaluated_error']:.3f} m, {pace}, {now['seconds']:.1f} s"
            if self._bar is None or self._bar.disable:
                self._say(line)
            else:
                self._bar.write(line, file=sys.stderr if self._say is _quiet else sys.stdout)
        if self._bar is not None:
            self._bar.update(update - self._bar.n)
            self._bar.set_postfix_str(", ".join(filter(None, (self._evaluated, f"reward {now['reward']:.3f}", pace))))


def _quiet(_: str) -> None:
    """With --json, stdout is for the object."""


def _headline(recipe) -> str:
    config = recipe.config
    what = described(recipe)
    return f"{what}: {config.worlds} worlds x {config.horizon} control steps an update"


def _budget(text: str | None) -> tuple[int | None, float | None]:
    """Updates, or seconds."""
    if text is None:
        return None, None
    try:
        if text[-1:] in _UNITS:
            seconds = float(text[:-1]) * _UNITS[text[-1]]
            if 0 < seconds < float("inf"):
                return None, seconds
        elif int(text) > 0:
            return int(text), None
    except ValueError:
        pass
    raise ValueError(f"--budget is {text!r}; give updates, for example 300, or time, for example 60s, 5m or 2h")


def _asked(options: argparse.Namespace, updates: int | None) -> dict:
    """What --set and --budget change in the preset."""
    changes = {}
    for text in options.set:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise ValueError(f"--set is {text!r}; give NAME=VALUE, for example worlds=512")
        try:
            changes[name] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            changes[name] = value
    return changes if updates is None else changes | {"updates": updates}


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
    from jaxdrones.learning.runs import Recipe, Run

    recipe = Recipe.of(options.task, options.algo or "bptt", options.realistic, **asked)
    for run in (*runs.values(), Run(output)):
        if run.started and run.report() is None and not options.overwrite:
            raise ValueError(
                f"{run.folder} holds a training that did not finish; go on with --resume, replace it with --overwrite, "
                "or choose another --output"
            )
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
    from jaxdrones.checks import check_whole

    if options.episodes is not None:
        check_whole("episodes", options.episodes)
        return options.episodes
    return next((run.about("state")["episodes"] for run in runs.values() if run.started and options.resume), 1000)


def _kept(run) -> str:
    return f"{run.folder / 'best'}.msgpack is the best policy, of update {run.about()['update']}"


def _draw(options: argparse.Namespace, runs: dict, folder: Path) -> list[Path]:
    """The learning curve, if it is wanted."""
    if options.no_figure:
        return []
    histories = {f"seed {seed}": run.history() for seed, run in runs.items()}
    plots.save_curves(histories, folder / "curve.png", f"training {options.task}")
    return [folder / "curve.png"]
