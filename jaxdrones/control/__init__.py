"""Controllers of one drone.

Each module has `gains()`, `init()` and `control(gains, params, memory, state, setpoint, dt=...) -> (memory, rpm)`, all
of one drone; `velocity.control` takes an action in place of the setpoint. A team is `jax.vmap` of `control`, and its
memory is `for_team(init(), n)`. The table lists the controllers by the names that the command line uses.
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
    """Gains with which a controller flies a vehicle well, by the gradient of the simulation; takes about half a minute.

    Args:
        params: of one drone.
        controller: a name of `CONTROLLERS`, or its module; `mrac` has no gains to tune.
        control_hz: calls of the controller per second, at which the gains will be used, or at a higher rate.
        iterations: of Adam.

    Returns:
        Gains of the controller's kind, for its `control`. How they are found is said at `jaxdrones.optimal.tune`.

    Raises:
        ValueError: an unknown controller, one without gains to tune, one that cannot fly the vehicle, or parameters of
            a team.
    """
    tuning = importlib.import_module("jaxdrones.optimal.tuning")  # at the call and by name: it is above this room
    return tuning.tune(params, controller, control_hz=control_hz, iterations=iterations)
