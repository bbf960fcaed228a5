"""`jaxdrones bench`."""

import argparse
import itertools
import time
from collections.abc import Callable
from typing import Any

import jax

from jaxdrones import arguments
from jaxdrones.accelerate.worlds import over_worlds
from jaxdrones.cli import machine
from jaxdrones.cli import throughput as programs
from jaxdrones.cli.options import option
from jaxdrones.cli.report import print_results
from jaxdrones.cli.throughput import seconds
from jaxdrones.dynamics.aero import drag
from jaxdrones.engine.explicit import make_step
from jaxdrones.envs import make

_WORLDS = {"cpu": (1024, 16384), "other": (16384, 262144)}
_DT = 1 / 240  # s
_DRONE_STEPS = {"plant": 2**23, "controller": 2**20, "environment": 2**16}  # of a call, about
_LONGEST = 20_000  # steps of a call
_REPEATS = 3
_MEANINGS = {
    "plant": "drone-steps/s of the plant: a Crazyflie per world, drag, semi-implicit Euler at 240 Hz",
    "controller": "drone-steps/s of the same under the PID, a command in every step",
    "environment": "env-steps/s of hover: 100 Hz, five physics steps, observation, reward, reset",
}


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "bench",
        help="measure steps per second of this machine in half a minute",
        description="Measure the throughput of this machine in float32: the plant, the plant under a controller, and "
        "an environment, without compilation. The last line is a summary to share.",
    )
    counts = "numbers of worlds (1024,16384; more on an accelerator)"
    option(parser, "--worlds N,N", counts, _counts, check=arguments.sequence("1024", arguments.count))
    option(parser, "--seconds S", "time limit, s", float, 25.0, check=arguments.number("s", above=0))
    parser.set_defaults(run=_bench)


def _counts(text: str) -> list[int]:
    try:
        return [int(count) for count in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is given; give whole numbers, for example 1024,16384") from None


def _bench(options: argparse.Namespace) -> int:
    begin = time.perf_counter()
    worlds = options.worlds or _WORLDS["cpu" if jax.default_backend() == "cpu" else "other"]
    rows: list[dict[str, Any]] = []
    longest: dict[str, float] = {}
    left_out = 0
    for count, kind in itertools.product(worlds, _MEANINGS):
        start = time.perf_counter()
        if rows and start - begin + longest.get(kind, max(longest.values())) > options.seconds:
            left_out += 1
            continue
        rows.append({"what": kind, "worlds": count, "per_s": _rate(kind, count)})
        longest[kind] = max(longest.get(kind, 0.0), time.perf_counter() - start)
        if not options.json:
            print(f"{rows[-1]['per_s']:15,.0f}  {_MEANINGS[kind]}, {count:,} worlds", flush=True)
    about = {"processor": machine.processor(), "cores": machine.cores(), "devices": machine.devices()}
    result = {"rates": rows, "left_out": left_out, **about, "versions": machine.versions()}
    result |= {"dtype": str(jax.numpy.zeros(()).dtype), "seconds": time.perf_counter() - begin}
    missing = f"left out, as it would take longer: {left_out} of {left_out + len(rows)}; give more --seconds"
    print_results(options, result | {"line": _line(result)}, missing if left_out else None, _line(result))
    return 0


def _rate(kind: str, worlds: int) -> float:
    length = max(10, min(_LONGEST, _DRONE_STEPS[kind] // worlds))
    program: Callable
    arguments: tuple
    if kind == "environment":
        fly, begun = programs.episodes(make("hover"), worlds, length)
        program, arguments = jax.jit(fly), (begun, jax.random.key(3))
    else:
        params, starts, rpm = programs.crazyflies(worlds, 1)
        step = make_step(effects=(drag,), dt=_DT)
        if kind == "plant":
            program, arguments = over_worlds(programs.held(step, params, length)), (starts, rpm)
        else:
            program, arguments = over_worlds(programs.controlled(step, params, length, _DT)), (starts,)
    return worlds * length / seconds(program, *arguments, repeats=_REPEATS)["median"]


def _line(result: dict[str, Any]) -> str:
    """Summary of the best rate of each kind, the machine and the versions."""
    best: dict[str, dict[str, Any]] = {}
    for row in result["rates"]:
        best[row["what"]] = max(best.get(row["what"], row), row, key=lambda row: row["per_s"])
    rates = ", ".join(f"{kind} {_short(row['per_s'])} steps/s ({row['worlds']:,} worlds)" for kind, row in best.items())
    versions = ", ".join(f"{name} {result['versions'][name]}" for name in ("jaxdrones", "jax", "jaxlib", "python"))
    accelerators = [device for device in result["devices"] if not device.startswith("cpu")]
    machine = f"{result['processor']}, {result['cores']} cores" + "".join(f", {device}" for device in accelerators)
    return f"jaxdrones bench: {rates}; {result['dtype']}; {machine}; {versions}"


def _short(rate: float) -> str:
    return f"{rate / 1e6:.3g} M" if rate >= 1e5 else f"{rate:,.0f}"
