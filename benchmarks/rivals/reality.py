"""crazyflow and rotorpy from every state of flight logs, for benchmarks/reality.py, run in their environment.

For a log with rotor speeds they receive these without their own lag: crazyflow's rotors reach the next speed in one of
its steps, rotorpy's have the mean speed of a row and the next. For a log with PWM and voltage they receive, in every
row, the speed for the firmware's thrust on their own thrust curve, and follow it with their own lag, from 0.3 s before
the start on.
"""

import argparse
import importlib.metadata
import json
import warnings
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import torch
from crazyflow.dynamics import Dynamics, load_params
from rotorpy.vehicles import crazyflie_params, crazyfliebrushless_params
from rotorpy.vehicles.multirotor import BatchedMultirotor, BatchedMultirotorParams

import jaxdrones as jd
from benchmarks.rivals.crazyflow import make_sim, make_step, speed_of
from benchmarks.rivals.rotorpy import RADIANS_PER_SECOND
from jaxdrones.dynamics.propulsion import FULL_PWM, crazyflie_motors
from jaxdrones.flights import HORIZONS, FlightLog, errors_as_dict, load_flights
from jaxdrones.flights.log import PERIOD
from jaxdrones.flights.open_loop import cut_windows, mean_errors, window_starts

BEFORE, LENGTH = 30, HORIZONS[-1]  # rows before a start, in which lagging rotors come to their speed, and after it
SUBSTEPS = 5  # of crazyflow in a row: its 500 Hz

Plant = Callable[[FlightLog, np.ndarray], jd.State]
"""From a log and its starts (n,) to the states at the horizons, (n, horizons)."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="+", type=Path)
    options = parser.parse_args()
    warnings.filterwarnings("ignore")
    errors: dict[str, dict[str, dict]] = {}
    for file in options.logs:
        (log,) = load_flights(file)
        starts = window_starts(log)
        logged = cut_windows(log, starts).logged
        found = {name: mean_errors(fly(log, starts), logged) for name, fly in plants(log).items()}
        errors[str(file)] = {name: errors_as_dict(np.asarray(e)) for name, e in found.items()}
    names = ("crazyflow", "rotorpy")
    print(json.dumps({"errors": errors, "versions": {name: importlib.metadata.version(name) for name in names}}))


def plants(log: FlightLog) -> dict[str, Plant]:
    """Rivals with their own parameters of the Crazyflie that flew, the brushless one where speeds were measured."""
    if log.has("rpm"):
        own = crazyfliebrushless_params
        return {"crazyflow cf21B_500": crazyflow("cf21B_500"), "rotorpy Crazyflie Brushless": rotorpy(own.quad_params)}
    return {"crazyflow cf2x_P250": crazyflow("cf2x_P250"), "rotorpy Crazyflie": rotorpy(crazyflie_params.quad_params)}


def crazyflow(airframe: str) -> Plant:
    """Its first-principles plant by its default integrator."""
    own = load_params(Dynamics.first_principles, airframe)

    def fly(log: FlightLog, starts: np.ndarray) -> jd.State:
        sim = make_sim(airframe, round(SUBSTEPS / PERIOD))
        if log.has("rpm"):
            at_once = SUBSTEPS / PERIOD * jnp.array([1.0, 0, 1, 0])
            coefficients = jnp.broadcast_to(at_once, sim.data.params.rotor_dyn_coef.shape)
            sim.data = sim.data.replace(params=sim.data.params.replace(rotor_dyn_coef=coefficients))
        step = jax.vmap(make_step(sim, 1), (None, 0, 0))
        speeds = log.rpm[:, 0] if log.has("rpm") else speed_of(thrusts(log), own["rpm2thrust"])

        def advance(states, rpm):
            for j in range(SUBSTEPS):
                states = step(None, states, rpm[:, j][:, None])
            return states, states

        fine = subdivided(speeds) if log.has("rpm") else np.repeat(speeds[:, None], SUBSTEPS, axis=1)
        rows = starts[:, None] + np.arange(-BEFORE, LENGTH)
        inputs = jnp.asarray(np.moveaxis(fine[np.maximum(rows, 0)], 1, 0))  # (rows, n, substeps, 4)
        start = cut_windows(log, starts).start
        team = jax.tree.map(lambda x: x[:, None], start.replace(rpm=jnp.asarray(speeds[np.maximum(rows[:, 0], 0)])))

        @jax.jit
        def run(team, inputs):
            before, _ = jax.lax.scan(advance, team, inputs[:BEFORE])
            _, states = jax.lax.scan(advance, team.replace(rpm=before.rpm), inputs[BEFORE:])
            return jax.tree.map(lambda x: jnp.moveaxis(x[np.array(HORIZONS) - 1, :, 0], 0, 1), states)

        return run(team, inputs)

    return fly


def subdivided(speeds: np.ndarray) -> np.ndarray:
    """Speeds (T, 4) of rows as (T, substeps, 4) on the straight line from each row to the next."""
    rows = np.minimum(np.arange(len(speeds))[:, None] + np.arange(1, SUBSTEPS + 1) / SUBSTEPS, len(speeds) - 1)
    return np.stack([np.interp(rows, np.arange(len(speeds)), motor) for motor in speeds.T], axis=-1)


def rotorpy(own: dict) -> Plant:
    """Its batch of vehicles by rk4, with its aerodynamics."""
    places = np.array([own["rotor_pos"][f"r{i}"] for i in range(1, 5)])
    order = [int(np.argmin(np.linalg.norm(places - p, axis=1))) for p in np.asarray(jd.load_params("cf2x").rotor_pos)]
    assert sorted(order) == [0, 1, 2, 3]
    assert (np.asarray(own["rotor_directions"])[order] == jd.load_params("cf2x").rotor_spin).all()
    ours = np.argsort(order)  # its rotor i is our rotor ours[i]

    def fly(log: FlightLog, starts: np.ndarray) -> jd.State:
        n, cpu = len(starts), torch.device("cpu")
        if log.has("rpm"):
            to_next = np.concatenate([log.rpm[:, 0], log.rpm[-1:, 0]])
            speeds = RADIANS_PER_SECOND * (to_next[:-1] + to_next[1:]) / 2
        else:
            speeds = np.sqrt(thrusts(log) / own["k_eta"])
        rows = starts[:, None] + np.arange(-BEFORE, LENGTH)
        inputs = torch.from_numpy(speeds[np.maximum(rows, 0)][..., ours])
        start = {"x": log.pos, "v": log.vel, "q": log.quat, "w": log.omega}
        start = {name: torch.from_numpy(x[starts, 0]).double() for name, x in start.items()}
        start |= {"wind": torch.zeros(n, 3).double(), "rotor_speeds": inputs[:, 0].clone()}
        vehicles = BatchedMultirotor(BatchedMultirotorParams([own] * n, n, cpu), n, start, cpu, integrator="rk4")
        everyone, state, kept = np.arange(n), {k: v.clone() for k, v in start.items()}, []
        with torch.no_grad():
            for row in range(-BEFORE, LENGTH):
                given = inputs[:, BEFORE + row]
                if row == 0:
                    state = {k: v.clone() for k, v in start.items()} | {"rotor_speeds": state["rotor_speeds"]}
                if log.has("rpm"):
                    state["rotor_speeds"] = given.clone()
                state = vehicles.step(state, {"cmd_motor_speeds": given}, PERIOD, everyone)
                if row + 1 in HORIZONS:
                    kept.append({k: v.numpy().copy() for k, v in state.items()})
        fields = {"pos": "x", "quat": "q", "vel": "v", "omega": "w", "rpm": "rotor_speeds"}
        return jd.State(**{f: jnp.asarray(np.stack([k[name] for k in kept], axis=1)) for f, name in fields.items()})

    return fly


def thrusts(log: FlightLog) -> np.ndarray:
    """(T, 4) thrusts by the firmware's curve of the propellers 2.1+, N."""
    return np.asarray(crazyflie_motors().thrust(jnp.asarray(log.pwm[:, 0] / FULL_PWM * log.vbat)))


if __name__ == "__main__":
    main()
