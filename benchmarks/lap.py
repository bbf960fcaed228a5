"""How close to the time-optimal lap does a policy fly?

Level 0 of the task `gates`, one drone, from rest on the ground to the last gate. Bounds are the fastest flights of a
point mass with the maximum thrust of the vehicle in any direction without delay: `openings`: it may pass anywhere in
the openings; `drone`: with a drone's radius between its center and the frame of the gate that it passes; `centers`:
through the centers. `vehicle` is the fastest lap found for the rigid body, whose rotors follow their commands at once,
with a drone's radius to all frames and poles all the time. They are local solutions of IPOPT (CasADi), without drag,
with `--nodes` intervals per gate; few nodes allow flights through frames between them.
"""

import argparse
import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

import jaxdrones as jd
from benchmarks.common import success_rate
from jaxdrones.learning import checkpoint, evaluate
from jaxdrones.tasks.racetrack import GATES, OPENING, POLE_RADIUS, POLES, START
from jaxdrones.tasks.starts import standing_height

if TYPE_CHECKING:
    import casadi as ca

SPREAD = 0.05  # m, of the starts about that of the bounds
_BARRIER_AT_FIRST, _BARRIER_NEAR = 0.1, 1e-3  # of the interior-point method; near a solution it is small
_SHARPNESS = 8  # exponent of the superellipsoids in place of beams, which are nowhere more than
_MARGIN = 0.006  # m too thin


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--laps", type=int, default=1000, help=f"from starts within {100 * SPREAD:g} cm of the start")
    parser.add_argument("--nodes", type=int, default=40)
    parser.add_argument("--policies", nargs="+", default=["gates"], help="bundled ones, or paths without a suffix")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    if options.quick:
        options.laps, options.nodes = 4, 10
    env = jd.make("gates", start_spread=SPREAD)
    bounds = lap_bounds(env, options.nodes)
    lines = ["bound     | s"]
    lines += [f"{name:9} | {bound:.3f}" for name, bound in bounds.items()]
    lines += ["", f"policy    | completed % [95 %]   | lap s | over the bound: {', '.join(bounds)}"]
    rows = []
    for name in options.policies:
        policy = checkpoint.load(name) if "/" in name else jd.make_policy(name)
        report = evaluate(env, policy, jax.random.key(1_000_000), options.laps)
        lap = report.final_metrics["lap_time"]
        rows.append({"policy": name, "completed": report.success, "interval": report.success_interval, "lap": lap})
        ratios = ", ".join(f"{lap / bound:.3f}" for bound in bounds.values())
        lines.append(f"{name:9} | {success_rate(report.success, report.success_interval)} | {lap:.3f} | {ratios}")
    return {"about": {"nodes": options.nodes, "laps": options.laps}, "bounds": bounds, "rows": rows}, lines


def lap_bounds(env: jd.envs.Env, nodes: int) -> dict[str, float]:
    """Time of the fastest laps, s."""
    params = jax.tree.map(lambda x: np.asarray(x[0], float), env.params)
    start = np.array([*START, float(standing_height(env.params)[0])])
    radius = float(params.collision_radius)
    mass = point_mass(float(params.max_thrust / params.mass), float(params.gravity), start)
    track = Track(GATES, OPENING / 2, nodes)
    narrow = dataclasses.replace(track, half=OPENING / 2 - radius)
    clear = dataclasses.replace(narrow, solids=solids(env, radius))
    flights = {
        "openings": fastest(mass, track),
        "drone": fastest(mass, narrow),
        "centers": fastest(mass, dataclasses.replace(track, half=1e-6)),
    }
    flights["vehicle"] = fastest(vehicle(params, start), clear, flights["drone"])
    return {name: float(flight.times.sum()) for name, flight in flights.items()}


@dataclasses.dataclass(frozen=True)
class Track:
    """Gates, and what a flight keeps clear of."""

    gates: np.ndarray
    """(g, 4) x, y, z (m) and crossing heading (rad) of each gate."""
    half: float
    """Largest distance from the center of a gate, to its sides and up or down, m."""
    nodes: int
    """Intervals before each gate."""
    solids: Sequence[Callable[["ca.MX"], "ca.MX"]] = ()
    """Functions of a position that are positive outside of a solid."""


@dataclasses.dataclass(frozen=True)
class Body:
    """A body that flies; its state x is a vector, its input u too."""

    start: np.ndarray
    """State at the start."""
    inputs: int
    """Length of the input."""
    pos: Callable[[Any], Any]
    """Position (3,) of a state, m."""
    vel: Callable[[Any], Any]
    """Velocity (3,) of a state, m/s."""
    step: Callable[["ca.MX", "ca.MX", "ca.MX"], "ca.MX"]
    """State after a time: (x, u, dt) -> x."""
    limits: Callable[["ca.MX"], "ca.MX"]
    """Vector of an input whose entries are between zero and one."""
    guess: Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
    """State and input for a position, a velocity and an acceleration, for the first iteration."""


@dataclasses.dataclass(frozen=True)
class Flight:
    """A flight from the start through all gates."""

    times: np.ndarray
    """(g,) from gate to gate, s."""
    pos: np.ndarray
    """(nodes g, 3) after each interval, m."""
    vel: np.ndarray
    """(nodes g, 3) after each interval, m/s."""


def point_mass(thrust: float, gravity: float, start: np.ndarray) -> Body:
    """Point mass with a largest thrust over mass, m/s^2."""
    import casadi as ca

    weight = np.array([0, 0, gravity])
    return Body(
        start=np.concatenate([start, np.zeros(3)]),
        inputs=3,
        pos=lambda x: x[:3],
        vel=lambda x: x[3:],
        step=lambda x, u, dt: ca.vertcat(x[:3] + dt * x[3:] + dt**2 / 2 * u, x[3:] + dt * u),
        limits=lambda u: ca.sumsqr(u + weight) / thrust**2,
        guess=lambda pos, vel, acc: (np.concatenate([pos, vel]), np.zeros(3)),
    )


def vehicle(params: jd.Params, start: np.ndarray) -> Body:
    """Rigid body with four rotors that follow their commands at once; the input is their speed over the largest."""
    import casadi as ca

    from jaxdrones.optimal.twin import casadi_model

    model = casadi_model(params)
    moving = 13  # entries of the state before the rotor speeds, which are those commanded

    def rate(x: ca.MX, u: ca.MX) -> ca.MX:
        return model.function(ca.vertcat(x, ca.DM.zeros(4)), u * float(params.max_rpm))[:moving]

    def step(x: ca.MX, u: ca.MX, dt: ca.MX) -> ca.MX:
        a = rate(x, u)
        b = rate(x + dt / 2 * a, u)
        c = rate(x + dt / 2 * b, u)
        return x + dt / 6 * (a + 2 * b + 2 * c + rate(x + dt * c, u))

    def guess(pos: np.ndarray, vel: np.ndarray, acc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y, z = acc + np.array([0, 0, float(params.gravity)])
        tilt = np.array([-y, x, 0, np.linalg.norm([x, y, z]) + z + 1e-3])
        return np.concatenate([pos, tilt / np.linalg.norm(tilt), vel, np.zeros(3)]), np.full(4, 0.9)

    return Body(
        start=guess(start, np.zeros(3), np.zeros(3))[0],
        inputs=4,
        pos=lambda x: x[:3],
        vel=lambda x: x[7:10],
        step=step,
        limits=lambda u: u,
        guess=guess,
    )


def solids(env: jd.envs.Env, radius: float) -> list[Callable[["ca.MX"], "ca.MX"]]:
    """Frames and poles of the track, larger by the radius of a drone (m), with round edges."""
    import casadi as ca

    boxes = env.scene.boxes
    headings = np.repeat(GATES[:, 3], len(boxes.pos) // len(GATES))

    def beam(center: np.ndarray, size: np.ndarray, heading: float) -> Callable[[ca.MX], ca.MX]:
        cos, sin = np.cos(heading), np.sin(heading)
        axes = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        share = axes / (size / 2 + radius + _MARGIN)[:, None]
        return lambda pos: ca.log(ca.sum1((share @ (pos - center)) ** _SHARPNESS) + 1e-3) - np.log(1 + 1e-3)

    def pole(place: np.ndarray) -> Callable[[ca.MX], ca.MX]:
        return lambda pos: ca.sumsqr(pos[:2] - place) - (POLE_RADIUS + radius) ** 2

    beams = zip(np.asarray(boxes.pos, float), np.asarray(boxes.size, float), headings, strict=True)
    return [*(beam(*one) for one in beams), *map(pole, POLES)]


def fastest(body: Body, track: Track, like: Flight | None = None) -> Flight:
    """Fastest flight of a body through gates, never below its start; the iterations begin with a flight like it."""
    import casadi as ca

    problem, gates, nodes = ca.Opti(), track.gates, track.nodes
    start = body.pos(body.start)
    first = like or _straight(gates, start, nodes)
    acc = np.diff(first.vel, axis=0, prepend=np.zeros((1, 3))) / np.repeat(first.times / nodes, nodes)[:, None]
    x, u = problem.variable(len(body.start), len(first.pos) + 1), problem.variable(body.inputs, len(first.pos))
    times = problem.variable(len(gates))
    problem.set_initial(x[:, 0], body.start)
    problem.set_initial(times, first.times)
    problem.subject_to(x[:, 0] == body.start)
    problem.subject_to(times >= 0.02)
    for k, (pos, vel, a) in enumerate(zip(first.pos, first.vel, acc, strict=True)):
        after, before = x[:, k + 1], x[:, k]
        problem.subject_to(after == body.step(before, u[:, k], times[k // nodes] / nodes))
        problem.subject_to(problem.bounded(0, body.limits(u[:, k]), 1))
        problem.subject_to(body.pos(after)[2] >= start[2])
        for outside in track.solids:
            problem.subject_to(outside(body.pos(after)) >= 0)
        state, command = body.guess(pos, vel, a)
        problem.set_initial(after, state)
        problem.set_initial(u[:, k], command)
    for i, (*center, heading) in enumerate(gates):
        at = x[:, (i + 1) * nodes]
        off, cos, sin = body.pos(at) - np.array(center), np.cos(heading), np.sin(heading)
        problem.subject_to(ca.dot([cos, sin, 0], off) == 0)
        problem.subject_to(ca.dot([cos, sin, 0], body.vel(at)) >= 0)
        problem.subject_to(problem.bounded(-track.half, ca.dot([-sin, cos, 0], off), track.half))
        problem.subject_to(problem.bounded(-track.half, off[2], track.half))
    problem.minimize(ca.sum1(times))
    barrier = _BARRIER_AT_FIRST if like is None else _BARRIER_NEAR
    settings = {"print_level": 0, "max_iter": 3000, "sb": "yes", "mu_init": barrier}
    problem.solver("ipopt", {"print_time": False, "expand": True}, settings)
    found = problem.solve()
    states = found.value(x).T[1:]
    pos, vel = (np.stack([part(state) for state in states]) for part in (body.pos, body.vel))
    return Flight(np.atleast_1d(found.value(times)), pos, vel)


def _straight(gates: np.ndarray, start: np.ndarray, nodes: int) -> Flight:
    """Straight from gate to gate in 0.6 s each."""
    ends = np.vstack([start, gates[:, :3]])
    share = np.arange(1, nodes + 1)[:, None] / nodes
    pos = np.concatenate([(1 - share) * a + share * b for a, b in itertools.pairwise(ends)])
    vel = np.repeat(np.diff(ends, axis=0) / 0.6, nodes, axis=0)
    return Flight(np.full(len(gates), 0.6), pos, vel)
