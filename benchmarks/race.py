"""How many times faster than crazyflow and rotorpy is jaxdrones, for the same flight in the same run?

crazyflow 0.4.0 and rotorpy 3.0.0 are installed with jaxdrones in a separate environment at the first call
(rivals/environment.py); one process measures all of them alternately, medians of repeats (rivals/races.py). Races:

  plant-symplectic_euler, plant-euler, plant-rk4
      constant commands, lagging rotors, drag independent of rotor speeds, our Crazyflie in both, 500 Hz, float32.
      `euler` is crazyflow's default, which updates the attitude by the exponential map; ours adds and normalizes.
  attitude
      each simulator's own Crazyflie and cascade at 500 Hz, with a new attitude and thrust in every step: here the
      attitude loop and mixer of `pid`, there the Mellinger controller.
  rotorpy
      the plant without drag, rk4, float64, because rotorpy has only float64, no Euler, and drag at each rotor.

Each simulator runs many steps in one compiled program if it can (rotorpy cannot) and returns the whole final state;
starts, commands and vehicle are known only at run time. crazyflow runs on one device and with its own sharding, with
default compiler options and with ours; jaxdrones runs by `jax.vmap`, `over_worlds`, and `over_worlds` on all devices. A
ratio compares the best of each, and is reported only if all flights of 64 worlds and two seconds (rotorpy 0.2 s) end in
the same state (`AGREED`), or for `attitude` in the commanded attitude.

PyFlyt 0.29.0 is not compared: it needs numpy below 2 and jaxdrones numpy 2, so they cannot share a process.
"""

import argparse
import os

from benchmarks.rivals import environment

WORLDS = (1, 64, 1024, 16384, 262144)
RACES = ("plant-symplectic_euler", "plant-euler", "plant-rk4", "attitude", "rotorpy")
AGREED = {"pos": 1e-2, "vel": 1e-2, "omega": 1e-3, "rpm": 1.0, "angle": 2e-3}
"""m, m/s, rad/s, RPM, rad, after two seconds of float32, 200 m up; the differences found are a tenth of these."""
HELD = 0.05  # rad, between the attitude asked for, which drifts, and the one flown


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--worlds", type=int, nargs="+", default=WORLDS)
    parser.add_argument("--races", nargs="+", default=RACES, choices=RACES)
    parser.add_argument("--devices", type=int, default=os.cpu_count(), help="to cut the CPU into")
    parser.add_argument("--repeats", type=int, default=5)


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    if options.quick:
        options.worlds, options.races, options.repeats = (2,), ("plant-symplectic_euler", "attitude"), 1

    arguments = ["--worlds", *map(str, options.worlds), "--races", *options.races]
    arguments += ["--devices", str(options.devices), "--repeats", str(options.repeats)]
    start = environment.run_here if options.quick else environment.run
    result = start("benchmarks.rivals.races", *arguments, *(["--alone"] if options.quick else []))
    rows = [row | _ratio(row) for row in result["rows"]]
    facts = result["versions"] | {"devices": options.devices, "load": result["load"]}
    lines = ["M drone-steps/s, median (best); ratio of the best of ours to the best of theirs"]
    for row in rows:
        lines.append(f"{row['race']}, {row['worlds']} worlds, {row['steps']} steps a call: {_verdict(row)}")
        lines += [
            f"    {name:30} {rate:9.3f} ({row['best'][name]:.3f}){'' if name in row['alike'] else ' does not count'}"
            for name, rate in row["rates"].items()
        ]
    result = {"about": facts, "rows": rows}
    if any(row["agree"] is False for row in rows):
        result["failed"] = "some contenders did not fly alike; their rates do not count"
    return result, lines


def _ratio(row: dict) -> dict[str, object]:
    """Whether all flew alike, and how many times as fast our best is as their best; None where nobody else flew."""
    rates = row["rates"]
    theirs = [name for name in rates if not name.startswith("ours")]
    if not theirs:
        return {"agree": None, "ratio": None, "alike": list(rates)}
    bounds = {"angle": HELD} if row["race"] == "attitude" else AGREED
    alike = [name for name in rates if all(d <= bounds[field] for field, d in row["differences"][name].items())]
    ours = [name for name in alike if name.startswith("ours")]
    agree = bool(ours) and set(theirs) <= set(alike)
    if not agree:
        return {"agree": False, "ratio": None, "alike": alike}
    best = max(rates[name] for name in ours)
    by_default = [name for name in theirs if "our options" not in name]
    return {
        "agree": True,
        "ratio": best / max(rates[name] for name in theirs),
        "ratio to their defaults": best / max(rates[name] for name in by_default),
        "alike": alike,
    }


def _verdict(row: dict) -> str:
    if row["agree"] is None:
        return "alone"
    if not row["agree"]:
        return f"NOT ALIKE: {row['differences']}"
    return f"{row['ratio']:.1f} times as fast, {row['ratio to their defaults']:.1f} without our options for them"
