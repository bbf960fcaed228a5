"""Measure crazyflow, rotorpy and jaxdrones in one process, in the environment of the other simulators.

benchmarks/race.py starts it and describes the races. In each, all simulators receive the same starts and commands.
"""

import argparse
import importlib.metadata
import json
import os
import sys
import warnings
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from benchmarks.common import in_turn
from benchmarks.rivals import ours

FREQ = 500  # Hz, crazyflow's default
DT = 1 / FREQ
INTEGRATORS = {"symplectic_euler": jd.semi_implicit_euler, "euler": jd.euler, "rk4": jd.rk4}
"""crazyflow's names, our functions."""

Programs = dict[str, Callable[[], jd.State]]
"""Who flies: a compiled program that returns the final states."""

_STEPS_OF_A_CALL = 2**21  # drone-steps, about
_MOST_STEPS = 5000
_BYTES_OF_COMMANDS = 2**27
_FEW, _LONG = 64, 1000  # worlds and steps of the flight that must be alike
_LAG = 0.03  # s, of the rotors under a controller
_UNBOUNDED = sys.maxsize


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, nargs="+", required=True)
    parser.add_argument("--races", nargs="+", required=True, choices=RACES)
    parser.add_argument("--devices", type=int, required=True)
    parser.add_argument("--repeats", type=int, required=True)
    parser.add_argument("--alone", action="store_true", help="without rivals: does our side run?")
    options = parser.parse_args()
    jax.config.update("jax_num_cpu_devices", options.devices)
    warnings.filterwarnings("ignore", message="Attaching a spec")
    rows = [row for race in options.races for row in _race(race, options)]
    names = ("jax", "jaxlib", "numpy") if options.alone else ("jax", "jaxlib", "numpy", "crazyflow", "rotorpy", "torch")
    versions = {name: importlib.metadata.version(name) for name in names}
    print(json.dumps({"rows": rows, "versions": versions, "load": os.getloadavg()}))


class Plant:
    """Rotor speeds held, lagging rotors, constant drag, float32; vehicle and starts are ours."""

    most_worlds = most_steps = _UNBOUNDED
    least_steps = 50  # a call: a chunk must fly several

    def __init__(self, integrator: str):
        self.integrator = integrator

    def programs(self, worlds: int, steps: int, alone: bool) -> Programs:
        """Of all contenders; of ours alone, without the packages of the others."""
        params = jd.repeat(jd.load_params("cf2x"), 1)
        integrator = INTEGRATORS[self.integrator]
        step = jd.make_step(effects=(ours.constant_drag,), rotors=jd.lagging_rotors, integrator=integrator, dt=DT)
        start, rpm = ours.starts(worlds, jax.random.key(0), params)
        programs = ours.ways(ours.flight(step, steps), jax.devices(), params, start, rpm)
        if alone:
            return programs
        from benchmarks.rivals import crazyflow_many as crazyflow

        return programs | crazyflow.plant(self.integrator, params, start, rpm, FREQ, steps, jax.devices())

    def differences(self, finals: dict[str, jd.State]) -> dict[str, dict[str, float]]:
        """Of every final state from that of our first program."""
        first = next(iter(finals.values()))
        return {name: ours.difference(final, first) for name, final in finals.items()}


class Attitude:
    """A cascade flies each simulator's own Crazyflie: a new attitude and thrust at each step, float32."""

    most_worlds = most_steps = _UNBOUNDED
    least_steps = 50

    def programs(self, worlds: int, steps: int, alone: bool) -> Programs:
        """Of all contenders; of ours alone, without the packages of the others."""
        params = jd.repeat(ours.even_rotors(_LAG), 1)
        step = jd.make_step(effects=(ours.constant_drag,), rotors=jd.lagging_rotors, dt=DT)
        start, _ = ours.starts(worlds, jax.random.key(0), params)
        rpy, thrust_to_weight = ours.attitudes(worlds, steps, jax.random.key(1))
        self._asked = rpy[-1]
        commands = jnp.asarray(np.concatenate([rpy, thrust_to_weight * np.asarray(params.weight[0])], axis=-1))
        programs = ours.ways(ours.controlled(step, DT), jax.devices(), params, start, commands, axis=1)
        if alone:
            return programs
        from benchmarks.rivals import crazyflow_many as crazyflow

        return programs | crazyflow.attitude(start, rpy, thrust_to_weight, FREQ, jax.devices())

    def differences(self, finals: dict[str, jd.State]) -> dict[str, dict[str, float]]:
        """Of every final attitude from the one asked for, rad."""
        goal = jax.vmap(jax.vmap(jd.rotation.from_rpy))(self._asked)
        return {name: {"angle": ours.angle(final.quat, goal)} for name, final in finals.items()}


class Rotorpy(Plant):
    """The plant without drag, by rk4, in float64: rotorpy has no other numbers, no Euler, and another drag."""

    most_worlds, most_steps, least_steps = 16384, 100, 10  # it makes 200,000 steps/s

    def __init__(self):
        super().__init__("rk4")

    def programs(self, worlds: int, steps: int, alone: bool) -> Programs:
        """Of all contenders; of ours alone, without the packages of the others."""
        with jax.enable_x64(True):
            params = jd.repeat(jax.tree.map(lambda x: x.astype(float), ours.even_rotors(0.055)), 1)
            step = jd.make_step(rotors=jd.lagging_rotors, integrator=jd.rk4, dt=DT)
            start, rpm = ours.starts(worlds, jax.random.key(0), params)
            programs = ours.ways(ours.flight(step, steps), jax.devices(), params, start, rpm)
            if alone:
                return programs
            from benchmarks.rivals import rotorpy

            return programs | rotorpy.plant(params, start, rpm, DT, steps)


RACES = {f"plant-{name}": partial(Plant, name) for name in INTEGRATORS} | {"attitude": Attitude, "rotorpy": Rotorpy}


def _race(name: str, options) -> list[dict[str, object]]:
    """Rates in million drone-steps per second, and how far the contenders part in a flight of two seconds."""
    race = RACES[name]()
    long = 10 if options.alone else min(_LONG, race.most_steps)
    programs = race.programs(_FEW, long, options.alone)
    differences = race.differences({who: program() for who, program in programs.items()})
    rows = []
    for worlds in (w for w in options.worlds if w <= race.most_worlds):
        most = min(_MOST_STEPS, race.most_steps, _BYTES_OF_COMMANDS // (16 * worlds), _STEPS_OF_A_CALL // worlds)
        steps = 10 if options.alone else max(race.least_steps, most)
        times = in_turn(race.programs(worlds, steps, options.alone), options.repeats, 0 if options.alone else 0.05)
        rates, best = (
            {who: worlds * steps / 1e6 / taken[kind] for who, taken in times.items()} for kind in ("median", "best")
        )
        rows.append({"race": name, "worlds": worlds, "steps": steps, "rates": rates, "best": best})
        print(name, worlds, {who: round(rate, 2) for who, rate in rates.items()}, file=sys.stderr, flush=True)
    return [row | {"differences": differences} for row in rows]


if __name__ == "__main__":
    main()
