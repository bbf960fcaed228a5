"""How well does a trained policy fly, and how long does training take, seed by seed?

Compilation is timed with an empty compilation cache unless --cache is given, and includes tracing; all seeds share one
program. The time of evaluations is not included.
"""

import argparse
import time

import jax

from benchmarks.common import outcome, success_rate
from jaxdrones.cli.settings import parse_settings
from jaxdrones.learning import compilation, evaluate
from jaxdrones.training.algorithms import ALGORITHMS, learner
from jaxdrones.training.recipe import Recipe


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--task", default="hover")
    parser.add_argument("--realistic", action="store_true", help="lag, drag, delay, noise, parameter ranges")
    parser.add_argument("--algo", default="bptt", help=", ".join(ALGORITHMS))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="as of `jaxdrones train`")
    parser.add_argument("--episodes", type=int, default=10_000, help="of the evaluation of a seed")
    parser.add_argument("--cache", help="folder of compiled programs, filled by a first run, for a warm start")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    changes = parse_settings(options.set)
    if options.quick:
        changes |= dict(updates=2, worlds=8, horizon=4)
        options.seeds, options.episodes = 1, 10
    recipe = Recipe.of(options.task, options.algo, options.realistic, **changes)

    rows, spent = measure(recipe, options)
    lines = ["seed |     steps | run s (CPU s) | success [95 % interval] |  error cm p50   p99 | rms cm | others"]
    lines += [
        f"{row['seed']:4} | {row['steps']:9} | {row['run']:5.1f} ({row['run CPU']:5.1f}) |"
        f" {success_rate(row['success'], row['interval'])} |"
        f"  {100 * row['error p50']:8.2f} {100 * row['error p99']:8.2f} | {100 * row['rms']:6.2f} | {row['metrics']}"
        for row in rows
    ]
    return {"about": recipe.as_dict() | spent, "rows": rows}, lines


def measure(recipe: Recipe, options) -> tuple[list[dict], dict]:
    """A row per seed, and the seconds spent on compiling."""
    if options.cache is None:
        jax.config.update("jax_enable_compilation_cache", False)
    else:
        jax.config.update("jax_compilation_cache_dir", options.cache)
    algorithm, config = learner(recipe.algorithm), recipe.config
    env, practice = recipe.env(), recipe.env(practice=True)
    start, start_cpu = time.perf_counter(), time.process_time()
    program = compilation.jit(lambda key: algorithm.train(key, practice, config), practice, config)
    train = program.lower(jax.random.key(0)).compile()
    spent = {"compile s": time.perf_counter() - start, "compile CPU s": time.process_time() - start_cpu}

    rows = []
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        start, start_cpu = time.perf_counter(), time.process_time()
        result = jax.block_until_ready(train(jax.random.key(seed)))
        run, run_cpu = time.perf_counter() - start, time.process_time() - start_cpu
        came = evaluate(env, result.policy, jax.random.key(1_000_000 + seed), options.episodes)
        rows.append(
            {
                "seed": seed,
                "steps": config.updates * config.worlds * config.horizon * env.drones,
                "run": run,
                "run CPU": run_cpu,
                **outcome(came),
                "rms": came.rms_error,
                "metrics": {name: round(x, 4) for name, x in came.final_metrics.items()} | came.end_rates,
            }
        )
    return rows, spent
