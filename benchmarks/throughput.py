"""How many drone-steps per second does the explicit backend simulate, forward and with the gradient?

A world is one drone with constant rotor speeds, different in every world. One call simulates many steps. The first call
compiles.
"""

import argparse
from collections.abc import Callable

import jax
import jax.numpy as jnp

import jaxdrones as jd
from benchmarks.common import first_call, seconds
from jaxdrones.checks import check_choice
from jaxdrones.cli.throughput import crazyflies, held
from jaxdrones.dynamics import EFFECTS, INTEGRATORS, PAIRS, ROTORS

WORLDS = (1, 64, 1024, 16384, 262144)
GRADIENT_STEPS = 100
STEPS_OF_A_CALL = 2**23  # drone-steps of a forward measurement, about


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--worlds", type=int, nargs="+", default=WORLDS)
    parser.add_argument("--drones", type=int, default=1, help="drones per world")
    parser.add_argument("--vmap", action="store_true", help="fly by plain jax.vmap instead of jaxdrones.over_worlds")
    parser.add_argument("--effects", default="drag", help="names as in `jaxdrones list`, or none")
    parser.add_argument("--rotors", default="instant")
    parser.add_argument("--integrator", default="semi_implicit_euler")
    parser.add_argument("--substeps", type=int, default=1)
    parser.add_argument("--gradient-worlds", type=int, default=8192, help="at most, of a gradient, whose memory grows")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--float64", action="store_true")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    jax.config.update("jax_enable_x64", options.float64)
    if options.quick:
        options.worlds, options.repeats = (1, 32), 1

    step = make_step(options)
    rows = [measure(step, worlds, options) for worlds in options.worlds]
    a_step = {
        "dt": 1 / 240,
        "substeps": options.substeps,
        "integrator": options.integrator,
        "rotors": options.rotors,
        "effects": options.effects,
        "controller": "none, constant rotor speeds",
        "drones per world": options.drones,
        "many worlds": "jax.vmap" if options.vmap else "jaxdrones.over_worlds",
        "dtype": "float64" if options.float64 else "float32",
        "gradient": f"of the mean squared final position in the rotor speeds of {GRADIENT_STEPS} steps",
    }
    lines = [
        "   worlds | forward M/s (best) | with backward M/s | time over forward | first call s, forward and backward"
    ]
    lines += [
        f"{row['worlds']:9} | {row['forward']:8.1f} ({row['forward best']:6.1f})  | {row['with backward']:17.2f} |"
        f" {row['time over forward']:17.1f} | {row['forward first call']:.2f} {row['backward first call']:.2f}"
        for row in rows
    ]
    return {"about": a_step, "rows": rows}, lines


def make_step(options) -> jd.Step:
    names = [] if options.effects == "none" else options.effects.split(",")
    for name in names:
        check_choice("effect", name, EFFECTS | PAIRS)
    return jd.make_step(
        effects=[EFFECTS[name] for name in names if name in EFFECTS],
        pairs=[PAIRS[name] for name in names if name in PAIRS],
        rotors=ROTORS[options.rotors],
        integrator=INTEGRATORS[options.integrator],
        substeps=options.substeps,
    )


def miss(step: jd.Step, params: jd.Params) -> Callable[[jd.State, jax.Array], jax.Array]:
    """`(start, rpms) -> mean squared final position` of one world, with other rotor speeds in every step."""

    def loss(start: jd.State, rpms: jax.Array) -> jax.Array:
        final, _ = jax.lax.scan(lambda state, rpm: (step(params, state, rpm), None), start, rpms)
        return jnp.mean(final.pos**2)

    return loss


def measure(step: jd.Step, worlds: int, options) -> dict[str, float]:
    """Rates in million drone-steps per second; the gradient is against the forward pass of the same rollout."""
    n = options.drones
    params, starts, rpm = crazyflies(worlds, n)
    length = (
        10 if options.quick else max(GRADIENT_STEPS, min(20_000, STEPS_OF_A_CALL // (worlds * n * options.substeps)))
    )
    grad_length = 10 if options.quick else GRADIENT_STEPS

    loss = miss(step, params)

    def many(world):
        return jax.jit(jax.vmap(world)) if options.vmap else jd.over_worlds(world)

    forward = many(held(step, params, length))
    first_forward = first_call(forward, starts, rpm)
    time = seconds(forward, starts, rpm, repeats=options.repeats)
    steps = worlds * n * options.substeps / 1e6

    few = min(worlds, options.gradient_worlds)  # on a CPU a part of many shows the same: memory grows, speed does not
    starts, rpms = jax.tree.map(lambda x: x[:few], (starts, jnp.repeat(rpm[:, None], grad_length, axis=1)))
    value, gradient = many(loss), many(jax.value_and_grad(loss, 1))
    first_backward = first_call(gradient, starts, rpms)
    value_time = seconds(value, starts, rpms, repeats=options.repeats)["median"]
    gradient_time = seconds(gradient, starts, rpms, repeats=options.repeats)["median"]
    return {
        "worlds": worlds,
        "steps per call": length,
        "forward": steps * length / time["median"],
        "forward best": steps * length / time["best"],
        "with backward": steps * few / worlds * grad_length / gradient_time,
        "time over forward": gradient_time / value_time,
        "forward first call": first_forward,
        "backward first call": first_backward,
    }
