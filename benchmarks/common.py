"""Versions, machine and commit, timers, and a figure with logarithmic axes."""

import os
import shutil
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax

from jaxdrones.cli.machine import processor, versions
from jaxdrones.cli.throughput import seconds as seconds
from jaxdrones.learning.evaluation import Report


def about() -> dict[str, object]:
    """Versions, machine and commit: what a number means nothing without."""
    return {
        "commit": _commit(),
        **{name: text for name, text in versions().items() if name in ("jax", "jaxlib", "python")},
        "device": str(jax.devices()[0]),
        "cpu": processor(),
        "cores": os.cpu_count(),
    }


def _commit() -> str:
    """Short hash of the checked out commit; empty in a copy of the files without git."""
    if shutil.which("git") is None:
        return ""
    found = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    return found.stdout.strip()


def compiled(function, *arguments, options: dict | None = None):
    """The compiled function and the seconds it took, the compilation cache switched off."""
    jax.config.update("jax_enable_compilation_cache", False)
    start = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile(options)
    return program, time.perf_counter() - start


def first_call(function, *arguments) -> float:
    """Seconds of the first call, in which a function compiles itself, the compilation cache switched off."""
    jax.config.update("jax_enable_compilation_cache", False)
    start = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    return time.perf_counter() - start


def outcome(report: Report) -> dict[str, Any]:
    """Success with its interval, and error in the end, m, for a row."""
    errors = {f"error p{q}": report.final_error_percentiles[q] for q in (50, 99)}
    return {"success": report.success, "interval": report.success_interval} | errors


def success_rate(success: float | None, interval: tuple[float, float] | None) -> str:
    """A success rate with its interval, or why there is none."""
    if success is None:
        return "no criterion"
    if interval is None:
        return f"{success:.4f} [1 distinct episode]"
    return f"{success:.4f} [{interval[0]:.4f}, {interval[1]:.4f}]"


Program = Callable[[], object]
"""Does its work and returns what it made; arrays of JAX are waited for."""


def in_turn(programs: Mapping[Any, Program], repeats: int, shortest: float = 0.05) -> dict[Any, dict[str, float]]:
    """Median, best and spread (upper less lower quartile) of the seconds of each, warmed up.

    A turn takes `shortest` s, in many calls if need be.
    """
    for program in programs.values():
        _seconds(program, 1)
    calls = {name: 1 + int(shortest / _seconds(program, 1)) for name, program in programs.items()}
    times = {name: [] for name in programs}
    for _ in range(repeats):
        for name, program in programs.items():
            times[name].append(_seconds(program, calls[name]))
    return {name: summary(taken) | {"best": min(taken)} for name, taken in times.items()}


def summary(times: Sequence[float]) -> dict[str, float]:
    """Median and spread, the upper less the lower quartile."""
    quartiles = statistics.quantiles(times, n=4, method="inclusive") if len(times) > 1 else (0.0, 0.0, 0.0)
    return {"median": statistics.median(times), "spread": quartiles[2] - quartiles[0]}


def _seconds(program: Program, calls: int) -> float:
    start = time.perf_counter()
    for _ in range(calls):
        jax.block_until_ready(program())
    return (time.perf_counter() - start) / calls


def loglog(path: str, curves: Mapping[str, Sequence[tuple[float, float]]], x: str, y: str, dashed: str = "") -> None:
    """Write a PNG with a line for every curve, points (x, y); the curve named `dashed` is extrapolated."""
    from jaxdrones.visualization import style  # only if a figure is asked for

    with style.figure(9, 6) as figure:
        axes = figure.add_subplot(xscale="log", yscale="log", xlabel=x, ylabel=y)
        for name, points in curves.items():
            look = {"linestyle": "--", "label": f"{name}, extrapolated"} if name == dashed else {"label": name}
            axes.plot(*zip(*points, strict=True), marker="o", markersize=5, **look)
        axes.legend(frameon=False)
        style.save(figure, path)
