"""Many worlds in one compiled step, with automatic or manual reset."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode

from jaxdrones.adapters.session import begin, flat, rewarding
from jaxdrones.adapters.spaces import Layout
from jaxdrones.envs import AutoReset, Env
from jaxdrones.envs.functions import check_process


class Worlds:
    """Worlds on the device; results are JAX arrays with a leading axis over worlds, in a layout."""

    def __init__(self, env: Env, layout: Layout, mode: AutoresetMode, team_reward: str):
        self.env, self.layout, self.mode, self._rewarding = env, layout, mode, rewarding(team_reward)
        self.started = False
        self._episodes = AutoReset(env)
        self._compiled_reset = jax.jit(self._reset)
        self._compiled_reset_some = jax.jit(self._reset_some, donate_argnums=1)
        self._compiled_step = jax.jit(self._step, donate_argnums=1)
        self._compiled_step_some = jax.jit(self._step_some, donate_argnums=1)

    @property
    def world(self) -> Any:
        """`World` of every environment, with a leading axis."""
        return self._worlds[1].world

    def reset(self, seeds: np.ndarray, mask: np.ndarray | None = None) -> Any:
        """Start episodes where a mask is true; return the observations of all worlds."""
        check_process()
        if mask is None:
            self._keys, self._worlds, self._obs = self._compiled_reset(seeds)
        else:
            self._keys, self._worlds, self._obs = self._compiled_reset_some(
                (self._keys, self._obs), self._worlds, seeds, mask
            )
        self.started = True
        return self._obs

    def step(
        self, actions: jax.Array, mask: np.ndarray | None = None
    ) -> tuple[Any, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        """One control step: observations, rewards of the teams, terminated, truncated and info.

        Where a mask is false, the world is unchanged: it keeps its observation, and its other results are undefined.
        """
        check_process()
        if mask is None:
            self._worlds, outcome = self._compiled_step(self._keys, self._worlds, actions)
        else:
            self._worlds, outcome = self._compiled_step_some((self._keys, self._obs), self._worlds, actions, mask)
        self._obs = outcome[0]
        return outcome

    def _reset(self, seeds: jax.Array):
        keys, episodes, obs = jax.vmap(functools.partial(begin, self._episodes))(seeds)
        return keys, (np.uint32(0), episodes, jnp.zeros(len(seeds), bool)), self.layout.arrange(obs, 1)

    def _reset_some(self, kept: tuple, worlds: tuple, seeds: jax.Array, mask: jax.Array):
        (keys, obs), (count, episodes, ended) = kept, worlds
        new_keys, (_, new_episodes, _), new_obs = self._reset(seeds)
        new, old = (new_keys, new_episodes, new_obs), (keys, episodes, obs)
        keys, episodes, obs = jax.vmap(_choose)(mask, new, old)
        return keys, (count, episodes, ended & ~mask), obs

    def _step(self, keys: jax.Array, worlds: tuple, actions: jax.Array):
        count, episodes, ended = worlds

        def step(key, episode, ended, action):
            return self._of_one(jax.random.fold_in(key, count), episode, ended, action)

        obs, episodes, reward, terminated, truncated, info = jax.vmap(step)(keys, episodes, ended, actions)
        last = flat(info)
        if self.env.drones == 1:
            last = {name: x[:, 0] if x.ndim > 1 else x for name, x in last.items()}
        result = {"last": last, "not_reset": ~ended}
        if self.mode is AutoresetMode.SAME_STEP:
            ended = terminated | truncated
            result["not_reset"] = ~ended
            result["episode"] = {"r": self._rewarding(info["episode"]["return"]), "l": info["episode"]["length"]}
            result["final_obs"] = self.layout.arrange(info["final_obs"], 1)
        elif self.mode is AutoresetMode.NEXT_STEP:
            ended = terminated | truncated
        else:
            ended = ended | terminated | truncated
        outcome = self.layout.arrange(obs, 1), self._rewarding(reward), terminated, truncated, result
        return (count + 1, episodes, ended), outcome

    def _step_some(self, kept: tuple, worlds: tuple, actions: jax.Array, mask: jax.Array):
        (keys, obs), (_, *before) = kept, worlds
        (count, *after), (new_obs, *outcome) = self._step(keys, worlds, actions)
        obs, after = jax.vmap(_choose)(mask, (new_obs, after), (obs, before))
        return (count, *after), (obs, *outcome)

    def _of_one(self, key: jax.Array, episode: Any, ended: jax.Array, action: jax.Array):
        """One control step of one world, with the autoreset mode."""
        if self.mode is AutoresetMode.SAME_STEP:
            return self._episodes.step(key, episode, action)
        obs, episode, reward, terminated, truncated, info = self._episodes.step_without_reset(key, episode, action)
        if self.mode is AutoresetMode.NEXT_STEP:
            obs, episode = self._episodes.renewed(ended, key, obs, episode)
            reward = jnp.where(ended, 0, reward)
            terminated, truncated = terminated & ~ended, truncated & ~ended
        return obs, episode, reward, terminated, truncated, info


def _choose(mask: jax.Array, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(mask, a, b), new, old)
