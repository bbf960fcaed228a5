"""PettingZoo `ParallelEnv` of a team, one agent per drone."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from jaxdrones.adapters import pictures
from jaxdrones.adapters.session import SEEDS, Session, as_env, flat
from jaxdrones.adapters.spaces import Layout
from jaxdrones.arguments import checked
from jaxdrones.envs import Env
from jaxdrones.errors import UserError, install
from jaxdrones.tasks.task import Task

try:
    import pettingzoo
except ImportError as error:
    raise ImportError(f"pettingzoo is not installed; {install('pettingzoo')}") from error


def parallel_env(task: str | Task | Env, **options: Any) -> ParallelEnv:
    """Make a team with agents `drone_0`, `drone_1`, ..., with the options of `jaxdrones.make`."""
    return ParallelEnv(task, **options)


class ParallelEnv(pettingzoo.ParallelEnv):
    """One world; an agent leaves `agents` when its episode has ended, by default with all others. See `Task.ends`."""

    @checked
    def __init__(self, task: str | Task | Env, *, render_mode: pictures.RenderMode = None, **options: Any):
        """Wrap an environment; arguments are those of `GymnasiumEnv`."""
        self.env = as_env(task, options)
        self.render_mode = render_mode
        self.metadata = {
            "name": f"jaxdrones/{self.env.task.name}",
            "is_parallelizable": True,
            "render_modes": pictures.MODES,
            "render_fps": round(1 / self.env.dt),
        }
        self.possible_agents = [f"drone_{i}" for i in range(self.env.drones)]
        self.agents: list[str] = []
        self._layout = Layout(self.env, self.possible_agents)
        self.observation_spaces = dict(self._layout.observation.items())
        self.action_spaces = dict(self._layout.action.items())
        bound = np.tile(self.env.observation_bound, self.env.drones)
        self.state_space = gymnasium.spaces.Box(-bound, bound, dtype=np.float32)
        self._session = Session(self.env)
        self._seeds = np.random.default_rng()

    def observation_space(self, agent: str) -> gymnasium.Space:
        """Observation space of an agent."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.Space:
        """Action space of an agent."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Start an episode; a seed makes it and the following ones reproducible. There are no options."""
        if seed is not None:
            self._seeds = np.random.default_rng(seed)
        self.agents = list(self.possible_agents)
        obs = self._session.reset(int(self._seeds.integers(SEEDS)) if seed is None else seed)
        return self._observed(obs), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, np.ndarray]) -> tuple[Any, Any, Any, Any, Any]:
        """One control step."""
        if not self._session.running:
            raise UserError("step is called before reset or after the end of an episode; call reset")
        drones = {agent: i for i, agent in enumerate(self.possible_agents) if agent in self.agents}
        obs, reward, _, _, info = self._session.step(self._layout.gather_present(actions, drones))
        observed = self._observed(obs)
        ended = info["terminated"] | info["truncated"]
        self.agents = [agent for agent, i in drones.items() if not ended[i]]
        return (
            {agent: observed[agent] for agent in drones},
            {agent: reward[i].item() for agent, i in drones.items()},
            {agent: bool(info["terminated"][i]) for agent, i in drones.items()},
            {agent: bool(info["truncated"][i]) for agent, i in drones.items()},
            {agent: _of_drone(info, i) for agent, i in drones.items()},
        )

    def state(self) -> np.ndarray:
        """Concatenated observations of all agents without images, for centralized critics."""
        if self._session.world is None:
            raise UserError("state is called before reset; call reset")
        return self._state.copy()

    def render(self) -> np.ndarray | None:
        """Picture (height, width, 3) of the team from the side, with `render_mode="rgb_array"`."""
        if self.render_mode is None:
            gymnasium.logger.warn('render is called without a render mode; make it with render_mode="rgb_array"')
            return None
        if self._session.world is None:
            raise UserError("render is called before reset; call reset")
        return self._session.photo()

    def close(self) -> None:
        """Close the connection to Bullet, if any."""
        self._session.close()

    def _observed(self, obs: Any) -> dict[str, Any]:
        self._state = (obs["state"] if isinstance(obs, dict) else obs).ravel()
        return self._layout.arrange(obs)


def _of_drone(info: dict[str, Any], i: int) -> dict[str, Any]:
    return {name: x[i].item() for name, x in flat(info).items()}
