"""How well do simulators reproduce recorded flights, each with its own parameters of the Crazyflie?

The open-loop test of `jaxdrones score`: from every state of every log a simulator receives the recorded inputs of the
next half second, and the results are the mean errors after 0.1, 0.25 and 0.5 s. jaxdrones runs in this process,
crazyflow 0.4.0 and rotorpy 3.0.0 in a separate environment (rivals/environment.py, rivals/reality.py).

  vehicles  Each simulator has its own published parameters of the Crazyflie in the log: the brushless one for logs with
            rotor speeds (`cf21_brushless`, cf21B_500, crazyfliebrushless_params), the 2.1 for logs with PWM (`cf21` and
            cf2x_P250 with the propellers of the 2.1+, crazyflie_params). `cf21` and `cf21_brushless` have crazyflow's
            parameters in our model; `cf2x` is that of gym-pybullet-drones. `--vehicle` adds others, for example
            vehicles fitted by `jaxdrones fit`.
  start     The logged state. Rotors have the measured speeds, or have followed the commands of the previous 0.3 s.
  input     Measured rotor speeds, without lag, linearly interpolated from each row to the next: crazyflow, whose rotors
            have inertia, receives them at 500 Hz; jaxdrones receives their mean and their rate, rotorpy their mean.
            crazyflow limits them to 21,661 RPM. The other simulators do not accept PWM and voltage, so all receive the
            thrust of the firmware's curve of the 2.1+, the others as the rotor speed for it on their own thrust
            curve, and each has its own lag.
  steps     jaxdrones: the midpoint rule at 100 Hz. crazyflow: its default, explicit Euler, at 500 Hz. rotorpy: rk4 at
            100 Hz, which differs from its default, dopri5, by less than a thousandth.

The closed loop is not compared: the flights have the firmware's PID, battery and state estimate, of which crazyflow
(with the firmware's Mellinger controller) and rotorpy (with a geometric one) have none.
"""

import argparse
from pathlib import Path

import numpy as np

from benchmarks.rivals import environment
from jaxdrones import assets
from jaxdrones.dynamics.propulsion import crazyflie_motors
from jaxdrones.flights import FlightLog, errors_as_dict, hold_errors, load_flights, load_vehicle, open_loop_errors

OURS = {True: ("cf2x", "cf21_brushless"), False: ("cf2x", "cf21")}
"""Bundled vehicles, by whether the rotor speeds were measured."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "flights", nargs="*", type=Path, default=list(assets.flights().values()), help="logs (.npz) or folders of them"
    )
    parser.add_argument(
        "--vehicle", nargs="+", default=[], metavar="NAME|URDF|FOLDER", help="more of ours, for all of the flights"
    )


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    files = [file for path in options.flights for file in (sorted(path.rglob("*.npz")) if path.is_dir() else [path])]
    logs = [log for file in files for log in load_flights(file)]
    versions, theirs = {}, {}
    if not options.quick:
        result = environment.run("benchmarks.rivals.reality", *(str(file.resolve()) for file in files))
        versions, theirs = result["versions"], result["errors"]
    rows, lines = [], []
    for measured, inputs in (True, "rotor speeds"), (False, "PWM and voltage"):
        group = [(file, log) for file, log in zip(files, logs, strict=True) if log.has("rpm") == measured]
        if not group:
            continue
        flown = [
            ours(log, (*OURS[measured], *options.vehicle)) | theirs.get(str(file.resolve()), {}) for file, log in group
        ]
        models = {name: mean([errors[name] for errors in flown]) for name in flown[0]}
        rows.append({"input": inputs, "flights": [log.name for _, log in group], "models": models})
        lines += [f"{inputs}: {', '.join(log.name for _, log in group)}", *table(models)]
    return {"about": versions, "rows": rows}, lines


def ours(log: FlightLog, vehicles: tuple[str, ...]) -> dict[str, dict]:
    """Errors of a model that stays where it starts and of our vehicles, by name."""
    motors, errors = crazyflie_motors(), {"hold": hold_errors(log)}
    errors |= {f"ours {name}": open_loop_errors(log, load_vehicle(name), motors) for name in vehicles}
    return {name: errors_as_dict(e) for name, e in errors.items()}


def mean(errors: list[dict]) -> dict:
    """The mean over flights of errors by horizon and quantity."""
    return {
        h: {name: float(np.mean([e[h][name] for e in errors])) for name in quantities}
        for h, quantities in errors[0].items()
    }


def table(models: dict[str, dict]) -> list[str]:
    """A line for each model: position, velocity, attitude and rates after each horizon."""
    head = "".join(f"{f'after {int(h) / 100:g} s: m, m/s, rad, rad/s':>38}" for h in next(iter(models.values())))
    numbers = {
        name: "".join(f"{e['pos']:14.4f}{e['vel']:8.3f}{e['rot']:8.4f}{e['omega']:8.3f}" for e in horizons.values())
        for name, horizons in models.items()
    }
    return [f"    {'':32}{head}", *(f"    {name[-32:]:32}{text}" for name, text in numbers.items())]
