"""Controllers of one drone.

Each module has `gains()`, `init()` and `control(gains, params, memory, state, setpoint, dt=...) -> (memory, rpm)`, all
for one drone; `velocity.control` takes an action instead of the setpoint. For a team use `jax.vmap` of `control`, with
the memory `for_team(init(), n)`. `CONTROLLERS` lists the controllers by the names that the command line uses.
"""

import importlib
from types import ModuleType
from typing import Any

from jaxdrones.control import (
    firmware_motors,
    firmware_pid,
    geometric,
    mellinger,
    mrac,
    pid,
    rates,
    simple_pid,
    velocity,
)
from jaxdrones.control.setpoint import Setpoint
from jaxdrones.control.team import for_team
from jaxdrones.params import Params

CONTROLLERS = {
    "pid": pid,
    "simple_pid": simple_pid,
    "geometric": geometric,
    "rates": rates,
    "firmware_pid": firmware_pid,
    "mellinger": mellinger,
    "mrac": mrac,
}

__all__ = [
    "CONTROLLERS",
    "Setpoint",
    "firmware_motors",
    "firmware_pid",
    "for_team",
    "geometric",
    "mellinger",
    "mrac",
    "pid",
    "rates",
    "simple_pid",
    "tune",
    "velocity",
]


def tune(params: Params, controller: str | ModuleType, *, control_hz: int = 500, iterations: int = 40) -> Any:
    """Tuned gains of a controller for a vehicle, by the gradient of the simulation; this takes about half a minute.

    Args:
        params: parameters of one drone.
        controller: a name of `CONTROLLERS`, or its module; `mrac` has no gains to tune.
        control_hz: calls of the controller per second; use the gains at this rate or a higher one.
        iterations: number of iterations of Adam.

    Returns:
        Gains for the `control` of the controller. `jaxdrones.optimal.tune` documents the method.

    Raises:
        ValueError: an unknown controller, one without gains to tune, one that cannot fly the vehicle, or parameters of
            a team.
    """
    tuning = importlib.import_module("jaxdrones.optimal.tuning")  # by name, as it is in a higher layer
    return tuning.tune(params, controller, control_hz=control_hz, iterations=iterations)
