"""Episodes one after the other, for learners that never stop."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.envs.env import RESET, Env, Obs
from jaxdrones.tasks.task import World


class Episode(flax.struct.PyTreeNode):
    """A world, and what its episode came to so far."""

    world: World
    returned: Array
    """(n,) sum of rewards."""
    length: Array
    """() control steps."""


class AutoReset:
    """The same two functions, of an `Episode` in place of a `World`; an episode that ends is followed by a fresh one.

    `info` gains `final_obs`, what was seen last (of every step, so also before a reset), and `episode`: `return`
    (n,) and `length` () so far, which are those of the whole episode where it ended.
    """

    def __init__(self, env: Env):
        self.env = env

    def reset(self, key: jax.Array) -> tuple[Obs, Episode]:
        """Start the first episode."""
        obs, world = self.env.reset(key)
        return obs, Episode(world, jnp.zeros(self.env.drones, world.drones.pos.dtype), jnp.zeros((), jnp.int32))

    def step(
        self, key: jax.Array, episode: Episode, action: Float[Array, "n a"]
    ) -> tuple[Obs, Episode, Float[Array, " n"], Array, Array, dict[str, Any]]:
        """One control step; where it ends the episode, the observation and the world are those of the next one."""
        obs, world, reward, terminated, truncated, info = self.env.step(key, episode.world, action)
        returned, length = episode.returned + reward, episode.length + 1
        info = info | {"final_obs": obs, "episode": {"return": returned, "length": length}}

        ended = terminated | truncated
        fresh = self.reset(jax.random.fold_in(key, RESET))
        obs, episode = jax.tree.map(
            lambda new, old: jnp.where(ended, new, old), fresh, (obs, Episode(world, returned, length))
        )
        return obs, episode, reward, terminated, truncated, info


def autoreset(env: Env) -> AutoReset:
    """An environment whose episodes follow one another, each with a fresh key."""
    return AutoReset(env)
