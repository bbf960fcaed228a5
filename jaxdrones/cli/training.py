"""What a training at the shell takes, shows and leaves behind, whichever library trains."""

import argparse
import ast
import contextlib
import sys
from pathlib import Path
from typing import Any

from jaxdrones.cli.common import as_json, bar
from jaxdrones.cli.evaluate import evaluation_table, percent
from jaxdrones.limits import LARGEST_COUNT
from jaxdrones.render import plots

_ARGUMENTS = ("cls", "task", "algorithm", "realistic")  # of `Recipe.of`, which other options of the command say
_LONGEST = 3.6e6  # s
_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}


def budget(text: str | None, unit: str, example: int) -> tuple[int | None, float | None]:
    """A number of `unit`, or seconds."""
    if text is None:
        return None, None
    try:
        if text[-1:] in _UNITS:
            seconds = float(text[:-1]) * _UNITS[text[-1]]
            if 0 < seconds <= _LONGEST:
                return None, seconds
        elif 0 < int(text) <= LARGEST_COUNT:
            return int(text), None
    except ValueError:
        pass
    raise ValueError(
        f"--budget is {text!r}; give {unit}, for example {example}, or time up to 1000h, for example 60s, 5m or 2h"
    )


def settings(texts: list[str]) -> dict[str, Any]:
    """Name -> value of every --set; of a name that is given twice, the last."""
    changes: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise ValueError(f"--set is {text!r}; give NAME=VALUE, for example worlds=512")
        if name in _ARGUMENTS:
            raise ValueError(
                f"--set {name} is no setting of a learner or of an environment; see jaxdrones train --help"
            )
        changes[name] = _value(value)
    return changes


def _value(text: str) -> Any:
    """A Python literal, or else a name; `nan` and `inf` are numbers."""
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, RecursionError, MemoryError):
        return float(text) if text.strip("+-") in ("nan", "inf") else text


@contextlib.contextmanager
def fitting(changes: dict[str, Any], task: str):
    """Settings that break what is built with them are a mistake in what was asked.

    Raises:
        ValueError: in place of what Python or JAX said of them.
    """
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError) as error:
        if not changes:
            raise
        given = ", ".join(f"{name}={x}" for name, x in changes.items())
        raise ValueError(f"--set {given} does not fit {task}: {error}") from error


def once(name: str, changes: dict[str, Any], number: int | None, seconds: float | None) -> dict[str, Any]:
    """The changes, and the number that --budget gave for one of them.

    Raises:
        ValueError: that one is changed by --set too.
    """
    if name in changes and (number is not None or seconds is not None):
        raise ValueError(f"--set {name}={changes[name]} is given beside --budget; give one of them")
    return changes if number is None else changes | {name: number}


def check_free(run, overwrite: bool) -> None:
    """Raise if files of a run would be lost."""
    if overwrite or not run.files:
        return
    if run.finished:
        what, again = "a finished training", "train it longer with --resume --budget N, " if run.started else ""
    else:
        what, again = "a training that did not finish", "go on with --resume, " if run.started else ""
    raise ValueError(f"{run.folder} holds {what}; {again}replace it with --overwrite, or choose another --output")


class Shown(contextlib.ExitStack):
    """A live bar from the first news on, and a line for every evaluation."""

    def __init__(self, total: int | None, what: str, episodes: int, say, unit: str = "update"):
        """Show nothing yet.

        Args:
            total: number of `unit` to come, if that is known.
            what: is trained.
            episodes: of an evaluation.
            say: prints a line.
            unit: what is counted.
        """
        super().__init__()
        self._total, self._what, self._episodes, self._say, self._unit = total, what, episodes, say, unit
        self._bar: Any = None
        self._evaluated, self._begun = "", False

    def tell(self, count: int, now: dict[str, float]) -> None:
        """Move the bar; say what an evaluation came to."""
        if not self._begun:
            self._begun = True
            self._bar = self.enter_context(bar(self._total, self._what, self._unit, initial=count))
        pace = _pace(now["steps_per_s"])
        if "success" in now:
            success = percent(now["success"], self._episodes)
            self._evaluated = f"return {now['evaluated_return']:.1f}, success {success}"
            of = "" if self._total is None else f"/{self._total}"
            line = f"{self._what}: {self._unit} {count:4}{of}  {self._evaluated}, "
            line += f"median error {now['evaluated_error']:.3f} m, {pace}, {now['seconds']:.1f} s"
            if self._bar is None or self._bar.disable:
                self._say(line)
            else:
                self._bar.write(line, file=sys.stderr if self._say is quiet else sys.stdout)
        if self._bar is not None:
            self._bar.update(count - self._bar.n)
            self._bar.set_postfix_str(", ".join(filter(None, (self._evaluated, f"reward {now['reward']:.3f}", pace))))


def _pace(steps_per_s: float) -> str:
    return f"{steps_per_s / 1e6:.2f} M steps/s" if steps_per_s >= 1e5 else f"{steps_per_s:.0f} steps/s"


def quiet(_: str) -> None:
    """With --json, stdout is for the object."""


def kept(run) -> str:
    """Which policy an unfinished training leaves."""
    return f"{run.folder / 'best'}.{run.policy_suffix} is the best policy, of update {run.told('best', 'update')}"


def draw(options: argparse.Namespace, runs: dict, folder: Path) -> list[Path]:
    """The learning curve, if it is wanted."""
    if options.no_figure:
        return []
    histories = {f"seed {seed}": run.history() for seed, run in runs.items()}
    recipe = next(iter(runs.values())).recipe()
    plots.save_curves(histories, folder / "curve.png", f"training {recipe.task} by {recipe.learner}")
    return [folder / "curve.png"]


def finish(options: argparse.Namespace, runs: dict, output: Path) -> int:
    """Draw, choose the best seed, print.

    Args:
        options: of the command line.
        runs: seed -> run.
        output: where the figure goes and, of several seeds, the best.
    """
    from jaxdrones.training.loop import best_of, score_of
    from jaxdrones.training.runs import Run

    reports = {seed: run.report() for seed, run in runs.items()}
    evaluations = [report["evaluation"] for report in reports.values()]
    scores = [score_of(evaluation["success"], evaluation["returned"]) for evaluation in evaluations]
    best = list(runs)[best_of(scores, min(evaluation["episodes"] for evaluation in evaluations))]
    run = runs[best]
    if len(runs) > 1:
        about = {entry: run.told("best", entry) for entry in ("recipe", "seed", "update")}
        Run(output).save_policy("best", run.policy(), **about)
        Run(output).save_report({"best_seed": best, "seeds": list(reports.values())})
    files = [output / f"best.{run.policy_suffix}", output / "report.json", *draw(options, runs, output)]
    if options.json:
        result = {"task": run.recipe().task, "output": str(output), "best_seed": best, "seeds": list(reports.values())}
        print(as_json(result | {"files": list(map(str, files))}))
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
