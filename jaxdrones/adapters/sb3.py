"""Stable-Baselines3 `VecEnv` of many worlds in one compiled step."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxdrones.adapters import gymnasium
from jaxdrones.adapters.session import TaskOrEnv
from jaxdrones.errors import UserError, needs

with needs("stable-baselines3", "sb3"):
    from stable_baselines3.common import vec_env


class VecEnv(vec_env.VecEnv):
    """Many worlds with automatic reset.

    `infos[i]` is empty except for the last step of an episode, with `terminal_observation`, `TimeLimit.truncated`, and
    `episode` (return `r`, length `l`) for SB3's log.
    """

    def __init__(
        self,
        task: TaskOrEnv,
        num_envs: int,
        *,
        seed: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ):
        """Create the worlds.

        Args:
            task: as for `jaxdrones.make`, or an environment.
            num_envs: number of worlds.
            seed: seed of the first reset; SB3's algorithms set it too.
            render_mode: `rgb_array` or `None`.
            **options: options of `jaxdrones.make`, and `team_reward`, `sum` or `mean` of the rewards of the drones.
        """
        self.envs = gymnasium.VectorEnv(task, num_envs, render_mode=render_mode, **options)
        self.render_mode = render_mode
        self.metadata = self.envs.metadata
        super().__init__(num_envs, self.envs.single_observation_space, self.envs.single_action_space)
        self._seed = seed
        self._actions: np.ndarray

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the next reset."""
        self._seed = seed
        return [None if seed is None else seed + i for i in range(self.num_envs)]

    def reset(self) -> Any:
        """Start an episode in every world."""
        obs, _ = self.envs.reset(seed=self._seed)
        self._seed = None
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        """Set the actions of `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """One control step in every world."""
        obs, reward, terminated, truncated, info = self.envs.step(self._actions)
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done):
            final, episode = info["final_obs"], info["final_info"]["episode"]
            infos[i] = {
                "terminal_observation": {k: x[i] for k, x in final.items()} if isinstance(final, dict) else final[i],
                "TimeLimit.truncated": bool(truncated[i] & ~terminated[i]),
                "episode": {"r": float(episode["r"][i]), "l": int(episode["l"][i])},
            }
        return obs, reward, done, infos

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Picture (height, width, 3) of every world from the side."""
        return self.envs.render() or [None] * self.num_envs

    def close(self) -> None:
        """Close the connection to Bullet, if any."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Common attribute for every requested world."""
        return [getattr(self.envs, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Unsupported: all worlds are one compiled step."""
        raise UserError(f"attribute {attr_name} cannot be set in a compiled environment; give it as an option")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Unsupported: all worlds are one compiled step."""
        raise UserError(f"method {method_name} cannot be called: the environments are one compiled step")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """False for every world."""
        return [False for _ in self._get_indices(indices)]
