"""Automatic reset in the step that ends an episode."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.accelerate.where_needed import where_needed
from jaxdrones.envs.env import Env, Obs
from jaxdrones.envs.episode import RESET
from jaxdrones.envs.vision import observation
from jaxdrones.pytree import PyTreeNode
from jaxdrones.tasks.task import World


class Episode(PyTreeNode):
    """World with the statistics of its episode so far."""

    world: World
    episode_return: Array
    """(n,) sum of rewards."""
    length: Array
    """() control steps."""


class AutoReset:
    """Environment with automatic resets: `reset` and `step` on an `Episode` in place of a `World`.

    `info` gains `final_obs` and `final_world`, the last observation and world before a possible reset (of every step),
    and `episode`: `return` (n,) and `length` () so far, those of the whole episode at its end.
    """

    def __init__(self, env: Env, progress: Array | None = None):
        """Add automatic resets; `progress` is that of training in [0, 1], for a task with a curriculum."""
        self.env, self._progress = env, () if progress is None else (progress,)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self.env!r}>"

    def reset(self, key: jax.Array) -> tuple[Obs, Episode]:
        """Start the first episode."""
        obs, world = self.env.reset(key, *self._progress)
        return obs, self._first(world)

    def _first(self, world: World) -> Episode:
        return Episode(world, jnp.zeros(self.env.drones, world.drones.pos.dtype), jnp.zeros((), jnp.int32))

    def step(
        self, key: jax.Array, episode: Episode, action: Float[Array, "n a"]
    ) -> tuple[Obs, Episode, Float[Array, " n"], Array, Array, dict[str, Any]]:
        """One control step; at the end of an episode, observation and world are those of the next one."""
        obs, episode, reward, terminated, truncated, info = self.step_without_reset(key, episode, action)
        info = info | {"final_obs": obs, "final_world": episode.world}
        obs, episode = self.renewed(terminated | truncated, key, obs, episode)
        return obs, episode, reward, terminated, truncated, info

    def step_without_reset(
        self, key: jax.Array, episode: Episode, action: Float[Array, "n a"]
    ) -> tuple[Obs, Episode, Float[Array, " n"], Array, Array, dict[str, Any]]:
        """One control step with the statistics of the episode in `info`, without a reset."""
        obs, world, reward, terminated, truncated, info = self.env.step(key, episode.world, action)
        episode = Episode(world, episode.episode_return + reward, episode.length + 1)
        info = info | {"episode": {"return": episode.episode_return, "length": episode.length}}
        return obs, episode, reward, terminated, truncated, info

    def renewed(self, ended: Array, key: jax.Array, obs: Obs, episode: Episode) -> tuple[Obs, Episode]:
        """Replace worlds and observations by a new start where `ended`; `key` is that of the step."""
        world = episode.world
        vector = obs["state"] if isinstance(obs, dict) else obs
        renewed = where_needed(self._fresh, one_in=256)
        vector, episode = renewed(ended, key, otherwise=(vector, self._without_kept(episode)))
        kept = {name: getattr(world, name) for name in self._kept}
        episode = episode.replace(world=episode.world.replace(**kept))
        if self.env.vision:
            episode = episode.replace(world=self.env.with_images("renewed", _of_reset(key), episode.world, ended))
        return observation(vector, episode.world), episode

    @property
    def _kept(self) -> tuple[str, ...]:
        """Fields of a world that survive a reset: constant fields and images."""
        return (*self.env.constant_fields, "images", "poses")

    def _fresh(self, key: jax.Array) -> tuple[Array, Episode]:
        """First episode, given the key of the step and without what survives a reset."""
        obs, world = self.env.begin(_of_reset(key), *self._progress)
        return obs, self._without_kept(self._first(world))

    def _without_kept(self, episode: Episode) -> Episode:
        return episode.replace(world=episode.world.replace(**dict.fromkeys(self._kept)))


def _of_reset(key: jax.Array) -> jax.Array:
    """Random key of a reset, from that of the step."""
    return jax.random.fold_in(key, RESET)
