"""What fraction of a crowd of drones reach their goals without contact, by learned policies and by baselines?

One drone per cubic meter, random starts and goals. `safe`: the drone never came closer to another one than two
collision radii, including between control steps; `reached`: it is within 10 cm of its goal at the end; `success`: both,
with a 95 % interval that accounts for the correlation between drones of a world.

Policies, trained with eight drones: `bptt`, the preset; `stopped`, the same with the other drones constant in the
derivatives of observation and reward; `blind`, the same without observing the others; `ppo`, the same network by PPO in
`--seconds`; and, without learning, `cbf` and `velocity-obstacles` (crowd_baselines.py).
"""

import argparse
import dataclasses
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp

import jaxdrones as jd
from benchmarks import crowd_baselines
from benchmarks.common import success_rate
from jaxdrones.envs.observations import encounters
from jaxdrones.learning import bptt, checkpoint, evaluate, ppo
from jaxdrones.tasks.crossing import OBSERVATION, OBSERVATION_AMONG_OBSTACLES
from jaxdrones.tasks.task import Task, World
from jaxdrones.training.presets import preset

WORLDS = {8: 256, 16: 128, 32: 64, 64: 32, 128: 20, 256: 20, 512: 20}
LEARNERS = {"bptt": bptt, "stopped": bptt, "blind": bptt, "ppo": ppo}
BASELINES = {"cbf": crowd_baselines.cbf, "velocity-obstacles": crowd_baselines.velocity_obstacles}
TIMED = 3  # updates that tell how many PPO makes in a given time


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--learner", choices=[*LEARNERS, *BASELINES], default="bptt")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=250.0, help="of the training by ppo, without compiling")
    parser.add_argument("--drones", type=int, nargs="+", default=list(WORLDS))
    parser.add_argument("--density", type=float, default=1.0, help="drones per cubic meter in flight")
    parser.add_argument("--obstacles", type=float, default=0.0, help="balls per cubic meter, in training and flight")
    parser.add_argument("--patience", type=float, default=1.0, help="of the task")
    parser.add_argument("--downwash", action="store_true", help="each flies in the wakes of the others; not trained")
    parser.add_argument("--save", help="path of the policy to write, without a suffix")
    parser.add_argument("--policy", help="path of a policy to fly in place of training one")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    if options.quick:
        options.drones, options.seconds = [2, 4], 0.0
    if options.policy:
        policy, spent = checkpoint.load(options.policy), {}
    elif options.learner in BASELINES:
        if options.obstacles:
            raise SystemExit(f"{options.learner} does not avoid obstacles; leave out --obstacles")
        policy, spent = None, {}
    else:
        policy, spent = train(options)
    if options.save:
        checkpoint.save(options.save, policy)
    rows = [fly(policy, n, options) for n in options.drones]
    lines = ["drones | worlds | safe % | reached % | success [95 % interval] | s"]
    lines += [
        f"{row['drones']:6} | {row['worlds']:6} | {100 * row['safe']:6.2f} | {100 * row['reached']:9.2f} |"
        f" {success_rate(row['success'], row['interval'])} | {row['seconds']:.0f}"
        for row in rows
    ]
    about = {
        name: getattr(options, name) for name in ("learner", "seed", "density", "obstacles", "patience", "downwash")
    }
    return {"about": about | spent, "rows": rows}, lines


def train(options: argparse.Namespace) -> tuple[jd.learning.networks.Policy, dict]:
    """Policy of a learner, and the seconds that it took, compiling included."""
    learner = LEARNERS[options.learner]
    env, config = preset("crowd", learner.__name__.rpartition(".")[2], practice=True, **_task(options))
    if options.learner == "stopped":
        env = _others_constant(env)
    if options.quick:
        config = dataclasses.replace(config, updates=2, worlds=8, horizon=4)
    key = jax.random.key(options.seed)
    if learner is ppo and not options.quick:
        config = dataclasses.replace(config, updates=_updates_in(options.seconds, env, config))
    start, start_cpu = time.perf_counter(), time.process_time()
    result = jax.block_until_ready(learner.train(key, env, config))
    spent = {"train s": time.perf_counter() - start, "train CPU s": time.process_time() - start_cpu}
    return result.policy, {"updates": config.updates} | {name: round(x, 1) for name, x in spent.items()}


def _updates_in(seconds: float, env: jd.envs.Env, config: ppo.Config) -> int:
    """Number of updates of PPO in a given time."""
    few = dataclasses.replace(config, updates=TIMED)
    jax.block_until_ready(ppo.train(jax.random.key(0), env, few))
    start = time.perf_counter()
    jax.block_until_ready(ppo.train(jax.random.key(1), env, few))
    return max(1, round(seconds * TIMED / (time.perf_counter() - start)))


def _others_constant(env: jd.envs.Env) -> jd.envs.Env:
    """Environment with the other drones constant in the derivatives of a drone's observation and reward."""

    def constant(term: Callable) -> Callable:
        def of_team(task: Task, world: World) -> jax.Array:
            def of_drone(i: jax.Array) -> jax.Array:
                drones = jax.tree.map(lambda x: jax.lax.stop_gradient(x).at[i].set(x[i]), world.drones)
                return term(task, world.replace(drones=drones))[i]

            return jax.vmap(of_drone)(jnp.arange(env.drones))

        return of_team

    task, seen = env.task, env.terms[-1]
    approach = task.rewards["approach"]
    rewards = task.rewards | {"approach": (approach[0], constant(approach[1]))}
    terms = (*env.terms[:-1], dataclasses.replace(seen, observe=constant(seen.observe)))
    return dataclasses.replace(env, task=dataclasses.replace(task, rewards=rewards), terms=terms)


def fly(policy: jd.learning.networks.Policy | None, drones: int, options: argparse.Namespace) -> dict:
    """Rates of success of a team of this size."""
    made = _task(options) | dict(density=options.density, patience=options.patience)
    env = jd.make("crowd", drones=drones, pairs=("downwash",) if options.downwash else (), **made)
    worlds = 2 if options.quick else WORLDS.get(drones, 20)
    start = time.perf_counter()
    policy = policy or crowd_baselines.policy(BASELINES[options.learner], env)
    report = evaluate(env, policy, jax.random.key(1_000_000), worlds)
    return {
        "drones": drones,
        "worlds": worlds,
        "safe": report.final_metrics["safe"],
        "reached": report.final_metrics["reached"],
        "success": report.success,
        "interval": report.success_interval,
        "seconds": time.perf_counter() - start,
    }


def _task(options: argparse.Namespace) -> dict:
    """Options of the task in training and flight; `blind` has no view of the others."""
    observation = OBSERVATION_AMONG_OBSTACLES if options.obstacles else OBSERVATION
    if options.learner == "blind":
        observation = (*observation[:-1], encounters(8, reach=1e-3))
    return {"observation": observation, "obstacles": options.obstacles}
