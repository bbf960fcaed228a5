"""Does self-play teach drones to race without collisions, and what does it cost in lap time?

Two drones (`--drones`) race on random tracks with downwash and contact; one policy flies all of them. Policies:
`alone`, trained with one drone; `blind`, the same policy, which does not observe opponents in the races either;
`self-play`, with the current policy on all drones in training; `league`, against past policies of the same training.
`completed`: drones that passed all gates; `collided`: races with a contact between two drones, including between
control steps; `lap`: mean lap time of drones that completed; `overtakes` per race. The 95 % intervals are over distinct
races. Every policy also flies alone.
"""

import argparse
import dataclasses
import functools
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from jaxdrones.learning import Policy, bptt, checkpoint, league
from jaxdrones.learning.evaluation import wilson_interval
from jaxdrones.training.presets import preset

POLICIES = {"alone": (bptt, 1), "blind": (bptt, 1), "self-play": (bptt, 0), "league": (league, 0)}
"""Learner, and number of drones in training; 0 for that of the races."""

_OUT_OF_SIGHT = 1e-3  # m, at which rows of opponents have no effect


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--drones", type=int, default=2)
    parser.add_argument("--policies", nargs="+", choices=POLICIES, default=list(POLICIES))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--races", type=int, default=1000)
    parser.add_argument("--level", type=int, default=3, help="of the task, in training and in the races")
    parser.add_argument("--updates", type=int, help="of a training; by default those of the preset")
    parser.add_argument("--save", help="path of the policies to write; name and seed are appended")
    parser.add_argument("--load", help="path of policies to fly in place of training them")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    if options.quick:
        options.seeds, options.races, options.updates = 1, 4, 2
    flown = [jd.make("race", drones=drones, level=options.level) for drones in (options.drones, 1)]
    rows = []
    for name in options.policies:
        train = trainer(name, options)
        for seed in range(options.first_seed, options.first_seed + options.seeds):
            path = f"{options.load or options.save}-{'alone' if name == 'blind' else name}-{seed}"
            start = time.perf_counter()
            policy = checkpoint.load(path) if options.load else train(seed)
            if name == "blind":
                policy = blinded(policy)
            about = {"policy": name, "seed": seed, "seconds": time.perf_counter() - start}
            if options.save and name != "blind":
                checkpoint.save(path, policy)
            for env in flown:
                rows.append(about | {"drones": env.drones} | summary(fly(env, policy, options.races)))
                print(rows[-1], file=sys.stderr)
    lines = [
        "policy    | seed | drones | completed [95 %] | races with a collision [95 %] | lap s | overtakes | train s"
    ]
    for row in rows:
        lines.append(
            f"{row['policy']:9} | {row['seed']:4} | {row['drones']:6} | {percent(row['completed'])} |"
            f" {percent(row['collided'])} | {row['lap'][0]:.3f} +- {row['lap'][1]:.3f} |"
            f" {row['overtakes'][0]:.2f} +- {row['overtakes'][1]:.2f} | {row['seconds']:.0f}"
        )
    about = {name: getattr(options, name) for name in ("drones", "level", "races", "updates")}
    return {"about": about, "rows": rows}, lines


def trainer(name: str, options: argparse.Namespace) -> Callable[[int], Policy]:
    """Function that trains a policy with a seed, compiled once."""
    learner, drones = POLICIES[name]
    algorithm = learner.__name__.rpartition(".")[2]
    env, config = preset("race", algorithm, practice=True, drones=drones or options.drones, level=options.level)
    if options.updates:
        config = dataclasses.replace(config, updates=options.updates)
    return lambda seed: jax.block_until_ready(learner.train(jax.random.key(seed), env, config)).policy


def blinded(policy: Policy) -> Policy:
    """The same policy with opponents out of sight."""
    sets = tuple((*columns, _OUT_OF_SIGHT) for *columns, _ in policy.network.sets)
    return policy.replace(network=policy.network.clone(sets=sets))


def fly(env: jd.envs.Env, policy: Policy, races: int) -> dict[str, np.ndarray]:
    """Metrics (races, n) at the end of each drone's race, and whether it passed all gates."""
    return jax.tree.map(np.asarray, _races(env)(policy, jax.random.split(jax.random.key(1_000_000), races)))


@functools.lru_cache
def _races(env: jd.envs.Env) -> Callable:
    """Compiled races: (policy, keys) -> metrics."""

    def race(policy: Policy, key: jax.Array) -> dict[str, jax.Array]:
        reset_key, step_key = jax.random.split(key)
        obs, world = env.reset(reset_key)
        zero = jnp.zeros(env.drones)
        last = {name: zero for name in env.task.metrics} | {"completed": zero.astype(bool)}

        def control_step(carry, key):
            obs, world, last = carry
            obs, world, *_, info = env.step(key, world, policy(obs))
            now = {name: info["metrics"][name] for name in env.task.metrics}
            now["completed"] = info["terminations"]["finished"]
            last = {name: jnp.where(info["active"], now[name], last[name]) for name in last}
            return (obs, world, last), None

        return jax.lax.scan(control_step, (obs, world, last), jax.random.split(step_key, env.steps))[0][2]

    return jax.jit(jax.vmap(race, (None, 0)))


def summary(outcome: dict[str, np.ndarray]) -> dict:
    """Rates and means with their intervals; a race counts once."""
    races = len(outcome["completed"])
    completed = outcome["completed"].mean(axis=1)
    collided = outcome["touched"].any(axis=1)
    laps = [lap[done].mean() for lap, done in zip(outcome["lap_time"], outcome["completed"], strict=True) if any(done)]
    return {
        "completed": (float(completed.mean()), *wilson_interval(completed.sum(), races)),
        "collided": (float(collided.mean()), *wilson_interval(collided.sum(), races)),
        "lap": _mean(laps),
        "overtakes": _mean(outcome["overtakes"].sum(axis=1)),
    }


def _mean(x) -> tuple[float, float]:
    """Mean and half of its 95 % interval."""
    x = np.asarray(x, float)
    return (float(x.mean()), float(1.96 * x.std(ddof=1) / np.sqrt(len(x)))) if len(x) > 1 else (np.nan, np.nan)


def percent(rate: tuple[float, float, float]) -> str:
    """A rate and its interval, %."""
    return f"{100 * rate[0]:5.1f} [{100 * rate[1]:.1f}, {100 * rate[2]:.1f}]"
