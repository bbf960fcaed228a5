"""Nonlinear model predictive control of one drone with CasADi: multiple shooting with the symbolic twin."""

import time
from typing import Annotated, Any

import jax
import numpy as np

from jaxdrones.arguments import Seconds, checked, choice, number
from jaxdrones.checks import check_shape
from jaxdrones.control import Setpoint
from jaxdrones.control.single import OneState
from jaxdrones.optimal.coordinates import tracking_error
from jaxdrones.optimal.interpreter import on_symbols
from jaxdrones.optimal.primitives import casadi
from jaxdrones.optimal.problem import Horizon, Weights, check_plan, checked_weights, reference, refuse_pwm
from jaxdrones.optimal.twin import CasadiModel
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.status import OnFailure, PlanningError, Status, is_finite

SOLVERS: dict[str, dict[str, Any]] = {
    "ipopt": {"ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-6, "max_iter": 100, "mu_init": 1e-3}},
    "fatrop": {"structure_detection": "auto", "fatrop": {"print_level": 0, "tol": 1e-6, "max_iter": 100}},
}
"""Nonlinear programming solvers of CasADi and their options.

Ipopt uses the Gauss-Newton Hessian; fatrop uses the exact one, and the structure in time.
"""

_LARGEST = 1e3  # m, m/s; solvers may never return from larger errors, or from more than half a turn in an interval
_INSIDE = 1e-6  # distance of the bounds from the limits of the motors, over the largest rotor speed if there is one


class Mpc:
    """Controller on the host, `mpc(state, setpoints) -> rpm`, warm-started with the last plan."""

    @checked
    def __init__(
        self,
        model: CasadiModel,
        dt: Seconds,
        horizon: Horizon = 20,
        weights: Weights | None = None,
        terminal: Annotated[float, number(at_least=0)] = 10.0,
        solver: Annotated[str, choice("solver", SOLVERS)] = "ipopt",
    ):
        """Build the nonlinear program and its solver.

        Args:
            model: of one drone.
            dt: control period, s: the length of an interval of the plan, with a constant command and one step of the
                classical Runge-Kutta method.
            horizon: intervals of the plan, at least two.
            weights: of the errors; by default `jaxdrones.optimal.weights()`.
            terminal: factor of the terminal weights of the state.
            solver: a name of `SOLVERS`.

        Raises:
            ValueError: a model of a team, a model whose commands are PWM, or an unknown solver.
        """
        refuse_pwm("model", model.takes_pwm)
        check_shape("model.params.mass", model.params.mass, (), "Mpc controls one drone; make one for each")
        self.model, self.horizon, self._dt = model, horizon, dt
        self.seconds = float("nan")
        """Duration of the last call of the solver, s."""
        self.status = Status.OK
        """Status of the last call."""
        self.message = "not called"
        """Message of the solver in its last call."""
        self._unit = float(model.params.hover_rpm)
        self._reference = jax.jit(lambda params, setpoints: reference(params, setpoints, model.start.aux, dt))
        self._kept = _moving(model)
        self._scale = np.array([self._unit if name.startswith("rpm") else 1.0 for name in model.names])[self._kept]
        self._plan: np.ndarray | None
        self.reset()
        self._write(dt, checked_weights(weights), terminal, solver)

    def _write(self, dt: float, weights: Weights, terminal: float, solver: str) -> None:
        model, n = self.model, len(self._kept)
        advance, error = self._step(dt), _error(model)
        q = np.diagonal(np.asarray(weights.state_matrix(error.size1_out(0)), float))
        r = np.diagonal(np.asarray(weights.command_matrix(), float))
        now = casadi.MX.sym("now", n)
        targets = casadi.MX.sym("targets", len(model.names), self.horizon + 1)
        nominal = casadi.MX.sym("nominal", 4, self.horizon)
        constants = casadi.MX.sym("constants", model.p.numel())
        rest = casadi.DM(model.vector(model.start))
        scale = casadi.DM(self._scale)
        variables, residuals, constraints = [], [], []
        states = [casadi.MX.sym(f"x{k}", n) for k in range(self.horizon + 1)]
        commands = [casadi.MX.sym(f"u{k}", 4) for k in range(self.horizon)]

        def whole(scaled: Any) -> Any:
            vector = casadi.MX(rest)
            vector[self._kept.tolist()] = scaled * scale
            return vector

        for k in range(self.horizon):
            variables += [states[k], commands[k]]
            constraints.append(states[k + 1] - advance(states[k], commands[k], constants))
            if k == 0:
                constraints.append(states[0] - now)
            u = commands[k] - nominal[:, k]
            z = error(whole(states[k + 1]), targets[:, k + 1])
            last = terminal if k + 1 == self.horizon else 1.0
            residuals += [np.sqrt(last * q) * z, np.sqrt(r) * u]
        variables.append(states[-1])
        x, residual, constraint = (casadi.vertcat(*parts) for parts in (variables, residuals, constraints))
        p = casadi.vertcat(now, casadi.vec(targets), casadi.vec(nominal), constants)
        program = {"x": x, "f": casadi.sumsqr(residual) / 2, "g": constraint, "p": p}
        options: dict[str, Any] = {"expand": True, "print_time": False, "error_on_fail": False, **SOLVERS[solver]}
        if solver == "ipopt":
            options["hess_lag"] = _gauss_newton(x, p, residual, constraint)
        else:
            options["equality"] = [True] * constraint.numel()
        self._solver = casadi.nlpsol("mpc", solver, program, options)
        limit = float(model.params.max_rpm) / self._unit
        # Solvers relax bounds a little, and beyond the motor limits the model is independent of the commands.
        margin = _INSIDE * (limit if np.isfinite(limit) else 1)
        free, bounded = np.full(n, np.inf), [np.full(4, margin), np.full(4, limit - margin)]
        self._low = np.concatenate([*[-free, bounded[0]] * self.horizon, -free])
        self._high = np.concatenate([*[free, bounded[1]] * self.horizon, free])

    def _step(self, dt: float) -> Any:
        """One interval: scaled state, scaled command and constants -> scaled state."""
        model, n = self.model, len(self._kept)
        x, u = casadi.SX.sym("x", n), casadi.SX.sym("u", 4)
        scale, kept = casadi.DM(self._scale), self._kept.tolist()

        def rate(x: Any) -> Any:
            vector = casadi.SX(casadi.DM(model.vector(model.start)))
            vector[kept] = x * scale
            arguments = [vector, u * self._unit, *([model.p] if model.parameter_names else [])]
            return model.function(*arguments)[kept] / scale

        k1 = rate(x)
        k2 = rate(x + dt / 2 * k1)
        k3 = rate(x + dt / 2 * k2)
        k4 = rate(x + dt * k3)
        return casadi.Function("advance", [x, u, model.p], [x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])

    @checked
    def __call__(
        self, state: OneState, setpoints: Setpoint, params: Params | None = None, *, on_failure: OnFailure = "hold"
    ) -> np.ndarray:
        """Commanded rotor speeds of one drone, (4,) RPM, between 0 and `max_rpm`.

        The setpoints are those at the current and the next H control steps, arrays (H + 1, ...). `params` are the
        values of the model's symbolic constants, by default those of the model. Without a new plan, `hold` repeats
        the last safe command, initially that of hover, and `raise` raises. See `status` and `message`.

        Raises:
            ValueError: arrays of a team, or a wrong number of setpoints.
            PlanningError: there is no new plan, and `on_failure` is `raise`.
        """
        n = len(self._kept)
        check_plan(self.horizon, setpoints, on_failure=on_failure, given=(params, state))
        if self._is_flyable(state, setpoints):
            self._plan = self._solved(state, setpoints, params)
            self.status = Status.NOT_CONVERGED if self._plan is None else Status.OK
        else:
            self._plan, self.status, self.message = None, Status.INVALID_STATE, "not called"
        if self._plan is not None:
            self._held = np.clip(self._plan[n : n + 4], self._low[n : n + 4], self._high[n : n + 4]) * self._unit
        elif on_failure == "raise":
            raise PlanningError(self.status, f"mpc, {self.message}")
        return self._held.copy()

    def _is_flyable(self, state: State, setpoints: Setpoint) -> bool:
        """Whether all values are finite, and errors, velocities and turns in an interval small enough for a solver."""
        *sizes, omega = jax.device_get((state.pos[None] - setpoints.pos, state.vel, state.omega))
        small = max(np.abs(x).max() for x in sizes) <= _LARGEST and np.linalg.norm(omega) * self._dt <= np.pi
        return bool(small and is_finite((state, setpoints)))

    def _solved(self, state: State, setpoints: Setpoint, params: Params | None) -> np.ndarray | None:
        """Concatenated states and commands of the plan; `None` without convergence."""
        model = self.model
        params = model.params if params is None else params
        target = jax.device_get(self._reference(model.with_parameters(params), setpoints))
        rows = [jax.tree.map(lambda x, k=k: x[k], target) for k in range(self.horizon + 1)]
        targets = np.stack([model.vector(row.state) for row in rows])
        nominal = np.stack([row.rpm for row in rows[:-1]]) / self._unit
        now = model.vector(state)[self._kept] / self._scale
        constants = model.parameters(params)
        start = time.perf_counter()
        result = self._solver(
            x0=self._guess(now, targets, nominal),
            p=np.concatenate([now, targets.ravel(), nominal.ravel(), constants]),
            lbx=self._low,
            ubx=self._high,
            lbg=0,
            ubg=0,
        )
        self.seconds = time.perf_counter() - start
        said = self._solver.stats()
        self.message = str(said["return_status"])
        plan = np.asarray(result["x"]).ravel()
        return plan if said["success"] and np.isfinite(plan).all() else None

    def _guess(self, now: np.ndarray, targets: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        """Last plan, shifted by one interval; at first the reference."""
        n = len(self._kept)
        if self._plan is None:
            states = targets[:, self._kept] / self._scale[None]
            states[0] = now
            pairs = np.concatenate([states[:-1], nominal], axis=1)
            return np.concatenate([pairs.ravel(), states[-1]])
        return np.concatenate([self._plan[n + 4 :], self._plan[-n - 4 :]])

    def reset(self) -> None:
        """Clear the last plan and command, before another flight."""
        self._plan = None
        self._held = np.full(4, min(self._unit, float(self.model.params.max_rpm)))


def _moving(model: CasadiModel) -> np.ndarray:
    """Indices of the dynamic entries of the state, without the speeds of rotors without a lag."""
    sparsity = casadi.jacobian_sparsity(model.xdot, model.x)
    acts = {int(column) for column in sparsity.get_triplet()[1]}
    return np.array([i for i in range(model.x.numel()) if i in acts or not model.xdot[i].is_zero()])


def _error(model: CasadiModel) -> Any:
    """Tracking error of `jaxdrones.optimal`, as a function of two vectors."""

    def error(state: State, target: State) -> Any:
        return tracking_error(model.params, state, target)

    symbols, z = on_symbols(error, x=model.start, target=model.start)
    return casadi.Function("error", symbols, [z])


def _gauss_newton(x: Any, p: Any, residual: Any, constraint: Any) -> Any:
    """Gauss-Newton Hessian of half a sum of squares, without the constraints.

    It is accurate near the targets, positive semidefinite, and an order of magnitude cheaper than the exact one.
    """
    weight, multipliers = casadi.MX.sym("lam_f"), casadi.MX.sym("lam_g", constraint.numel())
    jacobian = casadi.jacobian(residual, x)
    hessian = casadi.triu(weight * casadi.mtimes(jacobian.T, jacobian))
    names = ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"]
    return casadi.Function("nlp_hess_l", [x, p, weight, multipliers], [hessian], *names).expand()
