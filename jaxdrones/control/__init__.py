"""Controllers of one drone.

Each module has `gains()`, `init()` and `control(gains, params, memory, state, setpoint, dt=...) -> (memory, rpm)`, all
for one drone; `velocity.control` takes an action instead of the setpoint. `params` and `state` are those of the drone,
`memory` is that of the last call, and `dt` is the time between calls, s. For a team, whose arrays raise `ValueError`,
use `jax.vmap` of `control`, with the memory `for_team(init(), n)`. `CONTROLLERS` maps command line names to
controllers.
"""

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
from jaxdrones.control.single import for_team

_MODULES = pid, simple_pid, geometric, rates, firmware_pid, mellinger, mrac
CONTROLLERS = {module.__name__.rpartition(".")[2]: module for module in _MODULES}

__all__ = ["CONTROLLERS", "Setpoint", "firmware_motors", "for_team", "velocity"]
__all__ += ["firmware_pid", "geometric", "mellinger", "mrac", "pid", "rates", "simple_pid"]
