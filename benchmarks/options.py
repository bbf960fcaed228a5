"""How does each option of XLA's CPU compiler affect compile time and speed, program by program?

Compile time without tracing, and time of a call, of the programs in benchmarks/programs.py: with XLA's defaults, with
each of its code generators for elementwise code (`xla_cpu_use_fusion_emitters`; off is the older one) at each
optimization level of LLVM, and with the options of `over_worlds`. All options of a program are measured alternately;
results are medians. jaxdrones/accelerate/compiler.py has the options that the package uses.
"""

import argparse
import functools
import statistics
import time

import jax

from benchmarks.common import in_turn
from benchmarks.programs import PROGRAMS, Program
from jaxdrones.accelerate.compiler import kernel_options

NAMES = (
    "plant",
    "plant by vmap",
    "plant with gradient",
    "hover",
    "camera",
    "bptt update",
    "ppo update",
    "shac update",
)
DEFAULT = "defaults"
OPTIONS: dict[str, dict[str, object]] = {
    DEFAULT: {},
    **{
        f"{'new' if emitters else 'old'} {level}": {
            "xla_cpu_use_fusion_emitters": emitters,
            "xla_backend_optimization_level": level,
        }
        for emitters in (False, True)
        for level in (1, 2, 3)
    },
    "no thunks": {"xla_cpu_use_thunk_runtime": False},
}
KERNEL = "kernel"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--only", nargs="+", default=NAMES, choices=PROGRAMS, metavar="PROGRAM")
    parser.add_argument("--compilations", type=int, default=3, help="of each program with each options")
    parser.add_argument("--repeats", type=int, default=7, help="of a time")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    jax.config.update("jax_enable_compilation_cache", False)
    if options.quick:
        options.only, options.compilations, options.repeats = ("plant by vmap",), 1, 1
    sets = OPTIONS | {KERNEL: kernel_options()}
    unknown = [name for name, chosen in sets.items() if not is_known(chosen)]
    known = {name: chosen for name, chosen in sets.items() if name not in unknown}
    rows = [measure(name, PROGRAMS[name], known, options) for name in options.only]
    return {"options": sets, "unknown": unknown, "rows": rows}, table(rows, sets, unknown)


def is_known(options: dict[str, object]) -> bool:
    """Whether the installed compiler has the options."""
    try:
        jax.jit(lambda: 0).lower().compile(options)
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return False
    return True


def measure(name: str, program: Program, sets: dict[str, dict], options: argparse.Namespace) -> dict[str, object]:
    """Seconds to compile, and the time of a call in the program's unit, with each set of options."""
    function, arguments, _ = program.make()
    taken: dict[str, list[float]] = {chosen: [] for chosen in sets}
    programs = {}
    for _ in range(options.compilations):
        jax.clear_caches()  # a program that is lowered once is compiled once
        lowered = jax.jit(function).lower(*arguments)
        for chosen in sets:
            start = time.perf_counter()
            compiled = lowered.compile(sets[chosen])
            taken[chosen].append(time.perf_counter() - start)
            programs[chosen] = functools.partial(compiled, *arguments)
    times = in_turn(programs, options.repeats)
    return {
        "name": name,
        "unit": program.unit,
        "definition": program.definition,
        "compile": {chosen: statistics.median(each) for chosen, each in taken.items()},
        "run": {chosen: program.value(times[chosen]["median"]) for chosen in sets},
    }


def table(rows: list[dict], sets: dict[str, dict], unknown: list[str]) -> list[str]:
    """With the defaults, and then times that with each set of options; less is better."""
    others = [name for name in sets if name != DEFAULT and name not in unknown]
    lines = [f"{'':28} | {DEFAULT:>22} | " + " | ".join(f"{name:>6}" for name in others)]
    for row in rows:
        for what, unit in (("compile", "s"), ("run", row["unit"])):
            first = row[what][DEFAULT]
            ratios = " | ".join(f"{row[what][name] / first:6.2f}" for name in others)
            lines.append(f"{row['name'] + ', ' + what:28} | {first:6.4g} {unit:15} | {ratios}")
    lines += [f"{name}: {', '.join(f'{key}={value}' for key, value in sets[name].items())}" for name in others]
    return lines + [f"{name}: this XLA has no {', '.join(sets[name])}" for name in unknown]
