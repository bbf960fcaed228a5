"""Trained policy as a pilot of Betaflight."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.envs import Env
from jaxdrones.envs.observations import observe
from jaxdrones.errors import UserError
from jaxdrones.firmware.betaflight import Sticks, sticks_for
from jaxdrones.firmware.betaflight.pilots import PERIOD
from jaxdrones.firmware.drone import Sample
from jaxdrones.flights.log import STATE_AND_SPEEDS
from jaxdrones.learning.networks import AnyPolicy, act, initial_hidden_state
from jaxdrones.tasks.task import World

ACTION = "thrust_and_rates"
"""Action type that sticks can command."""


class PolicyPilot:
    """Policy that acts with collective thrust and body rates; Betaflight controls the rates."""

    def __init__(self, env: Env, policy: AnyPolicy, seed: int = 0):
        """Start an episode of the task, whose only drone is the simulated one; `seed` is that of the goals."""
        if env.action.name != ACTION or env.action.entries is None:
            raise UserError(
                f"the policy has the action type {env.action.name!r}, which sticks cannot command; train one with "
                f"--set action={ACTION}"
            )
        if env.vision is not None or env.sensors or env.physics.physics.models or env.drones != 1:
            raise UserError(f"the policy is for {env}; give one of a single drone without cameras, sensors and loads")
        if env.dt < PERIOD - 1e-9:
            raise UserError(
                f"the policy acts at {1 / env.dt:g} Hz, and sticks move at {1 / PERIOD:g} Hz; train one with "
                f"--set control_hz={1 / PERIOD:g} or less"
            )
        self._env, self._params = env, jax.tree.map(lambda x: x[0], env.params)
        self._entries = env.action.entries(self._params)
        world = env.reset(jax.random.key(seed))[1]
        self._world = world.replace(params=env.params)
        self._hidden = initial_hidden_state(policy, 1)
        self._decide = jax.jit(functools.partial(_decide, env, policy))
        self._steps, self._sticks = 0, Sticks()
        self.target = np.asarray(self._decide(self._hidden, self._world)[3])
        """(3,) target position of the task at the last action, m, world."""

    def __call__(self, t: float, sample: Sample) -> Sticks:
        """Sticks at a time since arming (s); between control steps of the environment they stay."""
        if t < self._steps * self._env.dt - 1e-9:
            return self._sticks
        self._steps += 1
        dtype = np.dtype(self._world.drones.pos.dtype)
        arrays = {name: np.asarray(x, dtype)[None] for name, x in vars(sample).items() if name in STATE_AND_SPEEDS}
        step = np.asarray(self._steps - 1, np.dtype(self._world.step.dtype))
        world = self._world.replace(drones=self._world.drones.replace(**arrays), step=step)
        self._hidden, self._world, action, target = jax.device_get(self._decide(self._hidden, world))
        self.target = np.asarray(target)
        thrust, *omega = (
            float(np.interp(a, (-1, 0, 1), entry.values or (0, 0, 0)))
            for a, entry in zip(np.asarray(action), self._entries, strict=True)
        )
        self._sticks = sticks_for(self._params, thrust, omega)
        return self._sticks


def _decide(env: Env, policy: AnyPolicy, hidden: Any, world: World) -> tuple[Any, World, jax.Array, jax.Array]:
    """Hidden state, world with new variables and action, the action (4,), and the target position (3,)."""
    variables = env.task.advance(env.task, world), world.variables
    world = world.replace(variables=jax.tree.map(lambda x, start: jnp.where(world.step > 0, x, start), *variables))
    hidden, action = act(policy, hidden, observe(env.terms, env.task, world))
    action = jnp.clip(action, -1, 1)
    actions = jnp.concatenate([world.actions[:, 1:], action[:, None]], axis=1)
    return hidden, world.replace(actions=actions), action[0], env.task.target_now(world).pos[0]
