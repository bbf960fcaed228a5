"""Gymnasium spaces of an environment, and layouts of teams."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space

from jaxdrones.checks import check_shape, is_concrete
from jaxdrones.envs import Env
from jaxdrones.errors import UserError


def observation_of_drone(env: Env) -> spaces.Space:
    """Observation space of one drone."""
    state = spaces.Box(-env.observation_bound, env.observation_bound, dtype=np.float32)
    images = {name: spaces.Box(x.low, x.high, x.shape, x.dtype) for name, x in env.image_spaces.items()}
    known: dict[str, spaces.Space] = {"state": state, **images}
    return spaces.Dict(known) if images else state


def action_of_drone(env: Env) -> spaces.Box:
    """Action space of one drone."""
    return spaces.Box(-1, 1, (env.action_size,), np.float32)


class Layout:
    """Layout of observations and actions: a single drone without drone axis; a team with it, or as a dict by drone."""

    def __init__(self, env: Env, names: Sequence[str] | None):
        n = env.drones
        self.drones, self.size, self.names = n, env.action_size, tuple(names or ())
        self.observation: Any
        self.action: Any
        if names:
            self.observation = spaces.Dict({name: observation_of_drone(env) for name in names})
            self.action = spaces.Dict({name: action_of_drone(env) for name in names})
        elif n == 1:
            self.observation, self.action = observation_of_drone(env), action_of_drone(env)
        else:
            self.observation = batch_space(observation_of_drone(env), n)
            self.action = batch_space(action_of_drone(env), n)

    def arrange(self, tree: Any, axis: int = 0) -> Any:
        """Convert arrays with drones along `axis` to this layout, real ones in single precision, as the spaces say."""
        tree = jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == np.float64 else x, tree)
        if self.names:
            return {name: _pick(tree, i, axis) for i, name in enumerate(self.names)}
        return _pick(tree, 0, axis) if self.drones == 1 else tree

    def gather(self, action: Any, batch: tuple[int, ...] = ()) -> Any:
        """Convert an action in this layout to an array (*batch, n, a).

        Raises:
            ValueError: a missing action, a wrong shape, or NaN (of a batch or a traced action, only in NumPy arrays).
        """
        meaning = f"{self.size} numbers"
        if not self.names:
            alone = self.drones == 1
            meaning += "" if alone else f" for each of {self.drones} drones"
            shape = (*batch, self.size) if alone else (*batch, self.drones, self.size)
            action = _check(action, "action", shape, meaning, batch)
            return action[..., None, :] if alone else action
        if not isinstance(action, Mapping) or set(action) != set(self.names):
            given = ", ".join(map(str, action)) if isinstance(action, Mapping) else repr(action)
            raise UserError(
                f"actions are for {given or 'no drone'}; give a dict with an action for each of {', '.join(self.names)}"
            )
        rows = [_check(action[name], f"action of {name}", (*batch, self.size), meaning, batch) for name in self.names]
        stack = np.stack if isinstance(rows[0], np.ndarray) else jnp.stack
        return stack(rows, axis=len(batch))

    def gather_present(self, actions: Any, present: Collection[str]) -> Any:
        """`gather` for the agents that are still in the world; actions of the others are zero."""
        if isinstance(actions, Mapping):
            left = [name for name in self.names if name not in present]
            actions = dict(actions) | dict.fromkeys(left, np.zeros(self.size, np.float32))
        return self.gather(actions)


def _check(action: Any, name: str, shape: tuple[int, ...], meaning: str, batch: tuple[int, ...]) -> Any:
    if not isinstance(action, jax.Array) or (is_concrete(action) and not batch):
        action = np.asarray(action, np.float32)
        if not np.isfinite(action).all():
            bad = np.argwhere(~np.isfinite(action))
            where = f"{len(bad)} of {action.size} entries, the first at {tuple(map(int, bad[0]))}"
            raise UserError(f"{name} is not finite in {where}; give numbers in [-1, 1]")
    if action.shape != shape:
        check_shape(name, action, shape, meaning)
    return action


def _pick(tree: Any, i: int, axis: int) -> Any:
    return jax.tree.map(lambda x: x[(slice(None),) * axis + (i,)], tree)
