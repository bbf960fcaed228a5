"""Programs timed in turn, A B A B, so that whatever else the machine does falls on all of them alike."""

import statistics
import time
from collections.abc import Callable

import jax

Program = Callable[[], object]
"""Does its work and returns what it made; arrays of JAX are waited for."""


def in_turn(programs: dict[str, Program], repeats: int, shortest: float = 0.05) -> dict[str, dict[str, float]]:
    """Median and best seconds of each, warmed up; a turn takes `shortest` s, in many calls if need be."""
    for program in programs.values():
        _seconds(program, 1)
    calls = {name: 1 + int(shortest / _seconds(program, 1)) for name, program in programs.items()}
    times = {name: [] for name in programs}
    for _ in range(repeats):
        for name, program in programs.items():
            times[name].append(_seconds(program, calls[name]))
    return {name: {"median": statistics.median(taken), "best": min(taken)} for name, taken in times.items()}


def _seconds(program: Program, calls: int) -> float:
    start = time.perf_counter()
    for _ in range(calls):
        jax.block_until_ready(program())
    return (time.perf_counter() - start) / calls
