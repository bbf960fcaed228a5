"""Controllers of one drone.

Each module has `gains()`, `init()` and `control(gains, params, memory, state, setpoint, dt=...) -> (memory, rpm)`, all
of one drone; `velocity.control` takes an action in place of the setpoint. A team is `jax.vmap` of `control`, and its
memory is `for_team(init(), n)`. The table lists the controllers by the names that the command line uses.
"""

from jaxdrones.control import firmware_motors, firmware_pid, geometric, pid, rates, simple_pid, velocity
from jaxdrones.control.setpoint import Setpoint
from jaxdrones.control.team import for_team

CONTROLLERS = {
    "pid": pid,
    "simple_pid": simple_pid,
    "geometric": geometric,
    "rates": rates,
    "firmware_pid": firmware_pid,
}

__all__ = [
    "CONTROLLERS",
    "Setpoint",
    "firmware_motors",
    "firmware_pid",
    "for_team",
    "geometric",
    "pid",
    "rates",
    "simple_pid",
    "velocity",
]
