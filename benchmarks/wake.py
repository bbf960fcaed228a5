"""Does the gradient through the downwash of other drones help a team to keep its altitude?

In the task `wake` drones cross below each other. Policies: `full`, by BPTT with the gradient of the downwash;
`stopped`, the same with neighbors constant in the gradient of the downwash; `blind to physics`, trained without
downwash; `ppo`, by PPO with `--ppo-updates`. All are flown with downwash from the same starts. `altitude` is the root
mean square altitude error after the first second, averaged over drones and episodes.
"""

import argparse
import dataclasses
import time

import jax
import numpy as np

import jaxdrones as jd
from jaxdrones.learning import bptt, evaluate, ppo
from jaxdrones.training.presets import preset


def _stopped(params, state, other, other_state):
    """Downwash of a neighbor whose state is a constant."""
    return jd.downwash(params, state, *jax.lax.stop_gradient((other, other_state)))


POLICIES = {
    "full": (bptt, {}),
    "stopped": (bptt, {"pairs": (_stopped,)}),
    "blind to physics": (bptt, {"pairs": ()}),
    "ppo": (ppo, {}),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--drones", type=int, default=2)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--policies", nargs="+", choices=POLICIES, default=list(POLICIES))
    parser.add_argument("--updates", type=int, help="of bptt; by default those of the preset")
    parser.add_argument("--ppo-updates", type=int, default=300)
    parser.add_argument("--episodes", type=int, default=500)


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    if options.quick:
        options.seeds, options.episodes, options.updates, options.ppo_updates = 1, 4, 2, 2
    flown = jd.make("wake", drones=options.drones)
    rows = []
    for name in options.policies:
        learner, changes = POLICIES[name]
        env, config = preset(
            "wake", learner.__name__.rpartition(".")[2], practice=True, drones=options.drones, **changes
        )
        updates = options.ppo_updates if learner is ppo else options.updates or config.updates
        config = dataclasses.replace(config, updates=updates)
        for seed in range(options.first_seed, options.first_seed + options.seeds):
            start = time.perf_counter()
            policy = jax.block_until_ready(learner.train(jax.random.key(seed), env, config)).policy
            spent = time.perf_counter() - start
            report = evaluate(flown, policy, jax.random.key(1_000_000), options.episodes)
            altitude = 100 * report.final_metrics["altitude_deviation"]
            row = {
                "policy": name,
                "seed": seed,
                "seconds": spent,
                "altitude cm": altitude,
                "rms cm": 100 * report.rms_error,
            }
            rows.append(row | {"success": report.success})
    lines = ["policy           | seed | train s | altitude cm | rms cm | success"]
    for name in options.policies:
        own = [row for row in rows if row["policy"] == name]
        lines += [
            f"{name:16} | {row['seed']:4} | {row['seconds']:7.1f} | {row['altitude cm']:11.3f} | {row['rms cm']:6.2f} |"
            f" {row['success']:.4f}"
            for row in own
        ]
        altitude = [row["altitude cm"] for row in own]
        half = 2.776 * np.std(altitude, ddof=1) / np.sqrt(len(own)) if len(own) == 5 else np.nan
        lines.append(f"{name:16} | mean |         | {np.mean(altitude):11.3f} +- {half:.3f} (95 %, five seeds)")
    return {"about": {"drones": options.drones, "episodes": options.episodes}, "rows": rows}, lines
