"""Optimal control of one drone with the simulator's step: LQR, iLQR with motor limits, and MPPI.

Each module has `settings(step, ...)`, `init(settings, params, state)` (of `mppi` also with a random key) and
`control(settings, params, memory, state, setpoints, dt=...) -> (memory, rpm)`, all for one drone. `step` is that of a
team over one control period: that of the simulation, or a simpler one. `setpoints` holds the target at the current and
the next `settings.horizon` control steps, `memory` is that of `init` or the last call, and `dt` the time between calls,
s. Use `jax.vmap` for teams and worlds. Without a new command, `on_failure="hold"` repeats the last safe
command, and `"raise"`, which is impossible inside `jax.jit`, raises `PlanningError`; the memory has the status.

`tune` tunes the gains of the controllers of `jaxdrones.control` for a vehicle. `twin.casadi_model` converts the physics
to a CasADi function, and `mpc.Mpc` tracks setpoints with it; both need the extra `casadi`.
"""

from jaxdrones.optimal import ilqr, lqr, mppi
from jaxdrones.optimal.coordinates import difference, displaced, linearize, linearize_step, single
from jaxdrones.optimal.problem import Reference, Weights, reference, weights
from jaxdrones.optimal.tuning import tune

CONTROLLERS = {"lqr": lqr, "ilqr": ilqr, "mppi": mppi}
"""Controllers by the names that the command line uses."""

__all__ = ["CONTROLLERS", "Reference", "Weights", "reference", "tune", "weights"]
__all__ += ["difference", "displaced", "ilqr", "linearize", "linearize_step", "lqr", "mppi", "single"]
