"""Tianshou vector environment of many worlds in one compiled step, for `Collector`."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from gymnasium.vector import AutoresetMode

from jaxdrones.adapters import pictures
from jaxdrones.adapters.session import SEEDS, TaskOrEnv, as_env
from jaxdrones.adapters.spaces import Layout
from jaxdrones.adapters.worlds import Worlds
from jaxdrones.arguments import Count, checked
from jaxdrones.errors import UserError

try:
    from tianshou.env import BaseVectorEnv
except ImportError as error:
    raise ImportError("tianshou is not installed; pip install tianshou torch") from error


class VectorEnv(BaseVectorEnv):
    """Many worlds; `Collector` selects those to step and to reset.

    Observations and actions have the shapes of `jaxdrones.adapters.gymnasium.VectorEnv`. Infos are empty.
    """

    @checked
    def __init__(
        self,
        task: TaskOrEnv,
        num_envs: Count,
        *,
        seed: int | None = None,
        team_reward: str = "sum",
        **options: Any,
    ):
        """Create the worlds; arguments are those of `GymnasiumEnv`; `seed` is that of the first reset."""
        self.env, self.env_num = as_env(task, options), num_envs
        self.is_async = self.is_closed = False
        self._layout = Layout(self.env, None)
        self._worlds = Worlds(self.env, self._layout, AutoresetMode.DISABLED, team_reward)
        self.seed(seed)

    def get_env_attr(self, key: str, id: Any = None) -> list[Any]:
        """Attribute of the environment, or one of its spaces, for every requested world."""
        spaces = {"observation_space": self._layout.observation, "action_space": self._layout.action}
        value = spaces[key] if key in spaces else getattr(self.env, key)
        return [value] * int(self._mask(id).sum())

    def set_env_attr(self, key: str, value: Any, id: Any = None) -> None:
        """Unsupported: all worlds are one compiled step."""
        raise UserError(f"attribute {key} cannot be set in a compiled environment; give it as an option")

    def seed(self, seed: int | Sequence[int] | None = None) -> list[int]:
        """Seed the worlds: with the seed of the first world, incremented for the others; one seed each; or `None`."""
        if seed is None:
            seed = int(np.random.default_rng().integers(SEEDS))
        seeds = [seed + i for i in range(self.env_num)] if isinstance(seed, int | np.integer) else list(seed)
        if len(seeds) != self.env_num:
            raise UserError(f"seed has {len(seeds)} entries; give one number, or one for each of {self.env_num}")
        self._seeds = [np.random.default_rng(int(x) % SEEDS) for x in seeds]
        return seeds

    def reset(
        self, env_id: int | Sequence[int] | np.ndarray | None = None, *, seed: int | Sequence[int] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Start an episode in worlds `env_id`, or in all; return their observations and infos."""
        if seed is not None:
            self.seed(seed)
        mask = self._mask(env_id)
        if not (mask.all() or self._worlds.started):
            raise UserError("some worlds are reset before the first reset of all worlds; call reset() first")
        seeds = [rng.integers(SEEDS) if chosen else 0 for rng, chosen in zip(self._seeds, mask, strict=True)]
        obs = self._worlds.reset(np.array(seeds, np.uint32), None if mask.all() else mask)
        chosen = self._ids(env_id)
        return self._rows(obs, chosen), _infos(chosen)

    def step(
        self, action: Any, id: int | Sequence[int] | np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """One control step of worlds `id`, or of all; the others are unchanged.

        Actions and results have a row for each of these worlds, in their order.
        """
        if not self._worlds.started:
            raise UserError("step is called before reset; call reset")
        chosen, action = self._ids(id), np.asarray(action, np.float32)
        everyone = np.zeros((self.env_num, *self._layout.action.shape), np.float32)
        if action.shape != (len(chosen), *everyone.shape[1:]):
            raise UserError(f"action has shape {action.shape}; expected {(len(chosen), *everyone.shape[1:])}")
        everyone[chosen] = action
        mask = self._mask(id)
        actions = self._layout.gather(everyone, (self.env_num,))
        obs, *outcome, _ = self._worlds.step(actions, None if mask.all() else mask)
        reward, terminated, truncated = (np.asarray(x)[chosen] for x in outcome)
        return self._rows(obs, chosen), reward, terminated, truncated, _infos(chosen)

    def render(self, **kwargs: Any) -> list[np.ndarray]:
        """Picture (height, width, 3) of every world from the side."""
        if not self._worlds.started:
            raise UserError("render is called before reset; call reset")
        return list(pictures.of_worlds(self.env, self._worlds.world))

    def close(self) -> None:
        """Close the connection to Bullet, if any."""
        self.is_closed = True
        self.env.close()

    def _ids(self, chosen: Any) -> np.ndarray:
        return np.arange(self.env_num) if chosen is None else np.atleast_1d(np.asarray(chosen))

    def _mask(self, chosen: Any) -> np.ndarray:
        mask = np.zeros(self.env_num, bool)
        mask[self._ids(chosen)] = True
        return mask

    def _rows(self, obs: Any, chosen: np.ndarray) -> np.ndarray:
        """Observations of some worlds; with images an array of dictionaries, for tianshou's batches."""
        rows = jax.tree.map(lambda x: np.asarray(x)[chosen], obs)
        if not isinstance(rows, dict):
            return rows
        return np.array([{name: x[i] for name, x in rows.items()} for i in range(len(chosen))])


def _infos(chosen: np.ndarray) -> np.ndarray:
    return np.array([{"env_id": int(i)} for i in chosen])
