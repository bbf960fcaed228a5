"""How close to the time-optimal lap of a point mass does a policy fly?

Level 0 of the task `race`, one drone from rest on the ground to the last gate. The bound is the fastest flight of a
point mass with the maximum thrust of the vehicle in any direction without delay, without drag: constant accelerations
in `--nodes` intervals per gate, solved by IPOPT (CasADi). `openings`: it may pass anywhere in the openings, a bound for
every flight; `drone`: with a drone's radius between its center and the frame; `centers`: through the centers.
"""

import argparse
import dataclasses
import time

import jax
import numpy as np

import jaxdrones as jd
from benchmarks import self_play
from jaxdrones.learning import bptt, checkpoint
from jaxdrones.tasks.racetrack import GATES, OPENING, START
from jaxdrones.tasks.starts import standing_height
from jaxdrones.training.presets import preset

OPTIONS = {"level": 0, "drones": 1}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--laps", type=int, default=1000, help="from starts within 5 cm of the start")
    parser.add_argument("--nodes", type=int, default=40)
    parser.add_argument("--updates", type=int, help="of the training; by default those of the preset")
    parser.add_argument("--acceleration", type=float, default=12.0, help="of the task, m/s^2")
    parser.add_argument("--policy", help="path of a policy to fly in place of training")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    if options.quick:
        options.seeds, options.laps, options.nodes, options.updates = 1, 4, 10, 2
    changes = OPTIONS | {"acceleration": options.acceleration}
    env = jd.make("race", **changes)
    params = env.params
    start = np.array([*START, float(standing_height(params)[0])])
    thrust = float(4 * params.kf[0] * params.max_rpm[0] ** 2 / params.mass[0])
    radius = float(params.collision_radius[0])
    halves = {"openings": OPENING / 2, "drone": OPENING / 2 - radius, "centers": 1e-6}
    bounds = {
        name: fastest(GATES, start, thrust, float(params.gravity[0]), half, options.nodes)
        for name, half in halves.items()
    }
    train, config = preset("race", "bptt", practice=True, **changes)
    config = dataclasses.replace(config, updates=options.updates or config.updates)
    rows = []
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        begin = time.perf_counter()
        if options.policy:
            policy = checkpoint.load(options.policy)
        else:
            policy = jax.block_until_ready(bptt.train(jax.random.key(seed), train, config)).policy
        row = {"seed": seed, "seconds": time.perf_counter() - begin}
        rows.append(row | self_play.summary(self_play.fly(env, policy, options.laps)))
    lines = ["bound     | s"]
    lines += [f"{name:9} | {bound:.3f}" for name, bound in bounds.items()]
    lines += ["", f"seed | completed % [95 %]    | lap s           | over the bound: {', '.join(bounds)} | train s"]
    for row in rows:
        ratios = ", ".join(f"{row['lap'][0] / bound:.3f}" for bound in bounds.values())
        lines.append(
            f"{row['seed']:4} | {self_play.percent(row['completed'])} | {row['lap'][0]:.3f} +- {row['lap'][1]:.3f} |"
            f" {ratios} | {row['seconds']:.0f}"
        )
    return {"about": changes | {"nodes": options.nodes}, "bounds": bounds, "rows": rows}, lines


def fastest(gates: np.ndarray, start: np.ndarray, thrust: float, gravity: float, half: float, nodes: int) -> float:
    """Time of the fastest flight of a point mass through gates, s.

    Args:
        gates: (g, 4) x, y, z (m) and crossing heading (rad) of each gate.
        start: (3,) position at rest, m.
        thrust: largest thrust over mass, m/s^2.
        gravity: m/s^2.
        half: largest distance from the center of a gate, to its sides and up or down, m.
        nodes: intervals of constant acceleration before each gate.
    """
    import casadi as ca

    problem = ca.Opti()
    count = len(gates) * nodes
    pos, vel, acc = problem.variable(3, count + 1), problem.variable(3, count + 1), problem.variable(3, count)
    times = problem.variable(len(gates))
    problem.subject_to(pos[:, 0] == start)
    problem.subject_to(vel[:, 0] == 0)
    problem.subject_to(ca.vec(pos[2, :]) >= start[2])
    before = start
    for i, (*center, yaw) in enumerate(gates):
        dt = times[i] / nodes
        problem.subject_to(times[i] >= 0.02)
        problem.set_initial(times[i], 0.6)
        for k in range(i * nodes, (i + 1) * nodes):
            problem.subject_to(pos[:, k + 1] == pos[:, k] + dt * vel[:, k] + dt**2 / 2 * acc[:, k])
            problem.subject_to(vel[:, k + 1] == vel[:, k] + dt * acc[:, k])
            problem.subject_to(ca.sumsqr(acc[:, k] + ca.DM([0, 0, gravity])) <= thrust**2)
            share = (k + 1) / nodes - i
            problem.set_initial(pos[:, k + 1], (1 - share) * before + share * np.array(center))
            problem.set_initial(vel[:, k + 1], (np.array(center) - before) / 0.6)
        off, speed = pos[:, (i + 1) * nodes] - np.array(center), vel[:, (i + 1) * nodes]
        through, left = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0])
        problem.subject_to(ca.dot(through, off) == 0)
        problem.subject_to(ca.dot(through, speed) >= 0)
        problem.subject_to(problem.bounded(-half, ca.dot(left, off), half))
        problem.subject_to(problem.bounded(-half, off[2], half))
        before = np.array(center)
    problem.minimize(ca.sum1(times))
    problem.solver("ipopt", {"print_time": False}, {"print_level": 0, "max_iter": 3000, "sb": "yes"})
    return float(problem.solve().value(ca.sum1(times)))
