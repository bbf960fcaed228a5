"""Checks of action types against rotors and control rate."""

import inspect
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.dynamics.rotors import lagging_rotors
from jaxdrones.engine.physics import Physics
from jaxdrones.envs import episode
from jaxdrones.envs.actions import Action
from jaxdrones.envs.env import Env
from jaxdrones.envs.functions import check_kept, is_own, kind_of, shape_of, where_is
from jaxdrones.errors import UserError
from jaxdrones.params import Params

_MAX_PERIOD = 1 / 30  # s; at 27 Hz the PID loses a Crazyflie; the geometric controller is stable down to 15 Hz
_MAX_ROTOR_TIME = 0.02  # s, mean of rise and fall; with 0.022 the PID loses a Crazyflie at 48 Hz


def check_action(name: str | None, action: Action, params: Params, rotors: Any, dt: float) -> None:
    """Raise for rotors, a control rate or a rotor lag that do not suit an action type.

    An action type with a name commands rotor speeds; another one, without a name, may command the PWM of `pwm_rotors`.
    Controllers are unstable at a low control rate or with slow rotors.
    """
    if name is not None and Physics(rotors=rotors).takes_pwm:
        raise UserError(
            f"rotors take PWM, and the action type {name!r} commands rotor speeds, RPM; give rotors='lagging', or an "
            "object of Action that commands PWM"
        )
    if action.for_vehicle is None:
        return
    name = "given" if name is None else name
    if dt > _MAX_PERIOD * (1 + 1e-6):
        raise UserError(
            f"control_hz is {1 / dt:g}; the action type {name!r} uses a controller that needs "
            f"{1 / _MAX_PERIOD:g} or more"
        )
    time = float(np.max(params.rotor_rise_time + params.rotor_fall_time)) / 2
    lagging = inspect.unwrap(rotors) is inspect.unwrap(lagging_rotors)  # also inside `failing`
    if lagging and time > _MAX_ROTOR_TIME * (1 + 1e-6):
        raise UserError(
            f"the action type {name!r} uses a controller that needs rotors with a time constant of up to "
            f"{_MAX_ROTOR_TIME} s; this vehicle has {time:.2g} s; give rotors='instant', or an "
            "action type that commands rotors, thrust and torques, or rates"
        )


def check_command(env: Env) -> None:
    """Raise unless a user's action type returns its memory and four rotor speeds, by tracing it."""
    action = env.action
    if is_own(action.rpm):
        return
    where = where_is("action", action.rpm)

    def trial(key: jax.Array) -> int:
        world = episode.first_world(env, key)
        params, state, target = jax.tree.map(lambda x: x[0], (world.params, world.drones, env.task.target_now(world)))
        memory = action.init()
        returned = action.rpm(params, memory, state, jnp.zeros(action.size), target, env.dt)
        if not (isinstance(returned, tuple) and len(returned) == 2 and shape_of(returned[1]) == (4,)):
            found = ", ".join(map(kind_of, returned)) if isinstance(returned, tuple) else kind_of(returned)
            raise UserError(f"{where} returns {found}; return the memory and four rotor speeds (4,), RPM")
        check_kept(where, "a memory", memory, returned[0])
        return 0

    jax.eval_shape(trial, jax.random.key(0))
