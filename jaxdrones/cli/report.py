"""Formatting of results: tables, JSON, success rates and evaluations."""

import argparse
import math
import textwrap
from typing import Any

import numpy as np

from jaxdrones.envs.explanation import aligned
from jaxdrones.training.presets import realism
from jaxdrones.writing import as_json, finite

_COLUMNS = {  # result: (heading, format)
    "drone": ("drone", "{}"),
    "controller": ("controller", "{}"),
    "rms_error_m": ("rms (m)", "{:.4f}"),
    "peak_error_m": ("peak (m)", "{:.4f}"),
    "steady_error_m": ("steady (m)", "{:.4f}"),
    "rms_error_m_s": ("rms (m/s)", "{:.4f}"),
    "peak_error_m_s": ("peak (m/s)", "{:.4f}"),
    "steady_error_m_s": ("steady (m/s)", "{:.4f}"),
    "settled_after_s": ("settling (s)", "{:.2f}"),
    "lowest_z_m": ("z min (m)", "{:.4f}"),
    "highest_z_m": ("z max (m)", "{:.4f}"),
    "peak_vz_m_s": ("vz max (m/s)", "{:.4f}"),
    "peak_speed_m_s": ("|v| max (m/s)", "{:.4f}"),
    "rpm_std": ("RPM std", "{:.1f}"),
    "t_s": ("t (s)", "{:.2f}"),
    "pos_m": ("position (m)", "{:.2e}"),
    "vel_m_s": ("velocity (m/s)", "{:.2e}"),
    "angle_rad": ("attitude (rad)", "{:.2e}"),
    "omega_rad_s": ("rates (rad/s)", "{:.2e}"),
    "rpm": ("rotors (RPM)", "{:.2e}"),
}


def print_results(options: argparse.Namespace, results: dict[str, Any], *lines: Any) -> None:
    """Print results: one line of JSON with --json, else lines of text that are not `None`."""
    print(as_json(results) if options.json else "\n".join(str(line) for line in lines if line is not None))


def listed(results: dict[str, Any]) -> str:
    """Names and numbers in one line."""
    shown = {name: f"{x:d}" if isinstance(x, int) else f"{x:g}" for name, x in results.items()}
    return ", ".join(f"{name.replace('_', ' ')} {x}" for name, x in shown.items())


def summary(results: list[dict]) -> list[dict]:
    """Lowest, median and highest value of every column of the results of many drones."""
    quantiles = {"lowest": 0.0, "median": 0.5, "highest": 1.0}

    def of_drones(name: str, share: float) -> float | None:
        known = [row[name] for row in results if row[name] is not None]
        return float(np.quantile(known, share)) if known else None

    names = [name for name in results[0] if name != "drone"]
    return [{"drone": which} | {name: of_drones(name, share) for name in names} for which, share in quantiles.items()]


def table(results: list[dict]) -> str:
    """Table of results, one line per drone."""
    names = list(results[0])
    rows = [[_COLUMNS[name][0] for name in names]]
    rows += [
        ["-" if finite(row[name]) is None else _COLUMNS[name][1].format(row[name]) for name in names] for row in results
    ]
    return textwrap.dedent(aligned(rows, str.rjust))


def described(recipe, **more: Any) -> str:
    """Title of a recipe: task, learner, options and the entries of `more`, such as `hover by bptt`."""
    options = "".join(f", {name} {x}" for name, x in (recipe.options | more).items())
    return f"{recipe.task} by {recipe.algorithm}{realism(recipe.realistic)}{options}"


def evaluation_table(report: dict) -> str:
    """Table of the entries of `report_as_dict`."""
    trials, error = trials_of(report), report["final_error_percentiles"]
    ends = ", ".join(f"{name} {percent(share, trials)}" for name, share in report["end_rates"].items()) or "none"
    others = ", ".join(f"{name} {x:.3g}" for name, x in report["final_metrics"].items() if name not in ("error",))
    rows = [
        ["episodes", f"{_counted(report)}, {report['mean_length']:.2f} s long on average"],
        ["success", success(report)],
        [
            "final error",
            f"median {_length(error['50'])}, 95 % {_length(error['95'])}, 99 % {_length(error['99'])}",
        ],
        ["rms error", f"{_length(report['rms_error'])} over the last four fifths"],
        ["return", f"{report['mean_return']:.2f}"],
        ["ended early", ends],
        ["final metrics", others],
    ]
    return aligned([row for row in rows if row[1]])


def success(report: dict) -> str:
    """Success rate, count and interval, such as `99.99 %, 9,999 of 10,000, 95 % interval 99.943 to 99.998 %`."""
    if report["success"] is None:
        return "the task has no criterion of success"
    trials, interval = trials_of(report), report["success_interval"]
    rate = f"{percent(report['success'], trials)}, {round(report['success'] * trials):,} of {trials:,}"
    rate += " drones" * (trials != report["episodes"])
    if interval is None:
        return f"{rate}, one distinct episode without an interval"
    low, high = (100 * x for x in interval)
    digits = _digits(trials) + 1
    return f"{rate}, 95 % interval {low:.{digits}f} to {high:.{digits}f} %"


def trials_of(report: dict) -> int:
    """Number of episodes, or of drones in a task whose drones end one by one; see `Report.trials`."""
    return report.get("trials", report["episodes"])


def _counted(report: dict) -> str:
    """Number of episodes, and of distinct ones if different."""
    episodes, distinct = report["episodes"], report["distinct_episodes"]
    if distinct == episodes:
        return f"{episodes:,}"
    repeated = "deterministic: 1 distinct episode" if distinct == 1 else f"{distinct:,} of them distinct"
    return f"{episodes:,}, {repeated}"


def percent(share: float, trials: int) -> str:
    """Fraction of trials, such as episodes, in percent, with enough digits to resolve one of them."""
    return f"{100 * share:.{_digits(trials)}f} %"


def _digits(trials: int) -> int:
    """Decimals of a percentage that resolve one trial."""
    return max(1, math.ceil(math.log10(trials)) - 2)


def _length(x: float) -> str:
    return f"{100 * x:.2f} cm" if x < 1 else f"{x:.2f} m"
