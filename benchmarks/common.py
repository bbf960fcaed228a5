"""What every benchmark prints about itself, and how it takes time."""

import json
import os
import subprocess
import time

import jax

from jaxdrones.throughput import timing
from jaxdrones.throughput.machine import versions
from jaxdrones.throughput.timing import seconds as seconds


def about() -> dict[str, object]:
    """Versions, machine and commit: what a number means nothing without."""
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    return {
        "commit": commit.stdout.strip(),
        **{name: text for name, text in versions().items() if name in ("jax", "jaxlib", "python")},
        "device": str(jax.devices()[0]),
        "cores": os.cpu_count(),
    }


def compiled(function, *arguments, options: dict | None = None):
    """The compiled function and the seconds it took, the compilation cache switched off."""
    jax.config.update("jax_enable_compilation_cache", False)
    start = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile(options)
    return program, time.perf_counter() - start


def first_call(function, *arguments) -> float:
    """Seconds of the first call, in which a function compiles itself, the compilation cache switched off."""
    jax.config.update("jax_enable_compilation_cache", False)
    return timing.first_call(function, *arguments)


def success_rate(success: float | None, interval: tuple[float, float] | None) -> str:
    """A success rate with its interval, or why there is none."""
    if success is None:
        return "no criterion"
    if interval is None:
        return f"{success:.4f} [1 distinct episode]"
    return f"{success:.4f} [{interval[0]:.4f}, {interval[1]:.4f}]"


def report(result: dict, as_json: bool, lines: list[str]) -> None:
    """Print one JSON object, or the lines for people."""
    print(json.dumps(result) if as_json else "\n".join(lines))
