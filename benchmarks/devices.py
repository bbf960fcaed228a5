"""How much faster is training with a second device?

Both programs run alternately in one process; the times are medians. A CPU is divided into devices (`--cpu-devices`);
since XLA uses all cores for one device too, the result on a CPU shows the cost of sharding.
"""

import argparse
import dataclasses
import os
import statistics
import time

import jax

from jaxdrones.learning import sharding
from jaxdrones.training import presets
from jaxdrones.training.algorithms import ALGORITHMS, learner


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--algo", nargs="+", default=["bptt", "ppo"], choices=ALGORITHMS)
    parser.add_argument("--worlds", type=int, help="instead of the preset's")
    parser.add_argument("--cpu-devices", type=int, default=2, metavar="N")
    parser.add_argument("--repeats", type=int, default=15, help="updates on one device and on all, in turn")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    jax.config.update("jax_num_cpu_devices", options.cpu_devices)
    changes = {} if options.worlds is None else {"worlds": options.worlds}
    if options.quick:
        changes, options.algo, options.repeats = {"worlds": 8, "horizon": 4}, options.algo[:1], 2

    rows = [measure(algorithm, changes, options.repeats) for algorithm in options.algo]
    facts = {"devices": jax.device_count(), "load": os.getloadavg()[0]}
    lines = [
        f"{row['algorithm']}, hover, {row['worlds']} worlds x {row['horizon']}: {1e3 * row['one']:.1f} ms on one, "
        f"{1e3 * row['all']:.1f} ms on all ({row['one'] / row['all']:.2f} times as fast)"
        for row in rows
    ]
    return {"about": facts, "rows": rows}, lines


def measure(algorithm: str, changes: dict, repeats: int) -> dict[str, object]:
    """Seconds of an update of hover, on one device and on all."""
    trained_by = learner(algorithm)
    env, config = presets.preset("hover", algorithm)
    config = dataclasses.replace(config, **changes)

    def flying(mesh):
        def start(key):
            return trained_by.init(key, env, config)

        placed = sharding.state_sharding(mesh, jax.eval_shape(start, jax.random.key(0)))
        with jax.set_mesh(mesh):
            init = jax.jit(start, out_shardings=placed)
            update = jax.jit(lambda state: trained_by.update(env, config, state)[0], out_shardings=placed)
            state = init(jax.random.key(0))
            return update.lower(state).compile(), state

    programs = {
        "one": flying(sharding.make_mesh(config.worlds, jax.devices()[:1])),
        "all": flying(sharding.make_mesh(config.worlds)),
    }
    times = {name: [] for name in programs}
    for _ in range(1 + repeats):
        for name, (update, state) in programs.items():
            start = time.perf_counter()
            programs[name] = update, jax.block_until_ready(update(state))
            times[name].append(time.perf_counter() - start)
    medians = {name: statistics.median(seconds[1:]) for name, seconds in times.items()}
    return {"algorithm": algorithm, "worlds": config.worlds, "horizon": config.horizon} | medians
