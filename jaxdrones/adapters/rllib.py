"""RLlib `MultiAgentEnv` of a team, one agent per drone."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxdrones.adapters.session import SEEDS, Session, as_env
from jaxdrones.adapters.spaces import Layout
from jaxdrones.envs import Env
from jaxdrones.errors import UserError
from jaxdrones.tasks.task import Task

try:
    from ray.rllib.env import multi_agent_env
except ImportError as error:
    raise ImportError('RLlib is not installed; pip install "ray[rllib]==2.60.0" torch') from error


class MultiAgentEnv(multi_agent_env.MultiAgentEnv):
    """One world with agents `drone_0`, `drone_1`, ...; episodes begin and end for all of them at once."""

    def __init__(self, task: str | Task | Env, **options: Any):
        """Wrap an environment: a name, a task or an environment, and options of `jaxdrones.make`."""
        super().__init__()
        self.env = as_env(task, options)
        self.possible_agents = [f"drone_{i}" for i in range(self.env.drones)]
        self.agents = list(self.possible_agents)
        self._layout = Layout(self.env, self.possible_agents)
        self.observation_spaces = dict(self._layout.observation.items())
        self.action_spaces = dict(self._layout.action.items())
        self._session = Session(self.env)
        self._seeds = np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Start an episode; a seed makes it and the following ones reproducible. There are no options."""
        if seed is not None:
            self._seeds = np.random.default_rng(seed)
        self.agents = list(self.possible_agents)
        obs = self._session.reset(int(self._seeds.integers(SEEDS)) if seed is None else seed)
        return self._layout.arrange(obs), {agent: {} for agent in self.agents}

    def step(self, action_dict: dict[str, np.ndarray]) -> tuple[Any, Any, Any, Any, Any]:
        """One control step."""
        if not self._session.running:
            raise UserError("step is called before reset or after the end of an episode; call reset")
        drones = {agent: i for i, agent in enumerate(self.possible_agents) if agent in self.agents}
        obs, reward, terminated, truncated, info = self._session.step(self._layout.gather_present(action_dict, drones))
        observed, ended = self._layout.arrange(obs), info["terminated"] | info["truncated"]
        self.agents = [agent for agent, i in drones.items() if not ended[i]]
        return (
            {agent: observed[agent] for agent in drones},
            {agent: reward[i].item() for agent, i in drones.items()},
            {agent: bool(info["terminated"][i]) for agent, i in drones.items()} | {"__all__": terminated},
            {agent: bool(info["truncated"][i]) for agent, i in drones.items()} | {"__all__": truncated},
            {agent: {} for agent in drones},
        )

    def close(self) -> None:
        """Close the connection to Bullet, if any."""
        self._session.close()
