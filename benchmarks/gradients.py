"""How do norm and noise of the policy's gradient grow with the horizon?

The gradient is that of the mean reward of the first h control steps with respect to the policy's parameters, in each
world. The results are the norm of its mean over the worlds and the root mean square distance from this mean (the noise
of a single world), for an untrained policy and for one trained by BPTT.
"""

import argparse
import dataclasses

import jax
import jax.flatten_util
import jax.numpy as jnp

from jaxdrones.learning import bptt, collect
from jaxdrones.learning.gradients import gradient_between_steps, with_gradient
from jaxdrones.learning.returns import discounted_rewards
from jaxdrones.training import presets

HORIZONS = (8, 16, 32, 64, 128, 256)
OPTIONS = ("exact", "decay", "surrogate")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--task", default="hover")
    parser.add_argument("--realistic", action="store_true")
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--decay", type=float, default=0.98)


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    env, config = presets.preset(options.task, "bptt", realistic=options.realistic)
    horizons = HORIZONS
    if options.quick:
        horizons, options.worlds = (2, 4), 4
        config = dataclasses.replace(config, updates=2, worlds=4, horizon=4)

    result = bptt.train(jax.random.key(0), env, config)
    start = bptt.init(jax.random.key(0), env, config).policy
    policies = {"at the start": start.replace(obs_stats=result.policy.obs_stats), "trained": result.policy}
    rows = []
    for option in OPTIONS:
        chosen = dataclasses.replace(config, gradient=option, gradient_decay=options.decay)
        measure = jax.jit(lambda policy, chosen=chosen: norms(env, chosen, policy, options.worlds, horizons))
        for name, policy in policies.items():
            mean, noise = (x.tolist() for x in measure(policy))
            rows.append({"gradient": option, "policy": name, "norm": mean, "noise": noise})
    lines = []
    lines.append("gradient  | policy       | " + " | ".join(f"{h:>9} steps" for h in horizons) + "  (norm, noise)")
    lines += [
        f"{row['gradient']:9} | {row['policy']:12} | "
        + " | ".join(f"{a:7.3g} {b:7.3g}" for a, b in zip(row["norm"], row["noise"], strict=True))
        for row in rows
    ]
    return {"horizons": horizons, "rows": rows}, lines


def norms(env, config, policy, worlds: int, horizons) -> tuple[jax.Array, jax.Array]:
    """(horizons,) norm of the mean gradient, and noise."""

    def rewards(params, key):
        """Mean rewards of one world, up to each horizon."""
        flown = policy.replace(params=params)
        start_key, fly_key = jax.random.split(key)
        world = collect.restart(start_key, collect.empty_worlds(env, 1), collect.draw_starts(start_key, env, 1))
        _, trajectory = collect.collect(
            fly_key,
            with_gradient(env, config),
            collect.deterministic(flown),
            world,
            max(horizons),
            between_steps=gradient_between_steps(config),
        )
        sums = jnp.cumsum(jnp.mean(discounted_rewards(trajectory, 1.0), axis=(1, 2)))
        return jnp.stack([sums[h - 1] / h for h in horizons])

    def gradients(key):
        flat, unflatten = jax.flatten_util.ravel_pytree(policy.params)
        return jax.jacrev(lambda x: rewards(unflatten(x), key))(flat)

    each = jax.vmap(gradients)(jax.random.split(jax.random.key(1), worlds))  # (worlds, horizons, parameters)
    mean = jnp.mean(each, axis=0)
    noise = jnp.sqrt(jnp.mean(jnp.sum((each - mean[None]) ** 2, axis=-1), axis=0))
    return jnp.linalg.norm(mean, axis=-1), noise
