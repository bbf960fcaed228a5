"""What every benchmark prints about itself, and how it takes time."""

import json
import os
import platform
import statistics
import subprocess
import time

import jax
import jaxlib

_SHORTEST = 0.02  # s, of a measurement


def about() -> dict[str, object]:
    """Versions, machine and commit: what a number means nothing without."""
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    return {
        "commit": commit.stdout.strip(),
        "jax": jax.__version__,
        "jaxlib": jaxlib.__version__,
        "python": platform.python_version(),
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
    start = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    return time.perf_counter() - start


def seconds(program, *arguments, repeats: int) -> dict[str, float]:
    """Median and best seconds of a call, after calls that warm up; short calls are timed many at a time."""

    def of_calls(calls: int) -> float:
        start = time.perf_counter()
        for _ in range(calls):
            jax.block_until_ready(program(*arguments))
        return (time.perf_counter() - start) / calls

    of_calls(1)
    calls = 1 + int(_SHORTEST / of_calls(1))
    times = [of_calls(calls) for _ in range(repeats)]
    return {"median": statistics.median(times), "best": min(times)}


def report(result: dict, as_json: bool, lines: list[str]) -> None:
    """Print one JSON object, or the lines for people."""
    print(json.dumps(result) if as_json else "\n".join(lines))
