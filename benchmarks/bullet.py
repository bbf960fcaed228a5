"""How many steps and frames per second does the Bullet backend compute?

Rates are per second of CPU time of one process, which depends less on other processes. A physics step is 1/240 s.
Medians of repeats, all in one run.
"""

import argparse
import functools
import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from jaxdrones.control import Setpoint, for_team, pid
from jaxdrones.engine import bullet
from jaxdrones.sensing import Box, Cylinder, Scene, Sphere

EFFECTS = dict(effects=(jd.drag, jd.ground_effect), pairs=(jd.downwash,))
PRIMITIVES = Scene.of(
    *(Box(pos=(2.0 + 0.3 * i, 0.4 * i - 0.8, 0.5), size=(0.2, 0.2, 1.0)) for i in range(4)),
    *(Sphere(pos=(3.0, 0.8 * i - 0.8, 1.2), radius=0.2) for i in range(3)),
    *(Cylinder(pos=(4.0, 0.8 * i - 0.8, 0.5), radius=0.1, height=1.0) for i in range(3)),
)


def hovering(n: int) -> tuple[jd.Params, jd.State, np.ndarray]:
    """A team in a slanted row, high enough to stay in the air, and the rotor speeds of hover."""
    params = jd.repeat(jd.load_params("cf2x"), n)
    i = jnp.arange(n)
    start = jd.State.at_rest(jnp.stack([0.3 * i, 0.0 * i, 50.0 + 0.1 * i], axis=-1))
    return params, start, np.asarray(params.hover_rpm[:, None] * jnp.ones((1, 4)))


def median_rate(work, count: int, repeats: int) -> float:
    """Units of work per second of processor time: `work()` does `count` of them; the first call warms up."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return count / statistics.median(times)


def open_loop(n: int, steps: int, repeats: int) -> float:
    """Physics steps per second of a world with n drones and every effect, one per call."""
    params, start, rpm = hovering(n)
    with bullet.make_step(**EFFECTS) as step:

        def work():
            state = start
            for _ in range(steps):
                state = step(params, state, rpm)

        return median_rate(work, steps, repeats)


def closed_loop(steps: int, repeats: int) -> float:
    """Physics steps per second of one drone with every effect and the PID, five physics steps per control."""
    params, start, _ = hovering(1)
    pilot = functools.partial(pid.control, pid.gains(), dt=5 / 240)
    target = Setpoint.at(start.pos)

    def control(params, memory, state, k):
        return jax.vmap(pilot)(params, memory, state, target)

    with bullet.make_step(**EFFECTS, substeps=5) as step:
        work = functools.partial(jd.rollout, step, control, params, start, for_team(pid.init(), 1), steps)
        return median_rate(work, 5 * steps, repeats)


def frames(count: int, repeats: int) -> float:
    """64 x 48 frames of RGB, depth and segmentation per second in a scene of a plane and ten primitives."""
    params, start = jd.repeat(jd.load_params("cf2x"), 1), jd.State.at_rest([[0, 0, 1]])
    with bullet.make_step(scene=PRIMITIVES) as step:

        def work():
            for _ in range(count):
                step.camera(params, start)

        return median_rate(work, count, repeats)


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    steps, repeats = (20, 1) if options.quick else (3000, 7)
    rates = {
        "1 drone, every effect: physics steps/s": open_loop(1, steps, repeats),
        "1 drone, every effect, PID, 5 substeps: physics steps/s": closed_loop(steps // 5, repeats),
        "10 drones, every effect: world steps/s": open_loop(10, steps // 4, repeats),
        "64 x 48 RGB + depth + segmentation, ten primitives: frames/s": frames(steps // 10, repeats),
    }
    return {"rates": rates}, [f"{rate:10,.0f}  {name}" for name, rate in rates.items()]
