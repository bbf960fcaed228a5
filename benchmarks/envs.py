"""How many environment steps per second, with observation, reward and autoreset?

In one compiled program, on one or more devices; through gymnasium's `make_vec` with NumPy inputs and outputs; and in
one gymnasium environment.
"""

import argparse
import dataclasses

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones.adapters.gymnasium  # noqa: F401 (registers the environments)
from benchmarks.cameras_scenes import objects20
from benchmarks.common import compiled, seconds
from jaxdrones.cli import throughput as programs
from jaxdrones.envs import make
from jaxdrones.learning import sharding
from jaxdrones.tasks import forest

STEPS = 50  # of a compiled call
SLOW_CAMERA = dataclasses.replace(forest.camera, rate=15.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--devices", type=int, default=1, help="of the compiled programs, each with a core of its own")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    jax.config.update("jax_num_cpu_devices", options.devices)
    if options.quick:
        options.worlds, options.repeats = 16, 1

    swarm = dict(drones=8, pairs=("downwash",), control_hz=100, action="rpm")
    swarm |= dict(observation=("position_error", "rotation_matrix", "velocity_error", "omega", "neighbors"))
    rows = {
        "hover, in jit: env-steps/s": in_jit(make("hover"), options),
        "hover, realistic, in jit: env-steps/s": in_jit(make("hover", realistic=True), options),
        "8 drones, downwash, in jit: drone-steps/s": 8 * in_jit(make("swap-goals", **swarm), options),
        "forest, 16 x 12 depth at 15 Hz, in jit: env-steps/s": in_jit(
            make("forest", control_hz=100, camera=SLOW_CAMERA), options
        ),
        "hover, 20 solids to touch and the same camera, in jit: env-steps/s": in_jit(
            make("hover", scene=objects20(), effects=("obstacle_contact",), vision=("depth",), camera=SLOW_CAMERA),
            options,
        ),
        "forest, no camera, in jit: env-steps/s": in_jit(make("forest", control_hz=100, vision=()), options),
        "hover, make_vec, NumPy in and out: env-steps/s": vector(options),
        "hover, one gymnasium environment: steps/s": single(options),
    }
    a_step = {
        "worlds": options.worlds,
        "devices": options.devices,
        "control": "100 Hz",
        "substeps": 5,
        "integrator": "semi_implicit_euler",
    }
    lines = [f"{rate:14,.0f}  {name}" for name, rate in rows.items()]
    return {"about": a_step, "rates": rows}, lines


def in_jit(env, options) -> float:
    """Environment steps per second with random actions and autoreset; episodes start out of step."""
    fly, episodes = programs.episodes(env, options.worlds // options.devices, STEPS)
    episodes = jax.tree.map(lambda x: jnp.concatenate([x] * options.devices), episodes)
    keys = jax.random.split(jax.random.key(3), options.devices)
    with jax.set_mesh(sharding.make_mesh(options.worlds)):
        of_all = sharding.map_worlds(lambda episodes, keys: fly(episodes, keys[0]), sharding.WORLDS, sharding.WORLDS)
        program, _ = compiled(of_all, episodes, keys)
        taken = seconds(program, episodes, keys, repeats=options.repeats)
    return options.worlds * STEPS / taken["median"]


def vector(options) -> float:
    """Steps per second of all environments of a gymnasium VectorEnv."""
    envs = gymnasium.make_vec("jaxdrones/Hover-v0", num_envs=options.worlds)
    envs.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-0.1, 0.1, envs.action_space.shape).astype(np.float32)
    return options.worlds * _rate(lambda: envs.step(actions)[0], options)


def single(options) -> float:
    """Steps per second of one gymnasium environment, resets included."""
    env = gymnasium.make("jaxdrones/Hover-v0")
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, np.float32)

    def step():
        if any(env.step(action)[2:4]):
            env.reset()

    return _rate(step, options)


def _rate(step, options) -> float:
    """Calls per second: the median of repeats of 100 calls."""
    return 100 / seconds(lambda: [step() for _ in range(100)], repeats=options.repeats)["median"]
