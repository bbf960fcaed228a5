"""PettingZoo `ParallelEnv` of a team, one agent per drone."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from jaxdrones.adapters import pictures
from jaxdrones.adapters.session import TaskOrEnv, TeamEpisodes, flat
from jaxdrones.arguments import checked
from jaxdrones.errors import UserError, needs

with needs("pettingzoo", "pettingzoo"):
    import pettingzoo


def parallel_env(task: TaskOrEnv, **options: Any) -> ParallelEnv:
    """Make a team with agents `drone_0`, `drone_1`, ..., with the options of `jaxdrones.make`."""
    return ParallelEnv(task, **options)


class ParallelEnv(TeamEpisodes, pettingzoo.ParallelEnv):
    """One world; see `TeamEpisodes`."""

    @checked
    def __init__(self, task: TaskOrEnv, *, render_mode: pictures.RenderMode = None, **options: Any):
        """Wrap an environment; arguments are those of `GymnasiumEnv`."""
        self._wrap(task, options)
        self.render_mode = render_mode
        self.metadata = {
            "name": f"jaxdrones/{self.env.task.name}",
            "is_parallelizable": True,
            "render_modes": pictures.MODES,
            "render_fps": round(1 / self.env.dt),
        }
        bound = np.tile(self.env.observation_bound, self.env.drones)
        self.state_space = gymnasium.spaces.Box(-bound, bound, dtype=np.float32)

    def observation_space(self, agent: str) -> gymnasium.Space:
        """Observation space of an agent."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.Space:
        """Action space of an agent."""
        return self.action_spaces[agent]

    def step(self, actions: dict[str, np.ndarray]) -> tuple[Any, Any, Any, Any, Any]:
        """One control step."""
        (obs, reward, terminated, truncated), _, info = self._step(actions)
        drones = {agent: i for i, agent in enumerate(self.possible_agents) if agent in obs}
        infos = {agent: {name: x[i].item() for name, x in flat(info).items()} for agent, i in drones.items()}
        return obs, reward, terminated, truncated, infos

    def state(self) -> np.ndarray:
        """Concatenated observations of all agents without images, for centralized critics."""
        if self._session.world is None:
            raise UserError("state is called before reset; call reset")
        return (self._obs["state"] if isinstance(self._obs, dict) else self._obs).ravel().copy()

    def render(self) -> np.ndarray | None:
        """Picture (height, width, 3) of the team from the side, with `render_mode="rgb_array"`."""
        shown = pictures.wanted(self.render_mode, self._session.world is not None, UserError)
        return self._session.photo() if shown else None
