"""Controllers of one drone.

Each module has `gains()`, `init()` and `control(gains, params, memory, state, setpoint, dt=...) -> (memory, rpm)`, all
of one drone; `velocity.control` takes an action in place of the setpoint. A team is `jax.vmap` of `control`, and its
memory is `for_team(init(), n)`. The table lists the controllers by the names that the command line uses.
"""

import importlib
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


def tune(params: Params, controller: str, **options: Any) -> Any:
    """Gains of a controller for any vehicle: `jaxdrones.optimal.tune`, which flies the engine to find them."""
    above = importlib.import_module("jaxdrones.optimal.tuning")  # no import: this room is below the engine
    return above.tune(params, controller, **options)
