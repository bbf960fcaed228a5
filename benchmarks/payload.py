"""How accurately, and with how much swing, does a policy fly a load on cables along a curve?

Flights of 10 s from random starts; error and swing count after the first second, as in the task's criterion of success.
`error`: root mean square distance of the load from its target; `swing`: largest angle between the vertical and the line
from the load to its drone, or to the middle of the team.

`--learner geometric` flies the task `sling` with the geometric controller instead of a policy. It knows the mass of the
load, and holds the drone above the target of the load at the length of the cable.
"""

import argparse
import dataclasses
import functools
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from benchmarks.common import success_rate
from jaxdrones.control import geometric
from jaxdrones.envs.actions import Action
from jaxdrones.learning import bptt, evaluate
from jaxdrones.training.presets import preset

EPISODES = 256


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--task", choices=("sling", "transport"), default="sling")
    parser.add_argument("--learner", choices=("bptt", "geometric"), default="bptt")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--drones", type=int, help="by default one of sling and three of transport")
    parser.add_argument("--period", type=float, default=6.0, help="of the figure-eight, s")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    made = {"period": options.period} | ({"drones": options.drones} if options.drones else {})
    seeds = options.seeds[:1] if options.quick or options.learner == "geometric" else options.seeds
    rows = [flown(options, made, seed) for seed in seeds]
    lines = ["seed | success [95 % interval] | error, median and worst, cm | swing, median and worst, degrees | s"]
    lines += [
        f"{row['seed']:4} | {success_rate(row['success'], row['interval'])} | {row['error'][0]:.2f}, "
        f"{row['error'][1]:.2f} | {row['swing'][0]:.1f}, {row['swing'][1]:.1f} | {row['seconds']:.0f}"
        for row in rows
    ]
    about = {name: getattr(options, name) for name in ("task", "learner")} | made
    return {"about": about | {"episodes": 4 if options.quick else EPISODES}, "rows": rows}, lines


def flown(options: argparse.Namespace, made: dict, seed: int) -> dict:
    """Errors and swings of a policy of this seed, and the seconds of its training with compiling."""
    start = time.perf_counter()
    if options.learner == "geometric":
        env, policy = jd.make(options.task, action=_above_target(), **made), lambda obs: jnp.zeros((len(obs), 1))
    else:
        env, config = preset(options.task, "bptt", practice=True, **made)
        if options.quick:
            config = dataclasses.replace(config, updates=2, worlds=4, horizon=4)
        policy = jax.block_until_ready(bptt.train(jax.random.key(seed), env, config)).policy
        env = jd.make(options.task, **made)
    seconds = time.perf_counter() - start
    key, episodes = jax.random.key(1_000_000), 4 if options.quick else EPISODES
    report = evaluate(env, policy, key, episodes)
    error, swing = jax.jit(jax.vmap(functools.partial(_flight, env, policy)))(jax.random.split(key, episodes))
    return {
        "seed": seed,
        "success": report.success,
        "interval": report.success_interval,
        "error": [float(100 * f(error)) for f in (np.median, np.max)],
        "swing": [float(f(swing)) for f in (np.median, np.max)],
        "seconds": seconds,
    }


def _flight(env: jd.envs.Env, policy, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rms error (n,), m, and largest swing (n,), degrees, of a flight after the first second."""

    def step(carry: tuple, key: jax.Array):
        obs, world = carry
        obs, world, _, _, _, info = env.step(key, world, policy(obs))
        return (obs, world), (info["metrics"]["error"], info["metrics"]["swing"])

    _, (error, swing) = jax.lax.scan(step, env.reset(key), jax.random.split(key, env.steps))
    late = round(1 / env.dt)
    return jnp.sqrt(jnp.mean(error[late:] ** 2, axis=0)), jnp.max(swing[late:], axis=0)


def _above_target() -> Action:
    """Action type without a choice: the geometric controller holds the place above the target of the load."""

    def command(params, memory, state, action, setpoint, dt):
        load = params.aux["payload"]
        place = setpoint.replace(pos=setpoint.pos + jd.vector.along_z(load.length))
        loaded = params.replace(mass=params.mass + load.mass)
        return geometric.control(geometric.gains(), loaded, memory, state, place, dt=dt)

    return Action(1, command, geometric.init)
