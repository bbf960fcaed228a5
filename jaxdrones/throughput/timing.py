"""How time is taken."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import jax

_SHORTEST = 0.02  # s, of a measurement


def first_call(function: Callable, *arguments: Any) -> float:
    """Seconds of the first call, in which a function compiles itself."""
    start = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    return time.perf_counter() - start


def seconds(program: Callable, *arguments: Any, repeats: int) -> dict[str, float]:
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
