"""Contract test for environments."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.engine.step import HostStep
from jaxdrones.envs.env import Env

_IMAGE_AXES = 4  # of images of an episode: time, drones, rows, columns


class ContractError(AssertionError):
    """Violation of the contract of environments."""


def check_env(env: Env, steps: int = 5) -> None:
    """Test an environment with a few control steps of random actions.

    It checks shapes, types and bounds; that the same key gives the same episode; that arguments are not mutated; that
    the reward is the sum of its named terms; that invalid actions are rejected; and on the explicit backend also that
    `jax.jit` and `jax.vmap` give the same results as plain calls.

    Raises:
        ContractError: the contract is violated.
    """
    key = jax.random.key(0)
    obs, world = env.reset(key)
    _check_obs(env, obs, "after reset")
    _check_equal(env.reset(key), (obs, world), "two resets with the same key")
    keys = jax.random.split(jax.random.key(1), steps)
    actions = jax.random.uniform(jax.random.key(2), (steps, env.drones, env.action_size), float, -0.3, 0.3)
    flown = []
    for k in range(steps):
        before = jax.tree.map(lambda x: np.array(_plain(x)), world)
        answer = env.step(keys[k], world, actions[k])
        _check_equal(world, before, f"the world given to step {k}, before and after")
        _check_answer(env, answer, f"at step {k}")
        flown.append(answer)
        world = answer[1]
    _check_refusals(env, key, world)
    if not isinstance(env.physics, HostStep):
        _check_transformations(env, keys, actions, flown)


def _check_obs(env: Env, obs: Any, where: str) -> None:
    state = obs["state"] if isinstance(obs, dict) else obs
    for name, space in env.image_spaces.items():
        image = np.asarray(obs[name])
        shape = (env.drones, *space.shape)
        _require(image.shape == shape, f"{name} has shape {image.shape} {where}; expected {shape}")
        _require(np.all((image >= space.low) & (image <= space.high)), f"{name} is beyond its bounds {where}")
    _require(state.shape == (env.drones, env.observation_size), f"obs has shape {state.shape} {where}")
    _require(np.all(np.isfinite(state)), f"obs is not finite {where}: {state}")
    _require(np.all(np.abs(state) <= env.observation_bound), f"obs is beyond observation_bound {where}: {state}")


def _check_answer(env: Env, answer: tuple, where: str) -> None:
    obs, world, reward, terminated, truncated, info = answer
    _check_obs(env, obs, where)
    _require(reward.shape == (env.drones,), f"reward has shape {reward.shape} {where}; expected ({env.drones},)")
    _require(np.all(np.isfinite(reward)), f"reward is not finite {where}: {reward}")
    for name, flag in ("terminated", terminated), ("truncated", truncated):
        _require(flag.shape == () and flag.dtype == bool, f"{name} is not one boolean {where}: {flag}")
    terms = sum(info["rewards"].values())
    _require(np.allclose(terms, reward, rtol=1e-5, atol=1e-6), f"the terms sum up to {terms}, not to {reward} {where}")
    for name, metric in info["metrics"].items():
        _require(metric.shape == (env.drones,), f"metric {name!r} has shape {metric.shape} {where}")
    for leaf in jax.tree.leaves(world.drones):
        _require(np.all(np.isfinite(leaf)), f"the state of the drones is not finite {where}")


def _check_refusals(env: Env, key: jax.Array, world: Any) -> None:
    shape = (env.drones, env.action_size)
    for bad, why in (jnp.zeros((shape[0] + 1, shape[1])), "one row too many"), (jnp.full(shape, jnp.nan), "NaN"):
        try:
            env.step(key, world, bad)
        except ValueError:
            continue
        raise ContractError(f"an action with {why} is not rejected")


def _check_transformations(env: Env, keys: jax.Array, actions: jax.Array, flown: list) -> None:
    def episode(key):
        def advance(world, tape):
            obs, world, reward, *_ = env.step(tape[0], world, tape[1])
            return world, (obs, reward)

        return jax.lax.scan(advance, env.reset(key)[1], (keys, actions))[1]

    key = jax.random.key(0)
    expected = jax.tree.map(lambda *x: jnp.stack(x), *[(answer[0], answer[2]) for answer in flown])
    _check_close(jax.jit(episode)(key), expected, "an episode in jit and out")
    pair = jax.jit(jax.vmap(episode))(jnp.stack([jax.random.key(7), key]))
    _check_close(jax.tree.map(lambda x: x[1], pair), expected, "an episode in vmap and alone")


def _check_equal(actual, expected, what: str) -> None:
    same = jax.tree.map(np.array_equal, jax.tree.map(_plain, actual), jax.tree.map(_plain, expected))
    _require(all(jax.tree.leaves(same)), f"{what} differ")


def _check_close(actual, expected, what: str) -> None:
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        tolerance = 1e-3 if a.dtype == np.float32 else 1e-9
        close = np.isclose(a, b, rtol=tolerance, atol=tolerance)
        needed = 1 if a.ndim < _IMAGE_AXES else 0.98  # rounding may move an edge in an image by a pixel
        _require(np.mean(close) >= needed, f"{what} differ by {np.max(np.abs(a - b))}")


def _plain(x):
    return jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x


def _require(condition, message: str) -> None:
    if not condition:
        raise ContractError(message)
