"""JaxMARL-style environments: dictionaries by agent, one agent per drone, for compiled training loops.

```python
from jaxdrones.adapters import jaxmarl

env = jaxmarl.wrap(jd.make("leader-follower"))
obs, state = env.reset(key)
obs, state, rewards, dones, infos = env.step(key, state, {agent: action for agent in env.agents})
```

JaxMARL itself is not needed.
"""

import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxdrones import envs
from jaxdrones.adapters import jax_spaces
from jaxdrones.adapters.jax_spaces import Spaces, action_space, of_gymnasium
from jaxdrones.adapters.session import TaskOrEnv, as_env
from jaxdrones.adapters.spaces import Layout, observation_of_drone
from jaxdrones.envs.autoreset import Episode
from jaxdrones.envs.vision import observation

ALL = "__all__"
WORLD_STATE = "world_state"


class JaxMARLEnv:
    """One world with automatic reset in the same step; see `Task.ends` for the ends of episodes."""

    def __init__(
        self,
        env: TaskOrEnv,
        *,
        world_state: bool = False,
        discrete_actions: ArrayLike | None = None,
        spaces: Spaces = jax_spaces,
    ):
        """Wrap an environment.

        Args:
            env: environment, or a task as for `jaxdrones.make`.
            world_state: whether observations also have `world_state` (n, n d), a row for the centralized critic of
                every agent: its own observation, then those of the others, without images.
            discrete_actions: (k, a) table of actions of a drone for discrete actions; by default actions are
                continuous.
            spaces: module of the space classes, for loops that check the class of a space, such as
                `jaxmarl.environments.spaces`.

        Raises:
            ValueError: a table of actions of another shape, or with numbers that are not finite.
        """
        self.env = env = as_env(env, {})
        self.num_agents = env.drones
        self.agents = [f"drone_{i}" for i in range(env.drones)]
        self.agent_classes = {"drones": self.agents}
        self._episodes, self._layout = envs.AutoReset(env), Layout(env, self.agents)
        self._with_world_state = world_state
        self._table, action = action_space(discrete_actions, env.action_size, spaces)
        self.observation_spaces = dict.fromkeys(self.agents, of_gymnasium(observation_of_drone(env), spaces))
        self.action_spaces = dict.fromkeys(self.agents, action)

    @property
    def name(self) -> str:
        """Name of the task."""
        return self.env.task.name

    def observation_space(self, agent: str) -> Any:
        """Observation space of an agent."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        """Action space of an agent."""
        return self.action_spaces[agent]

    def world_state_size(self) -> int:
        """Length of a row of the world state."""
        return self.env.drones * self.env.observation_size

    @functools.partial(jax.jit, static_argnums=0)
    def reset(self, key: jax.Array) -> tuple[dict[str, Any], Episode]:
        """Start an episode; return observations and state."""
        obs, state = self._episodes.reset(key)
        return self._by_agent(obs), state

    @functools.partial(jax.jit, static_argnums=0)
    def step(
        self, key: jax.Array, state: Episode, actions: Mapping[str, Array], reset_state: Episode | None = None
    ) -> tuple[dict[str, Any], Episode, dict[str, Array], dict[str, Array], dict[str, Any]]:
        """One control step.

        Args:
            key: random key.
            state: from `reset` or `step`.
            actions: one for every agent.
            reset_state: initial state of the next episode; by default a random one.

        Returns:
            Observations and state, those of the next episode after an end; rewards; dones, by agent and `__all__`; and
            infos with one entry per agent: `rewards` and `metrics` by name, `terminated` and `truncated`.
        """
        if reset_state is None:
            return self._outcome(*self._episodes.step(key, state, self._gathered(actions)))
        obs, state, rewards, dones, infos = self.step_env(key, state, actions)
        begun = self.get_obs(reset_state), reset_state
        obs, state = jax.tree.map(lambda new, old: jnp.where(dones[ALL], new, old), begun, (obs, state))
        return obs, state, rewards, dones, infos

    @functools.partial(jax.jit, static_argnums=0)
    def step_env(
        self, key: jax.Array, state: Episode, actions: Mapping[str, Array]
    ) -> tuple[dict[str, Any], Episode, dict[str, Array], dict[str, Array], dict[str, Any]]:
        """One control step without reset; the results are those of `step`."""
        return self._outcome(*self._episodes.step_without_reset(key, state, self._gathered(actions)))

    @functools.partial(jax.jit, static_argnums=0)
    def get_obs(self, state: Episode) -> dict[str, Any]:
        """Observations of a state, without noise."""
        return self._by_agent(observation(self.env.privileged_observation(state.world).obs, state.world))

    def get_avail_actions(self, state: Episode) -> dict[str, Array]:
        """Ones for all discrete actions, or all entries of an action, of every agent."""
        n = self.env.action_size if self._table is None else len(self._table)
        return dict.fromkeys(self.agents, jnp.ones(n))

    def _gathered(self, actions: Mapping[str, Array]) -> Float[Array, "n a"]:
        if self._table is not None:
            actions = {agent: self._table[jnp.reshape(action, ())] for agent, action in actions.items()}
        return self._layout.gather(actions)

    def _by_agent(self, obs: Any) -> dict[str, Any]:
        by_agent = self._layout.arrange(obs)
        if self._with_world_state:
            vectors = jnp.stack([x["state"] if isinstance(x, dict) else x for x in by_agent.values()])
            by_agent[WORLD_STATE] = jnp.stack([jnp.roll(vectors, -i, axis=0).ravel() for i in range(self.num_agents)])
        return by_agent

    def _outcome(
        self, obs: Any, state: Episode, reward: Array, terminated: Array, truncated: Array, info: dict[str, Any]
    ) -> tuple:
        infos = {name: info[name] for name in ("rewards", "metrics", "terminated", "truncated")}
        ended = info["terminated"] | info["truncated"] | ~info["active"]
        rewards = {agent: reward[i] for i, agent in enumerate(self.agents)}
        dones = {agent: ended[i] for i, agent in enumerate(self.agents)} | {ALL: terminated | truncated}
        return self._by_agent(obs), state, rewards, dones, infos


wrap = JaxMARLEnv
"""Wrap an environment with the interface of JaxMARL."""
