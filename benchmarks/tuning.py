"""How much do the gains of `optimal.tune` improve tracking?

A vehicle with lagging rotors and drag flies three curves that were not used for tuning, and to a point 0.7 m away, with
a controller at 500 Hz, for 8 s each. It starts level, with the velocity of the curve. Results before tuning are with
the initial gains: those of the controller, scaled to the vehicle if they depend on it. The first tuning with a
controller includes compilation.
"""

import argparse
import functools
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from jaxdrones.control import CONTROLLERS, for_team, pid
from jaxdrones.optimal import tuning
from jaxdrones.tasks.curves import RANDOM_NUMBERS, SHAPES, setpoint_on
from jaxdrones.vehicles import draw

HZ, SECONDS = 500, 8
CURVES = (("lissajous", 9.0), ("figure-eight", 6.0), ("polynomial", 14.0))
STEP = (0.5, -0.4, 0.3)  # m


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--controllers", default=",".join(name for name in CONTROLLERS if name != "mrac"))
    parser.add_argument("--vehicles", default="cf2x,hb,racer,drawn 0,drawn 1")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    jax.config.update("jax_enable_compilation_cache", False)
    controllers, vehicles = options.controllers.split(","), options.vehicles.split(",")
    if options.quick:
        controllers, vehicles = ["geometric"], ["racer"]
    lines = ["controller   | vehicle | kg    | curves, cm: before -> after | step, cm: before -> after | s (of CPU)"]
    rows = []
    for controller in controllers:
        for vehicle in vehicles:
            params = params_of(vehicle)
            if controller != "pid" or pid.fits(params):
                rows.append({"controller": controller, "vehicle": vehicle} | row(controller, params, options.quick))
                lines.append(line(rows[-1]))
    return {"rows": rows}, lines


def line(row: dict) -> str:
    (curves, step), (curves_after, step_after) = (100 * np.array(row[when]) for when in ("before", "after"))
    return (
        f"{row['controller']:12} | {row['vehicle']:7} | {row['mass']:5.3f} | "
        f"{curves:10.2f} -> {curves_after:7.2f}       | {step:8.2f} -> {step_after:7.2f}      | "
        f"{row['seconds']:.0f} ({row['cpu_seconds']:.0f})"
    )


def params_of(vehicle: str) -> jd.Params:
    if vehicle.startswith("drawn"):
        return draw(jax.random.key(int(vehicle.split()[1])), jd.load_params("cf2x"))
    return jd.load_params(vehicle)


def row(controller: str, params: jd.Params, quick: bool) -> dict:
    before = tuning.start(CONTROLLERS[controller], params)
    begin = time.perf_counter(), time.process_time()
    after = jax.block_until_ready(jd.optimal.tune(params, controller, **(dict(iterations=2) if quick else {})))
    seconds, cpu_seconds = time.perf_counter() - begin[0], time.process_time() - begin[1]
    errors = functools.partial(flown_errors, CONTROLLERS[controller])
    return {
        "mass": float(params.mass),
        "before": np.asarray(errors(params, before)).tolist(),
        "after": np.asarray(errors(params, after)).tolist(),
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
    }


@functools.partial(jax.jit, static_argnums=0)
def flown_errors(module, params: jd.Params, gains) -> jax.Array:
    """Root mean square distance, m, from the curves, and from the place."""
    random = jnp.asarray(np.random.default_rng(7).uniform(-1, 1, RANDOM_NUMBERS), float)
    points = [lambda t, curve=curve, period=period: SHAPES[curve](random, t / period) for curve, period in CURVES]
    points.append(lambda t: jnp.asarray(STEP, t.dtype) + 0 * t)

    def target(t):
        return jax.tree.map(lambda *x: jnp.stack(x), *(setpoint_on(point, t) for point in points))

    def fly(team, memory, state, k):
        call = functools.partial(module.control, gains, dt=1 / HZ)
        return jax.vmap(call)(team, memory, state, target((k + 1) / HZ))

    n, first = len(points), target(jnp.zeros(()))
    pos = first.pos.at[-1].set(0)
    hover = jnp.broadcast_to(params.hover_rpm, (n, 4))
    state = jd.State.at_rest(pos).replace(vel=first.vel, rpm=hover)
    step = jd.make_step([jd.drag], rotors=jd.lagging_rotors, dt=1 / HZ)
    memory = for_team(module.init(), n)
    flown = jd.rollout(step, fly, jd.repeat(params, n), state, memory, SECONDS * HZ)[1]
    wanted = jax.vmap(target)(jnp.arange(1, SECONDS * HZ + 1) / HZ).pos
    squares = jnp.mean(jnp.sum((flown.pos - wanted) ** 2, axis=-1), axis=0)
    return jnp.sqrt(jnp.stack([jnp.mean(squares[:-1]), squares[-1]]))
