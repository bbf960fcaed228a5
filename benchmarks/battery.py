"""How well does the battery model reproduce the voltage of recorded flights?

For every flight (an npz of NanoBench with `t`, `pwm` and `vbat`) the charge is estimated from the voltage at rest
before it, and the resistance from the first seconds with the motors on. After that, the recorded PWM is the only input.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from jaxdrones.checks import check_choice

RATE = 100  # rows per second
ON = 0.3 * 65535  # mean PWM of a drone that is about to fly
GAUSS_NEWTON_STEPS = 8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("flights", nargs="+", type=Path)
    parser.add_argument("--vehicle", default="cf2x")
    parser.add_argument("--propellers", default="2.1+")
    parser.add_argument("--seconds", type=float, default=5.0, help="with the motors on, to find the resistance")
    parser.add_argument("--resistance", type=float, help="ohm, for all flights, instead of one found for each")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    jax.config.update("jax_enable_x64", True)
    rows = [measure(flight, options) for flight in options.flights[: 1 if options.quick else None]]
    lines = []
    lines.append("flight | resistance ohm | rms V: all, motors on, after the first seconds | mean current A")
    lines += [
        f"{row['flight']:26} | {row['resistance']:.3f} | {row['rms']:.3f} {row['rms on']:.3f} {row['rms after']:.3f} |"
        f" {row['current']:.2f}"
        for row in rows
    ]
    lines.append("mean rms V: " + " ".join(f"{np.mean([row[key] for row in rows]):.3f}" for key in RMS))
    return {"rows": rows}, lines


RMS = "rms", "rms on", "rms after"


def measure(flight: Path, options) -> dict:
    """The resistance of a flight's battery, and errors of the voltage, V."""
    with np.load(flight) as log:
        for column in "t", "pwm", "vbat":
            check_choice(f"column of {flight.name}", column, log.files)
        time = np.arange(0, log["t"][-1], 1 / RATE)
        pwm = jnp.stack([np.interp(time, log["t"], motor) for motor in log["pwm"].astype(float).T], axis=1)
        measured = jnp.asarray(np.interp(time, log["t"], log["vbat"]))
    on = np.mean(pwm, axis=1) > ON
    first = int(np.argmax(on))
    begin = np.arange(len(time)) < first + options.seconds * RATE
    if first == 0 or not np.any(on & ~begin):
        raise SystemExit(
            f"{flight}: give a flight that starts at rest and is longer than {options.seconds:g} s of flight"
        )
    fly = voltage(jd.load_params(options.vehicle), options.propellers, float(np.max(measured[:first])), pwm)

    resistance = jnp.asarray(0.3 if options.resistance is None else options.resistance)
    if options.resistance is None:
        slope = jax.jit(jax.jacfwd(lambda r: fly(r)[0]))
        for _ in range(GAUSS_NEWTON_STEPS):
            error, change = (jnp.where(begin & on, x, 0) for x in (fly(resistance)[0] - measured, slope(resistance)))
            resistance -= error @ change / (change @ change)
    simulated, current = fly(resistance)
    error = np.asarray(simulated - measured)
    parts = np.ones_like(on), on, on & ~begin
    errors = {name: float(np.sqrt(np.mean(error[part] ** 2))) for name, part in zip(RMS, parts, strict=True)}
    row = {"flight": flight.stem, "resistance": float(resistance), "current": float(np.mean(current[on]))}
    return row | errors


def voltage(params: jd.Params, propellers: str, rest: float, pwm: jax.Array):
    """A function of the resistance that gives voltage and current of the battery in every row of PWM (rows, 4)."""
    step = jd.make_step(rotors=jd.pwm_rotors, models=(jd.battery(),), dt=0.5 / RATE, substeps=2)

    @jax.jit
    def fly(resistance):
        cell = jd.lithium_polymer(resistance=resistance)
        team = jd.repeat(params.replace(aux={"battery": cell, "motors": jd.crazyflie_motors(propellers)}), 1)
        open_circuit = rest + resistance * cell.idle_power / rest  # the electronics are on
        charge = jnp.reshape(jd.charge_at(cell, open_circuit), 1)
        start = jd.State.at_rest([[0.0, 0, 0]]).replace(
            aux={"battery": {"charge": charge, "slow_drop": jnp.zeros_like(charge)}}
        )
        _, states = jd.rollout(step, lambda p, m, s, k: (m, pwm[k][None]), team, start, None, len(pwm))
        of_row = jax.vmap(lambda state: jax.tree.map(lambda x: x[0], state))(states)
        one = jax.tree.map(lambda x: x[0], team)
        return tuple(jax.vmap(f, (None, 0))(one, of_row) for f in (jd.battery_voltage, jd.battery_current))

    return fly
