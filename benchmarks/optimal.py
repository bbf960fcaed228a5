"""How accurately do optimal controllers track, and how long does a command take?

A Crazyflie with drag tracks curves about (0, 0, 2) m, starting with the motion of the curve, at 100 control steps per
second (MPC: 40). All controllers receive velocity and acceleration of the set-points. The error is the root mean square
distance from the curve after the first second. The time is that of a command for one drone; for MPC that of the solver.
The cost of the symbolic twin is also measured.
"""

import argparse
import functools
import importlib.util
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from jaxdrones.control import for_team, geometric, pid
from jaxdrones.optimal import ilqr, lqr, mppi
from jaxdrones.tasks.curves import RANDOM_NUMBERS, SHAPES, setpoint_on

ROWS = (
    ("figure-eight", 10.0),
    ("figure-eight", 5.0),
    ("figure-eight", 3.0),
    ("circle", 5.0),
    ("lissajous", 10.0),
    ("polynomial", 10.0),
)
CONTROLLERS = {"pid": pid, "geometric": geometric, "lqr": lqr, "ilqr": ilqr, "mppi": mppi}
HZ, MPC_HZ, PHYSICS_HZ = 100, 40, 240


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=float, default=10.0, help="of a flight")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    rows = ROWS[1:2] if options.quick else ROWS
    seconds = 1.2 if options.quick else options.seconds
    results = []
    for name, module in CONTROLLERS.items():
        fly = flight(name, module, round(seconds * HZ))
        results += [{"controller": name, "curve": row[0], "period": row[1], **fly(*row)} for row in rows]
    twin = None
    if importlib.util.find_spec("casadi"):
        from jaxdrones.optimal.mpc import SOLVERS

        start = time.perf_counter()
        twin = {"seconds": (model(), time.perf_counter() - start)[1]}
        for solver in SOLVERS:
            results += [
                {"controller": f"mpc, {solver}", "curve": row[0], "period": row[1], **by_mpc(solver, seconds, *row)}
                for row in rows
            ]
    lines = []
    lines.append("controller   | curve, period        | rms error, cm | ms a command, median (95 %)")
    for row in results:
        times = f"{row['ms']:.3f}" + (f" ({row['ms_95']:.1f})" if "ms_95" in row else "")
        curve = f"{row['curve']}, {row['period']:g} s"
        lines.append(f"{row['controller']:12} | {curve:20} | {100 * row['rms']:13.3f} | {times}")
    lines.append("MPC: casadi is not installed" if twin is None else f"symbolic twin: made in {twin['seconds']:.2f} s")
    return {"rows": results, "twin": twin}, lines


def target_on(curve: str, period: float):
    """Time (s) -> setpoint."""
    random = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, RANDOM_NUMBERS), float)
    return functools.partial(setpoint_on, lambda t: jnp.array([0, 0, 2.0]) + SHAPES[curve](random, t / period))


def start_of(team, target):
    """A level drone with the motion of the target."""
    first = target(jnp.zeros(()))
    hover = jnp.broadcast_to(team.hover_rpm[:, None], (1, 4))
    return jd.State.at_rest(first.pos[None]).replace(vel=first.vel[None], rpm=hover)


def step_at(hz: int):
    substeps = -(-PHYSICS_HZ // hz)
    return jd.make_step([jd.drag], dt=1 / hz / substeps, substeps=substeps)


def flight(name: str, module, length: int):
    """(curve, period) -> error and time of a command."""
    team, step, dt = jd.repeat(jd.load_params("cf2x"), 1), step_at(HZ), 1 / HZ
    preview = module in (lqr, ilqr, mppi)
    gains = module.settings(step) if preview else (pid.gains("cf2x") if module is pid else geometric.gains())
    control = functools.partial(module.control, gains, dt=dt)

    def fly(curve: str, period: float) -> dict[str, float]:
        target = target_on(curve, period)
        state = start_of(team, target)
        if preview:
            keys = (jax.random.key(0)[None],) if module is mppi else ()
            memory = jax.jit(jax.vmap(functools.partial(module.init, gains)))(team, state, *keys)
        else:
            memory = for_team(module.init(), 1)

        def command(params, memory, state, k):
            times = (k + jnp.arange(gains.horizon + 1)) * dt if preview else k * dt
            setpoints = jax.vmap(target)(times) if preview else target(times)
            return jax.vmap(control)(params, memory, state, jax.tree.map(lambda x: x[None], setpoints))

        run = jax.jit(lambda state, memory: jd.rollout(step, command, team, state, memory, length)[1])
        jax.block_until_ready(run(state, memory))
        start = time.perf_counter()
        flown = jax.block_until_ready(run(state, memory))
        spent = time.perf_counter() - start
        wanted = jax.vmap(target)(dt * jnp.arange(1, length + 1)).pos
        return {"rms": rms(flown.pos[:, 0] - wanted, HZ), "ms": 1e3 * spent / length}

    return fly


def rms(difference, hz: int) -> float:
    return float(np.sqrt(np.mean(np.sum(np.asarray(difference)[hz:] ** 2, axis=-1))))


@functools.cache
def model():
    from jaxdrones.optimal.twin import casadi_model

    return casadi_model("cf2x", [jd.drag])


def by_mpc(solver: str, seconds: float, curve: str, period: float) -> dict[str, float]:
    """Error of a flight by CasADi, and the times of its solver."""
    from jaxdrones.optimal.mpc import Mpc

    dt, length = 1 / MPC_HZ, round(seconds * MPC_HZ)
    mpc, team, step = Mpc(model(), dt, solver=solver), jd.repeat(jd.load_params("cf2x"), 1), step_at(MPC_HZ)
    target = target_on(curve, period)
    targets = jax.jit(jax.vmap(target))
    state, ahead = start_of(team, target), dt * jnp.arange(mpc.horizon + 1)
    places, times = [], []
    for k in range(length):
        rpm = mpc(jax.tree.map(lambda x: x[0], state), targets(k * dt + ahead))
        times.append(mpc.seconds)
        state = step(team, state, jnp.asarray(rpm, float)[None])
        places.append(state.pos[0])
    wanted = targets(dt * jnp.arange(1, length + 1)).pos
    error = rms(jnp.stack(places) - wanted, MPC_HZ)
    return {"rms": error, "ms": 1e3 * float(np.median(times)), "ms_95": 1e3 * float(np.percentile(times, 95))}
