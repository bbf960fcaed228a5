"""Controllers of the demonstrations and the set-points they receive."""

import functools
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxdrones import optimal
from jaxdrones.checks import bind, check_function, takes
from jaxdrones.control import CONTROLLERS, firmware_pid, for_team, mellinger, mrac, pid, velocity
from jaxdrones.dynamics import EFFECTS, INTEGRATORS, ROTORS
from jaxdrones.engine.explicit import make_step
from jaxdrones.errors import UserError
from jaxdrones.flights.conditions import Conditions
from jaxdrones.flights.examples import FLIGHTS
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.tasks.curves import setpoint_on
from jaxdrones.urdf import load_params
from jaxdrones.user_code import definition, is_reference, read_text

_SCALED = (firmware_pid, mellinger)  # to vehicles other than the Crazyflie
_ARGUMENTS = {"gains": (), "init": (), "control": ("gains", "params", "memory", "state", "setpoint")}


class Controller(NamedTuple):
    """Controller of a team."""

    init: Callable[[Params, State], Any]
    """Constants and start of a team -> memory."""
    control: Callable[[Params, Any, State, jax.Array], tuple[Any, jax.Array]]
    """(params, memory, state, time in s) -> memory and rotor speeds (n, 4)."""


def controller_of(conditions: Conditions) -> Controller:
    """Controller of a flight."""
    if conditions.controller in optimal.CONTROLLERS:
        return _optimal(conditions)
    n = conditions.drones
    module = velocity if conditions.flight == "velocity" else module_of(conditions.controller)
    if module in (pid, velocity):
        gains = pid.gains(conditions.vehicle)
    elif module is mrac or (module in _SCALED and conditions.vehicle not in pid.VEHICLES):
        gains = module.gains(load_params(conditions.vehicle))
    else:
        gains = module.gains()
    memory = for_team((pid if module is velocity else module).init(), n)
    one = functools.partial(module.control, gains, dt=conditions.dt)

    def fly(params: Params, memory: Any, state: State, t: jax.Array) -> tuple[Any, jax.Array]:
        return jax.vmap(one)(params, memory, state, setpoints(conditions, t))

    return Controller(lambda params, start: memory, fly)


def module_of(name: str) -> Any:
    """Controller by its name, or of a user's file, validated."""
    if not is_reference(name):
        return CONTROLLERS[name]
    file = Path(name)
    functions = {called: definition(file.name, read_text(file), called) for called in _ARGUMENTS}
    for called, arguments in _ARGUMENTS.items():
        check_function(f"{called} of {file.name}", bind(functions[called], dt=0.0), arguments)
    if not takes(functions["control"], "dt"):
        raise UserError(f"control of {file.name} has no parameter dt; add it, the time between calls, s")
    return SimpleNamespace(**functions)


def setpoints(conditions: Conditions, t: jax.Array) -> Any:
    """Set-points of a team at a time (s), with velocity and acceleration if `feedforward`; or velocity actions."""

    def target(t: jax.Array) -> Any:
        return FLIGHTS[conditions.flight].target(conditions.drones, t, conditions.duration)

    if not conditions.feedforward:
        return target(t)
    return setpoint_on(lambda t: target(t).pos, t).replace(yaw=target(t).yaw)


def physics_of(conditions: Conditions) -> dict[str, Any]:
    """Arguments of `make_step` of either backend for a flight, without the effects between drones."""
    return dict(
        effects=[EFFECTS[effect] for effect in conditions.effects if effect in EFFECTS],
        rotors=ROTORS[conditions.rotors],
        dt=conditions.dt / conditions.substeps,
        substeps=conditions.substeps,
    )


def _optimal(conditions: Conditions) -> Controller:
    """Optimal controller with the step of the flight as its model, for each drone alone."""
    n, module = conditions.drones, optimal.CONTROLLERS[conditions.controller]
    step = make_step(**physics_of(conditions), integrator=INTEGRATORS[conditions.integrator])
    settings = module.settings(step)
    one = functools.partial(module.control, settings, dt=conditions.dt)

    def init(params: Params, start: State) -> Any:
        key = jax.random.key(conditions.seed or 0)
        own_key = key if conditions.seed is None else jax.random.fold_in(key, 1)  # the start is drawn from `key`
        keys = jax.random.split(own_key, n)
        own = (keys,) if module is optimal.mppi else ()
        return jax.vmap(functools.partial(module.init, settings))(params, start, *own)

    def fly(params: Params, memory: Any, state: State, t: jax.Array) -> tuple[Any, jax.Array]:
        times = t + conditions.dt * jnp.arange(settings.horizon + 1)
        ahead = jax.vmap(functools.partial(setpoints, conditions), out_axes=1)(times)
        return jax.vmap(one)(params, memory, state, ahead)

    return Controller(init, fly)
