"""Controllers of one drone.

Each module has `gains()`, `init(n)` and `control(gains, params, memory, state, setpoint, dt=...) -> (memory, rpm)`;
`velocity.control` takes an action in place of the setpoint. The table is what the command line knows by name.
"""

from jaxdrones.control import geometric, pid, rates, simple_pid, velocity
from jaxdrones.control.setpoint import Setpoint

CONTROLLERS = {"pid": pid, "simple_pid": simple_pid, "geometric": geometric, "rates": rates}

__all__ = ["CONTROLLERS", "Setpoint", "geometric", "pid", "rates", "simple_pid", "velocity"]
