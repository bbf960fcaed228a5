"""Progress, deadlines and results of `jaxdrones train`."""

import contextlib
import math
import shlex
import sys
import time
from pathlib import Path
from typing import Any

from jaxdrones.cli.common import bar, print_warning
from jaxdrones.cli.report import described, evaluation_table, percent, success
from jaxdrones.cli.train_request import Request
from jaxdrones.envs.explanation import aligned
from jaxdrones.learning.evaluation import score_of, wilson_interval
from jaxdrones.training.plan import best_of
from jaxdrones.training.run import Run
from jaxdrones.visualization import learning_curves


def warn_of_unknown_settings(recipe) -> None:
    """Warn of missing tuned settings for a learner on a task."""
    task = recipe.task + " on any vehicle" * (recipe.realistic == "any")
    print_warning(
        f"there are no tuned settings for {recipe.algorithm} on {task}; if it fails, try "
        "another --algo, --set learning_rate=... or horizon=..., or a longer --budget"
    )


def warn_of_failure(run, report: dict[str, Any]) -> None:
    """Warn of an unsuccessful training, with advice."""
    advice = "try --seeds 3, a longer --budget, another --algo, or a smaller --set learning_rate"
    evaluation = report["evaluation"]
    successes, success, episodes = (evaluation[name] for name in ("successes", "success", "episodes"))
    share = "" if success is None else f" ({percent(success, episodes)} success)"
    if report["best_update"] == 0:
        print_warning(
            f"{run.folder}: nothing was learned, the best policy is the first one, of update 0{share}; {advice}"
        )
    elif successes == 0:
        print_warning(f"{run.folder}: the best policy succeeds in 0 of {episodes:,} episodes; {advice}")


_FIGURE_SECONDS = 2.0  # to draw the learning curves
_TOLERANCE = 1.1  # times the budget, tolerance


class Deadlines:
    """Deadlines of the seeds, with equal shares of the time of --budget."""

    def __init__(self, request: Request, begin: float):
        """Prepare, with the start of the command at `begin`, s on the clock of `time.perf_counter`."""
        self.seconds, self._text, self._begin = request.seconds, request.budget, begin
        self._end = begin + request.seeds * (request.seconds or 0.0)
        self._figure = _FIGURE_SECONDS * (not request.no_figure)
        self._left = request.seeds

    def start(self) -> None:
        """Warn if compilation took the time of a whole run."""
        if self.seconds is not None and time.perf_counter() - self._begin > self.seconds:
            print_warning(f"compilation took all of --budget {self._text}; one update is made, --resume adds more")

    def next(self) -> float | None:
        """End of the next training, s on the clock of `time.perf_counter`; `None` without a limit."""
        if self.seconds is None:
            return None
        now = time.perf_counter()
        deadline = now + (self._end - self._figure - now) / self._left
        self._left -= 1
        return deadline

    def warn_if_missed(self) -> None:
        """Warn if the total time exceeds the budget."""
        spent, budget = time.perf_counter() - self._begin, self._end - self._begin
        if self.seconds is not None and spent > _TOLERANCE * budget + 1:
            print_warning(
                f"the command took {spent:.0f} s, more than {budget:.0f} s of --budget {self._text}: compiling, one "
                "update and three evaluations are the minimum; give a longer --budget or fewer --episodes"
            )


class ProgressDisplay(contextlib.ExitStack):
    """Progress bar, with a line for every evaluation."""

    def __init__(self, total: int | None, what: str, episodes: int, print_line):
        """Prepare; the bar appears with the first call of `update`."""
        super().__init__()
        self._total, self._what, self._episodes, self._print_line = total, what, episodes, print_line
        self._bar: Any = None
        self._evaluated, self._started = "", False

    def update(self, count: int, now: dict[str, float]) -> None:
        """Update the bar, and print the results of an evaluation."""
        if not self._started:
            self._started = True
            self._bar = self.enter_context(bar(self._total, self._what, "update", initial=count))
        speed = _speed(now["steps_per_s"]) if "steps_per_s" in now else ""
        if "evaluated_return" in now:
            self._evaluated = f"return {now['evaluated_return']:.1f}"
            if "success" in now:
                self._evaluated += f", success {percent(now['success'], self._episodes)}"
            of = "" if self._total is None else f"/{self._total}"
            line = f"{self._what}: update {count:4}{of}  {self._evaluated}, "
            line += ", ".join(
                filter(None, (f"median error {now['evaluated_error']:.3f} m", speed, f"{now['seconds']:.1f} s"))
            )
            if self._bar is None or self._bar.disable:
                self._print_line(line)
            else:
                self._bar.write(line, file=sys.stderr if self._print_line is quiet else sys.stdout)
        if self._bar is not None:
            self._bar.update(count - self._bar.n)
            reward = f"reward {now['reward']:.3f}" if "reward" in now else ""
            newest = (self._evaluated, _training_return(now), reward, speed)
            self._bar.set_postfix_str(", ".join(filter(None, newest)))


def _training_return(now: dict[str, float]) -> str:
    if "return" not in now:
        return ""
    return "no episode ended yet" if math.isnan(now["return"]) else f"in training {now['return']:.1f}"


def _speed(steps_per_s: float) -> str:
    return f"{steps_per_s / 1e6:.2f} M steps/s" if steps_per_s >= 1e5 else f"{steps_per_s:.0f} steps/s"


def quiet(_: str) -> None:
    """Print nothing, for --json."""


def remaining_best(run) -> str:
    """Phrase for the best policy of an unfinished training."""
    return f"{run.folder / 'best'}.msgpack is the best policy, of update {run.sidecar_entry('best', 'update')}"


def draw_curves(request: Request, runs: dict, folder: Path) -> list[Path]:
    """Draw the learning curves, unless with --no-figure."""
    if request.no_figure:
        return []
    histories = {f"seed {seed}": run.history() for seed, run in runs.items()}
    kept = {f"seed {seed}": run.sidecar_entry("best", "update") for seed, run in runs.items()}
    recipe = next(iter(runs.values())).recipe()
    episodes = next(iter(runs.values())).sidecar().get("distinct_episodes", 1)
    title = f"training {described(recipe)}"
    interval = (lambda success: wilson_interval(success * episodes, episodes)) if episodes > 1 else None
    learning_curves.save_curves(histories, folder / "curve.png", title, interval, kept)
    return [folder / "curve.png"]


def show_results(request: Request, runs: dict) -> dict[str, Any]:
    """Draw learning curves, choose the best seed, and print the results unless with --json; return them."""
    output = request.output
    reports = {seed: run.report() for seed, run in runs.items()}
    evaluations = [report["evaluation"] for report in reports.values()]
    scores = [score_of(evaluation["success"], evaluation["mean_return"]) for evaluation in evaluations]
    best = list(runs)[best_of(scores, min(evaluation["episodes"] for evaluation in evaluations))]
    run = runs[best]
    if len(runs) > 1:
        about = {entry: run.sidecar_entry("best", entry) for entry in ("run_id", "recipe", "seed", "update")}
        Run(output).remove_report()  # that of an earlier best seed
        Run(output).save_policy("best", run.policy(), **about)
        Run(output).save_report({"run_id": about["run_id"], "best_seed": best, "seeds": list(reports.values())})
    files = [output / "best.msgpack", output / "report.json", *draw_curves(request, runs, output)]
    if not request.json:
        _print_results(output, runs, reports, files)
    warn_of_failure(run, reports[best])
    result = {"task": run.recipe().task, "output": str(output), "best_seed": best, "seeds": list(reports.values())}
    return result | {"files": list(map(str, files))}


def sweep_table(results: list[dict[str, Any]]) -> str:
    """Table of the best policies of the runs of a sweep, given the results of `show_results`."""
    rows = [["run", "return", "success"]]
    for result in results:
        (best,) = (x["evaluation"] for x in result["seeds"] if x["seed"] == result["best_seed"])
        rows.append([result["output"], f"{best['mean_return']:.2f}", success(best)])
    return "all runs of the sweep, their best policies:\n" + aligned(rows)


def _print_results(output: Path, runs: dict, reports: dict[int, dict[str, Any]], files: list[Path]) -> None:
    for seed, report in reports.items():
        spent = report["seconds"]
        early = ""
        if report["stopped_at_success"]:
            stop_at = runs[seed].recipe("last").stop_at
            early = f"; stopped at update {report['updates']}, success {stop_at:g} was reached"
        if len(runs) > 1:
            print(f"seed {seed}:")
        print(
            f"trained in {spent['training']:.1f} s, {spent['training'] + spent['compiling']:.1f} s with compiling; "
            f"{spent['evaluating']:.1f} s for evaluations{early}. The best policy is that of update "
            f"{report['best_update']}:"
        )
        print(evaluation_table(report["evaluation"]))
    print("wrote " + ", ".join(map(str, files)))
    print(f"fly it: {shlex.join(['jaxdrones', 'fly', '--policy', str(output)])}")
