"""Gymnax-style environments, for PureJaxRL and other compiled training loops.

```python
from jaxdrones.adapters import gymnax

env = gymnax.wrap(jd.make("hover"))
params = env.default_params
obs, state = env.reset(key, params)
obs, state, reward, done, info = env.step(key, state, action, params)
```

Gymnax itself is not needed.
"""

import dataclasses
import functools
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxdrones import envs
from jaxdrones.adapters import jax_spaces
from jaxdrones.adapters.jax_spaces import Spaces, action_space, of_gymnasium
from jaxdrones.adapters.session import TaskOrEnv, as_env, rewarding
from jaxdrones.adapters.spaces import Layout
from jaxdrones.envs.autoreset import Episode
from jaxdrones.envs.episode import RESET
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode


class EnvParams(PyTreeNode):
    """Parameters that may differ between worlds; use the same for reset and steps of a world."""

    max_steps_in_episode: Any
    """Control steps after which an episode is truncated."""
    vehicle: Params
    """Nominal parameters of the team."""


class GymnaxEnv:
    """One world with one agent and automatic reset in the same step.

    Observations and actions of the drones are concatenated. With images, observations are
    dictionaries of `state` and of the images, with a drone axis for several drones.
    """

    def __init__(
        self,
        env: TaskOrEnv,
        *,
        separate_truncation: bool = False,
        discrete_actions: ArrayLike | None = None,
        spaces: Spaces = jax_spaces,
        team_reward: str = "sum",
    ):
        """Wrap an environment.

        Args:
            env: environment, or a task as for `jaxdrones.make`.
            separate_truncation: whether `step` returns `terminated` and `truncated`, as in gymnax 1.0, in place of
                `done`.
            discrete_actions: (k, n a) table of actions of the whole team for discrete actions; by default actions are
                continuous.
            spaces: module of the space classes, for loops that check the class of a space, such as
                `gymnax.environments.spaces`.
            team_reward: reward of a team, `sum` or `mean` of the rewards of its drones.

        Raises:
            ValueError: a table of actions of another shape, or with numbers that are not finite.
        """
        self.env = env = as_env(env, {})
        self._rewarding = rewarding(team_reward)
        self._separate_truncation = separate_truncation
        self._layout = Layout(env, None)
        self._table, self._action_space = action_space(discrete_actions, env.drones * env.action_size, spaces)
        self._observation_space = of_gymnasium(_flat_space(self._layout.observation), spaces)

    @property
    def name(self) -> str:
        """Name of the task."""
        return self.env.task.name

    @property
    def default_params(self) -> EnvParams:
        """Default parameters of the environment."""
        return EnvParams(self.env.steps, self.env.params)

    @property
    def num_actions(self) -> int:
        """Length of an action, or number of discrete actions."""
        return self._action_space.n if self._table is not None else self._action_space.shape[0]

    def observation_space(self, params: EnvParams | None = None) -> Any:
        """Observation space, independent of the parameters."""
        return self._observation_space

    def action_space(self, params: EnvParams | None = None) -> Any:
        """Action space, independent of the parameters."""
        return self._action_space

    @functools.partial(jax.jit, static_argnums=0)
    def reset(self, key: jax.Array, params: EnvParams | None = None) -> tuple[Any, Episode]:
        """Start an episode; return observation and state."""
        obs, state = self._episodes(params).reset(key)
        return self._arranged(obs), state

    def reset_env(self, key: jax.Array, params: EnvParams | None = None) -> tuple[Any, Episode]:
        """Start an episode, like `reset`."""
        return self.reset(key, params)

    @functools.partial(jax.jit, static_argnums=0)
    def step(self, key: jax.Array, state: Episode, action: jax.Array, params: EnvParams | None = None) -> tuple:
        """One control step.

        Returns:
            Observation, state, reward, done and info, with `info["discount"]` 0 in a step that terminates the episode,
            else 1. With `separate_truncation` observation, state, reward, terminated, truncated and info, with
            `final_observation`, the observation before a possible reset.
        """
        action = self._gathered(action)
        outcome = (
            envs.AutoReset(self.env).step(key, state, action)
            if params is None
            else _step_and_reset(self._with(params), key, state, action)
        )
        obs, state, reward, terminated, truncated, info = outcome
        obs, reward = self._arranged(obs), self._rewarding(reward)
        if self._separate_truncation:
            final = self._arranged(info["final_obs"])
            info = {"terminated": terminated, "truncated": truncated, "final_observation": final}
            return obs, state, reward, terminated, truncated, info
        return obs, state, reward, terminated | truncated, {"discount": _discount(terminated, reward)}

    @functools.partial(jax.jit, static_argnums=0)
    def step_env(self, key: jax.Array, state: Episode, action: jax.Array, params: EnvParams | None = None) -> tuple:
        """One control step without reset.

        Returns:
            Observation, state, reward, done and info; with `separate_truncation` it is `terminated` in place of done,
            and info has `truncated`, as in gymnax 1.0.
        """
        outcome = self._episodes(params).step_without_reset(key, state, self._gathered(action))
        obs, state, reward, terminated, truncated, _ = outcome
        obs, reward = self._arranged(obs), self._rewarding(reward)
        if self._separate_truncation:
            return obs, state, reward, terminated, {"truncated": truncated}
        return obs, state, reward, terminated | truncated, {"discount": _discount(terminated, reward)}

    def _episodes(self, params: EnvParams | None) -> envs.AutoReset:
        return envs.AutoReset(self.env if params is None else self._with(params))

    def _gathered(self, action: jax.Array) -> Float[Array, "n a"]:
        action = action if self._table is None else self._table[action]
        return jnp.reshape(action, (self.env.drones, self.env.action_size))

    def _with(self, params: EnvParams) -> envs.Env:
        return dataclasses.replace(self.env, steps=params.max_steps_in_episode, params=params.vehicle)

    def _arranged(self, obs: Any) -> Any:
        obs = self._layout.arrange(obs)
        return obs | {"state": jnp.ravel(obs["state"])} if isinstance(obs, dict) else jnp.ravel(obs)


wrap = GymnaxEnv
"""Wrap an environment with the interface of gymnax."""


def _step_and_reset(env: envs.Env, key: jax.Array, state: Episode, action: jax.Array) -> tuple:
    """Step of `AutoReset` with a reset in every step, as the parameters of worlds may differ."""
    episodes = envs.AutoReset(env)
    final_obs, after, reward, terminated, truncated, _ = episodes.step_without_reset(key, state, action)
    fresh = episodes.reset(jax.random.fold_in(key, RESET))
    ended = terminated | truncated
    obs, state = jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, (final_obs, after))
    return obs, state, reward, terminated, truncated, {"final_obs": final_obs}


def _discount(terminated: jax.Array, reward: jax.Array) -> jax.Array:
    return 1 - terminated.astype(reward.dtype)


def _flat_space(space: gymnasium.Space) -> gymnasium.Space:
    if isinstance(space, gymnasium.spaces.Dict):
        return gymnasium.spaces.Dict({**space.spaces, "state": _flat_space(space["state"])})
    return gymnasium.spaces.flatten_space(space)
