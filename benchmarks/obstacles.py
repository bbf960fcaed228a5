"""How much do solid obstacles, near and far, slow down a step?

One drone per world, drag, semi-implicit Euler at 240 Hz, in a compiled loop of one second; and the gradient of the
final position with respect to the commands. Times are nanoseconds per step. The drones start among 20 solids at up to
2 m/s; with `far` the same solids are out of reach. `over` is the time relative to the plant without obstacles.
"""

import argparse
import functools

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from benchmarks.cameras_scenes import objects20
from benchmarks.common import in_turn

DT = 1 / 240  # s
AWAY = 500.0  # m


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--worlds", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=9)


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    seconds, programs = 1.0, {"forward": _end, "gradient": jax.grad(_miss, argnums=3)}
    if options.quick:
        options.worlds, options.repeats, seconds = 8, 1, 4 * DT
        del programs["gradient"]  # half a minute of compiling
    near, team = objects20(), jd.repeat(jd.load_params("cf2x"), 1)
    far = near.replace(**{kind: _moved(getattr(near, kind)) for kind in ("boxes", "spheres")})
    scenes = {"none": jd.Scene(ground=False), "20 solids, far": far, "20 solids": near}
    start = starts(options.worlds)
    commands = jnp.ones((options.worlds, round(seconds / DT), 1, 4))
    rows: list[dict] = [{"obstacles": name} for name in scenes]
    for what, program in programs.items():
        flights = {}
        for name, scene in scenes.items():
            step = jd.make_step(effects=(jd.drag, jd.obstacle_contact), dt=DT, scene=scene)
            flights[name] = functools.partial(jd.over_worlds(functools.partial(program, step, team)), start, commands)
        times = [taken["median"] for taken in in_turn(flights, options.repeats).values()]
        for row, taken in zip(rows, times, strict=True):
            row[f"{what} ns"], row[f"{what} over"] = 1e9 * taken / commands[..., 0, 0].size, taken / times[0]
    lines = [f"{'obstacles':14}" + "".join(f" | {what:>8} ns   over" for what in programs)]
    lines += [
        f"{row['obstacles']:14}"
        + "".join(f" | {row[f'{what} ns']:11.1f} {row[f'{what} over']:6.1f}" for what in programs)
        for row in rows
    ]
    return {"worlds": options.worlds, "rows": rows}, lines


def starts(worlds: int) -> jd.State:
    """States of the only drone of many worlds, at random between the solids."""
    rng = np.random.default_rng(5)
    pos, vel = (jnp.asarray(rng.uniform(-size, size, (worlds, 1, 3)), jnp.float32) for size in (6.0, 2.0))
    return jax.vmap(jd.State.at_rest)(pos).replace(vel=vel)


def _moved(solids):
    return solids.replace(pos=solids.pos + AWAY)


def _end(step, team, start, commands):
    hover = team.hover_rpm[:, None]
    return jax.lax.scan(lambda state, share: (step(team, state, share * hover), None), start, commands)[0].pos


def _miss(step, team, start, commands):
    return jnp.sum(_end(step, team, start, commands) ** 2)
