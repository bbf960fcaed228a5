"""RLlib `MultiAgentEnv` of a team, one agent per drone."""

from typing import Any

import numpy as np

from jaxdrones.adapters.session import TaskOrEnv, TeamEpisodes

try:
    from ray.rllib.env import multi_agent_env
except ImportError as error:
    raise ImportError('RLlib is not installed; pip install "ray[rllib]==2.60.0" torch') from error


class MultiAgentEnv(TeamEpisodes, multi_agent_env.MultiAgentEnv):
    """One world; see `TeamEpisodes`."""

    def __init__(self, task: TaskOrEnv, **options: Any):
        """Wrap an environment: a task as for `jaxdrones.make` with its options, or an environment."""
        super().__init__()
        self._wrap(task, options)
        self.agents = list(self.possible_agents)

    def step(self, action_dict: dict[str, np.ndarray]) -> tuple[Any, Any, Any, Any, Any]:
        """One control step."""
        (obs, reward, terminated, truncated), ends, _ = self._step(action_dict)
        terminated["__all__"], truncated["__all__"] = ends
        return obs, reward, terminated, truncated, {agent: {} for agent in obs}
