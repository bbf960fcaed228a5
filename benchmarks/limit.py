"""What fraction of the speed of hand-written C does jaxdrones reach on this CPU?

Both simulate one Crazyflie per world: lagging rotors, drag, semi-implicit Euler at 240 Hz, float32, constant commands.
The C program (`plant.c`, structure of arrays, all cores) is compiled here; it counts only if its trajectory agrees, and
is measured alternately with jaxdrones, by `jax.vmap`, `over_worlds`, and `over_worlds` with one device for each core.

For accelerators: a step reads and writes 17 numbers and reads a command of 4, 152 bytes in float32, and takes about 290
additions and multiplications, 15 divisions and a square root, 2 operations per byte. The limit of an H100 (3.35 TB/s,
67 T operations/s) is 22 G drone-steps/s with one kernel per step, and about 200 G with many steps in one kernel.
"""

import argparse
import os

import jax
import numpy as np

import jaxdrones as jd
from benchmarks.common import in_turn
from benchmarks.native import plant as native
from benchmarks.rivals import ours

WORLDS = (1, 64, 1024, 16384, 65536, 262144)
STEPS_OF_A_CALL = 2**23  # drone-steps, about
DT = 1 / 240
AGREED = 1e-4
"""Of the largest value of each quantity, after a second: float32 rounds at 6e-8, a small torque is the difference of
large thrusts, and 240 steps of sums in another order make it 2e-5 of the angular velocity. A missing term is 1e-2."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--worlds", type=int, nargs="+", default=WORLDS)
    parser.add_argument("--devices", type=int, default=os.cpu_count(), help="to cut the CPU into; also threads of C")
    parser.add_argument("--repeats", type=int, default=9)


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    if options.quick:
        options.worlds, options.repeats = (2, 64), 1
    jax.config.update("jax_num_cpu_devices", options.devices)

    try:
        params = jd.repeat(jd.load_params("cf2x"), 1)
        plant = native.Plant(jd.load_params("cf2x"), DT)
    except native.NoCompilerError as error:
        raise SystemExit(str(error)) from None
    step = jd.make_step(effects=(jd.drag,), rotors=jd.lagging_rotors, dt=DT)
    differences = agreement(plant, step, params)
    if max(differences.values()) > AGREED:
        raise SystemExit(f"the C flies another trajectory, no rate is worth printing; differences: {differences}")

    facts = {"devices": jax.device_count(), "compiler": plant.compiler, "load": os.getloadavg()[0]}
    rows = [measure(plant, step, params, worlds, options) for worlds in options.worlds]
    lines = ["agreement, of the largest value: " + ", ".join(f"{k} {v:.0e}" for k, v in differences.items())]
    names = list(rows[-1]["rates"])
    lines.append("M drone-steps/s, median (best)")
    lines.append("   worlds | " + " | ".join(names) + " | our best share of C")
    lines += [
        f"{row['worlds']:9} | "
        + " | ".join(_cell(row, name).center(len(name)) for name in names)
        + f" | {100 * row['share']:.0f} %"
        for row in rows
    ]
    return {"about": facts, "agreement": differences, "rows": rows}, lines


def agreement(plant: native.Plant, step: jd.Step, params: jd.Params, worlds: int = 100) -> dict[str, float]:
    """Largest difference after a second, C against ours, as a share of the largest value of each quantity."""
    start, rpm = ours.starts(worlds, jax.random.key(0), params)
    expected = ours.program(ours.flight(step, round(1 / DT)), params, start, rpm)()
    found = native.states_of(plant.fly(native.rows_of(start), _command(rpm), round(1 / DT), threads=2))
    return {
        name: float(np.max(np.abs(getattr(found, name) - value)) / np.max(np.abs(value)))
        for name, value in ((name, getattr(expected, name)) for name in native.ROWS)
    }


def measure(plant: native.Plant, step: jd.Step, params: jd.Params, worlds: int, options) -> dict[str, object]:
    """Rates in million drone-steps per second of every way to fly these worlds."""
    length = 10 if options.quick else max(100, min(20_000, STEPS_OF_A_CALL // worlds))
    start, rpm = ours.starts(worlds, jax.random.key(0), params)
    fly = ours.flight(step, length)
    several = jax.devices()[: min(options.devices, worlds)]
    ways = ours.ways(fly, several, params, start, rpm)

    rows, command = native.rows_of(start), _command(rpm)
    programs = {
        "C, 1 thread": lambda: plant.fly(rows.copy(), command, length, threads=1),
        f"C, {options.devices} threads": lambda: plant.fly(rows.copy(), command, length, threads=options.devices),
    } | ways
    times = in_turn(programs, options.repeats, shortest=0 if options.quick else 0.05)
    rates = {name: worlds * length / 1e6 / taken["median"] for name, taken in times.items()}
    best = {name: worlds * length / 1e6 / taken["best"] for name, taken in times.items()}
    limit = max(rate for name, rate in rates.items() if name.startswith("C"))
    return {
        "worlds": worlds,
        "steps per call": length,
        "rates": rates,
        "best": best,
        "share": max(rates[name] for name in ways) / limit,
    }


def _command(rpm: jax.Array) -> np.ndarray:
    return np.ascontiguousarray(np.asarray(rpm)[:, 0].T)


def _cell(row: dict, name: str) -> str:
    return f"{row['rates'][name]:.1f} ({row['best'][name]:.1f})" if name in row["rates"] else "-"
