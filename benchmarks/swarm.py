"""How long does a step of up to 4,096 drones in one world take, each in the downwash of the others?

Drones 1 m apart on a jittered grid, 1 to 4 m high, drag and downwash, semi-implicit Euler at 240 Hz, float32. `all
pairs` computes every pair, `cells` only pairs within 2 m horizontally. `gym-pybullet-drones` is only its downwash
(equation 6), a Python loop over pairs without the calls of PyBullet, timed for 30 drones and extrapolated by the number
of pairs.
"""

import argparse
import math
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from benchmarks.common import compiled, in_turn, loglog

DRONES = (1, 8, 32, 100, 300, 1000, 2000, 4096)
REACH = 2.0  # m
FEW = 30  # drones of the timed loop
MOST_PAIRS = 2**22  # tried by `all pairs`, so that a benchmark ends
STEPS = 5
NAMES = ("all pairs", "cells", "gym-pybullet-drones")
_LABELS = {"cells": "pairs within 2 m, by a grid"}  # of the figure


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--drones", type=int, nargs="+", default=DRONES)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--figure", help="PNG to write")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    if options.quick:
        options.drones, options.repeats = (1, 40), 1

    a_pair = gym_pybullet_drones_pair(options.repeats)
    rows = [measure(n, options.repeats) | {"gym-pybullet-drones": a_pair * n * (n - 1)} for n in options.drones]
    lines = []
    lines.append("ms per step of the world; cells over N log N, us; gym-pybullet-drones over our faster one")
    for row in rows:
        n, ours = row["drones"], min(row[name] for name in NAMES[:2] if name in row)
        cells = "          " if "cells" not in row else f"{1e6 * row['cells'] / (n * math.log2(max(n, 2))):10.3f}"
        taken = " | ".join(f"{name} {1e3 * row[name]:10.3f}" for name in NAMES if name in row)
        lines.append(f"{n:5} drones | {taken} | {cells} | {row[NAMES[2]] / ours:8.1f}")
    if options.figure:
        draw(rows, options.figure)
    return {"rows": rows}, lines


def draw(rows: list[dict[str, float]], path: str) -> None:
    """Draw the seconds of a step over the number of drones; those of gym-pybullet-drones are extrapolated."""
    curves = {_LABELS.get(name, name): [(row["drones"], row[name]) for row in rows if row.get(name)] for name in NAMES}
    loglog(path, curves, "drones in a world", "seconds per step", dashed=NAMES[2])


def measure(n: int, repeats: int) -> dict[str, float]:
    """Seconds of a step, and of compiling it."""
    side = math.ceil(math.sqrt(n))
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)[:n]
    pos = np.column_stack([grid + rng.uniform(-0.3, 0.3, (n, 2)), rng.uniform(1, 4, n)])
    params = jd.repeat(jd.load_params("cf2x"), n)
    state = jd.State.at_rest(jnp.asarray(pos, jnp.float32)).replace(rpm=params.hover_rpm[:, None] * jnp.ones((n, 4)))
    ways = {"all pairs": None} if n**2 <= MOST_PAIRS else {}
    ways |= {"cells": jd.NeighborGrid(REACH)} if n > 1 else {}
    row = {"drones": n}
    programs = {}
    for name, cells in ways.items():
        step = jd.make_step((jd.drag,), (jd.downwash,), neighbors=cells)
        program, row[f"{name}, compile"] = compiled(lambda s, step=step: _flown(step, params, s), state)
        programs[name] = lambda program=program: program(state)
    return row | {name: taken["median"] / STEPS for name, taken in in_turn(programs, repeats).items()}


def _flown(step: jd.Step, params: jd.Params, state: jd.State) -> jd.State:
    return jax.lax.scan(lambda s, _: (step(params, s, s.rpm), None), state, length=STEPS)[0]


def gym_pybullet_drones_pair(repeats: int) -> float:
    """Seconds that the Python of gym-pybullet-drones takes for the downwash of one drone on another."""
    params = jd.load_params("cf2x")
    k1, k2, k3 = (float(k) for k in params.downwash_coeff)
    radius = float(params.prop_radius)
    pos = np.random.default_rng(0).uniform(0, 3, (FEW, 3))

    def all_forces() -> float:
        start = time.perf_counter()
        for i in range(FEW):
            for j in range(FEW):
                dz = pos[j, 2] - pos[i, 2]
                dxy = np.linalg.norm(pos[j, :2] - pos[i, :2])
                if dz > 0 and dxy < 10:
                    alpha = k1 * (radius / (4 * dz)) ** 2
                    beta = k2 * dz + k3
                    [0, 0, -alpha * np.exp(-0.5 * (dxy / beta) ** 2)]
        return time.perf_counter() - start

    return sorted(all_forces() for _ in range(repeats))[repeats // 2] / FEW**2
