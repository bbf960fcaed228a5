"""How do speed, memory and compile time scale with the number of worlds?

One drone per world, lagging rotors, drag, semi-implicit Euler at 240 Hz, float32, by `jaxdrones.over_worlds` on all
devices into which the CPU is divided. `controlled`: the attitude loop and mixer of the PID, with a new attitude in
every step. Memory is that of the compiled program on one device, in addition to its inputs and results.
"""

import argparse
import os
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from benchmarks.common import first_call, in_turn, loglog
from benchmarks.rivals import ours
from jaxdrones.accelerate.compiler import kernel_options

WORLDS = (1, 16, 256, 4096, 65536, 1048576)
STEPS_OF_A_CALL = 2**22  # drone-steps, about
BYTES_OF_COMMANDS = 2**27
DT = 1 / 240


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--worlds", type=int, nargs="+", default=WORLDS)
    parser.add_argument("--devices", type=int, default=os.cpu_count(), help="to cut the CPU into")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--figure", help="PNG to write")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    if options.quick:
        options.worlds, options.repeats = (2, 8), 1
    jax.config.update("jax_num_cpu_devices", options.devices)

    rows = [measure(worlds, options) for worlds in options.worlds]
    facts = {"devices": jax.device_count(), "load": os.getloadavg()[0]}
    lines = ["M drone-steps/s; beside them bytes per world beyond inputs and results, and s to compile"]
    lines += [
        f"{row['worlds']:8} | "
        + " | ".join(f"{name} {rate:7.1f} {_rest(row, name)}" for name, rate in row["rates"].items())
        for row in rows
    ]
    if options.figure:
        names = dict.fromkeys(name for row in rows for name in row["rates"])
        rates = {
            name: [(row["worlds"], 1e6 * row["rates"][name]) for row in rows if name in row["rates"]] for name in names
        }
        loglog(options.figure, rates, "worlds", "drone-steps per second")
    return {"about": facts, "rows": rows}, lines


def _rest(row: dict, name: str) -> str:
    return f"({row['memory'][name] / row['worlds']:.0f} B, {row['compile'][name]:.1f} s)"


def measure(worlds: int, options) -> dict[str, object]:
    """Rates in million drone-steps per second, bytes, and seconds to compile, by program."""
    params = jd.repeat(ours.even_rotors(0.03), 1)
    step = jd.make_step(effects=(jd.drag,), rotors=jd.lagging_rotors, dt=DT)
    most = 10 if options.quick else min(5000, max(100, STEPS_OF_A_CALL // worlds))
    fewer = min(most, max(10, BYTES_OF_COMMANDS // (16 * worlds)))  # commands of a million worlds fill the memory
    start, rpm = ours.starts(worlds, jax.random.key(0), params)
    rpy, thrust = ours.attitudes(worlds, fewer, jax.random.key(1))
    commands = jnp.asarray(np.concatenate([rpy, thrust * np.asarray(params.weight[0])], axis=-1))
    flights = {
        "held": (ours.flight(step, most), rpm, 0, most),
        "controlled": (ours.controlled(step, DT), commands, 1, fewer),
    }
    places = {"": ()}
    if options.devices > 1 and worlds % options.devices == 0:
        places[f", {options.devices} devices"] = jax.devices()
    programs, steps, memory, compiling = {}, {}, {}, {}
    for flight, (fly, asked, axis, length) in flights.items():
        for place, devices in places.items():
            name = flight + place
            programs[name] = ours.program(fly, params, start, asked, devices, axis)
            compiling[name] = first_call(programs[name])
            memory[name] = _memory(programs[name])
            steps[name] = worlds * length / 1e6
    times = in_turn(programs, options.repeats, 0 if options.quick else 0.05)
    rates = {name: steps[name] / taken["median"] for name, taken in times.items()}
    return {"worlds": worlds, "rates": rates, "memory": memory, "compile": compiling}


def _memory(program: partial) -> int:
    """Bytes that the compiled program takes beside its inputs and results."""
    compiled = jax.jit(program.func).lower(*program.args).compile(kernel_options())
    return compiled.memory_analysis().temp_size_in_bytes
