"""Iterative LQR with the simulator's step and motor limits as bounds (control-limited DDP).

Tassa, Mansard, Todorov 2014, "Control-limited differential dynamic programming", with Gauss-Newton Hessians: second
derivatives of the dynamics are neglected, as in iLQR (Li, Todorov 2004). Attitudes are in the tangent space.
"""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdrones.arguments import Count, checked
from jaxdrones.control import Setpoint
from jaxdrones.control.single import OneParams, OneState
from jaxdrones.optimal import lqr
from jaxdrones.optimal.coordinates import command_unit, difference, displaced, linearize_step, single, tracking_error
from jaxdrones.optimal.problem import Horizon, Reference, Weights, checked_step, checked_weights, hover, posed
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State
from jaxdrones.status import OnFailure, Status, is_finite, raise_unless_ok, status_of

_STEP_SIZES = tuple(0.5**k for k in range(8))  # of the line search
_QP_ITERATIONS, _QP_STEP_SIZES = 6, tuple(0.4**k for k in range(6))
_MIN_REGULARIZATION, _MAX_REGULARIZATION = 1e-6, 1e6
_LESS, _MORE = 0.2, 10.0  # factors of the regularization after an iteration with and without an improvement


class Settings(lqr.Settings, kw_only=True):
    """Model, weights, horizon (H, planned control steps) and iterations of the planner."""

    iterations: int = flax.struct.field(pytree_node=False)
    """Iterations per call of `control`."""


class Memory(PyTreeNode):
    """State of the planner between calls."""

    correction: Array
    """(H, 4) planned commands minus those of the reference, over the rotor speed of hover."""
    lqr: lqr.Memory
    """Regulator about hover, for the terminal cost and the first guess."""
    started: Array
    """() whether there is a plan of the previous call."""
    rpm: Array
    """(4,) last safe command, RPM; initially that of hover."""
    status: Array
    """() `Status` of the last call, an integer."""


class Solution(PyTreeNode):
    """Plan of H steps."""

    states: State
    """(H + 1, ...) states, the present one first."""
    rpm: Array
    """(H, 4) commands, RPM."""
    gains: Array
    """(H, 4, d) of u = K z, z the `difference` from the planned state, u over the rotor speed of hover."""
    cost: Array
    """()."""
    costs: Array
    """(iterations,) cost after each iteration, never increasing."""


@checked
def settings(step: Any, weights: Weights | None = None, horizon: Horizon = 25, iterations: Count = 2) -> Settings:
    """Settings of a planner, with the weights of the errors, by default `problem.weights()`.

    The terminal cost after `horizon` control steps, at least two, is that of the regulator of `lqr`. The `iterations`
    of a call of `control` start from the previous plan.
    """
    return Settings(checked_weights(weights), checked_step(step), horizon, iterations=iterations)


def init(settings: Settings, params: Params, state: State) -> Memory:
    """Memory of one drone before its first call."""
    regulator = lqr.init(settings, params, state)
    always = jnp.ones((), bool)
    correction = jnp.zeros((settings.horizon, 4), regulator.gain.dtype)
    return Memory(correction, regulator, jnp.zeros((), bool), hover(params, state).rpm, status_of(always, always))


@checked
def control(
    settings: Settings,
    params: OneParams,
    memory: Memory,
    state: OneState,
    setpoints: Setpoint,
    *,
    dt: float,
    on_failure: OnFailure = "hold",
) -> tuple[Memory, Float[Array, "4"]]:
    """Rotor speeds of one drone, RPM, between 0 and `max_rpm`: the first command of a plan over the horizon.

    The guess is the previous plan, shifted by one step, and at first a flight with the regulator of `lqr`. See
    `jaxdrones.optimal` for arguments and errors.
    """
    valid, state, target = posed(settings, params, memory, state, setpoints, dt, on_failure)
    unit = command_unit(params)

    def kept() -> Array:
        shifted = jnp.concatenate([memory.correction[1:], memory.correction[-1:]])
        return target.rpm[:-1] + unit * shifted

    guess = jax.lax.cond(memory.started, kept, lambda: regulated(settings.step, params, state, target, memory.lqr.gain))
    plan = solve(settings, params, state, target, guess, memory.lqr.value)
    status = status_of(valid, is_finite((plan.cost, plan.rpm)))
    solved = status == Status.OK
    correction = jnp.where(solved, (plan.rpm - target.rpm[:-1]) / unit, 0)
    command = jnp.where(solved, plan.rpm[0], memory.rpm)
    if on_failure == "raise":
        raise_unless_ok(status, "ilqr")
    return memory.replace(correction=correction, started=solved, rpm=command, status=status), command


def regulated(
    step: Any, params: Params, state: State, target: Reference, gain: Float[Array, "4 d"]
) -> Float[Array, "H 4"]:
    """Commands of a flight with the regulator, RPM."""
    one_step = single(step)

    def advance(state: State, target: Reference) -> tuple[State, Array]:
        rpm = lqr.feedback(params, gain, state, target.state, target.rpm)
        return one_step(params, state, rpm), rpm

    return jax.lax.scan(advance, state, jax.tree.map(lambda x: x[:-1], target))[1]


def solve(
    settings: Settings,
    params: Params,
    state: State,
    target: Reference,
    rpm: Float[Array, "H 4"],
    value: Float[Array, "d d"],
) -> Solution:
    """Improve a guess (H, 4) (RPM) by some iterations; return the best plan.

    The target is H + 1 states and commands to track, and `value` (d, d) the weight of the tracking error at the end.
    """
    step, unit = single(settings.step), command_unit(params)
    high = params.max_rpm / unit
    sizes = jnp.asarray(_STEP_SIZES, rpm.dtype)
    r = settings.weights.command_matrix()
    nominal = target.rpm[:-1] / unit
    ahead = jax.tree.map(lambda x: x[1:], target.state)
    q = settings.weights.state_matrix(len(value))
    matrices = jnp.concatenate([jnp.broadcast_to(q, (len(rpm) - 1, *q.shape)), value[None]])

    def fly(commands: Array, states: State | None, gains: Array | None) -> tuple[State, Array, Array]:
        """States after every step, commands, and cost, with feedback about the states of another flight."""

        def advance(now: State, given: tuple) -> tuple[State, tuple]:
            command, planned, gain, wanted, nominal, matrix = given
            if planned is not None:
                command = command + gain @ difference(params, now, planned)
            command = jnp.clip(command, 0, high)
            after = step(params, now, unit * command)
            z, u = tracking_error(params, after, wanted), command - nominal
            return after, (after, command, (z @ (matrix @ z) + u @ (r @ u)) / 2)

        _, (after, flown, costs) = jax.lax.scan(advance, state, (commands, states, gains, ahead, nominal, matrices))
        return after, flown, jnp.sum(costs)

    def before(after: State) -> State:
        return jax.tree.map(lambda first, x: jnp.concatenate([jnp.asarray(first)[None], x[:-1]]), state, after)

    def improve(carry: tuple, _: None) -> tuple[tuple, Array]:
        after, commands, cost, gains, regularization = carry
        start = before(after)
        models = jax.vmap(lambda x, u: linearize_step(step, params, x, unit * u))(start, commands)
        slopes, curvatures = jax.vmap(lambda x, wanted, m: _expanded(params, x, wanted, m))(after, ahead, matrices)
        changes, new_gains = _backward((*models, slopes, curvatures, commands, nominal), r, high, regularization)
        tried = jax.vmap(lambda size: fly(commands + size * changes, start, new_gains))(sizes)
        costs = jnp.where(jnp.isfinite(tried[2]), tried[2], jnp.inf)
        best = jnp.argmin(costs)
        better = costs[best] < cost
        new = (*jax.tree.map(lambda x: x[best], tried), new_gains)
        old = (after, commands, cost, gains)
        chosen = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old)
        factor = jnp.where(better, _LESS, _MORE)
        regularization = jnp.clip(regularization * factor, _MIN_REGULARIZATION, _MAX_REGULARIZATION)
        return (*chosen, regularization), chosen[2]

    after, commands, cost = fly(rpm / unit, None, None)
    cost = jnp.where(jnp.isfinite(cost), cost, jnp.inf)
    gains = jnp.zeros((*rpm.shape, len(value)), rpm.dtype)
    regularization = jnp.asarray(_MIN_REGULARIZATION, rpm.dtype)
    (after, commands, cost, gains, _), costs = jax.lax.scan(
        improve, (after, commands, cost, gains, regularization), length=settings.iterations
    )
    states = jax.tree.map(lambda first, x: jnp.concatenate([jnp.asarray(first)[None], x]), state, after)
    return Solution(states, unit * commands, gains, cost, costs)


def _expanded(
    params: Params, state: State, wanted: State, matrix: Float[Array, "d d"]
) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
    """Gradient and Gauss-Newton Hessian of the cost of a state with respect to its `difference`."""

    def error(z: Array) -> Array:
        return tracking_error(params, displaced(params, state, z), wanted)

    zero = jnp.zeros(len(matrix), matrix.dtype)
    z, jacobian = error(zero), jax.jacfwd(error)(zero)
    return jacobian.T @ (matrix @ z), jacobian.T @ matrix @ jacobian


def _backward(
    models: tuple, r: Float[Array, "4 4"], high: Float[Array, ""], regularization: Float[Array, ""]
) -> tuple[Float[Array, "H 4"], Float[Array, "H 4 d"]]:
    """Changes of the commands, and the gains about them: the backward pass with box-constrained steps."""
    eye = jnp.eye(4, dtype=r.dtype)

    def backward(carry: tuple, given: tuple) -> tuple[tuple, tuple]:
        slope, curvature = carry
        a, b, own_slope, own_curvature, command, nominal = given
        slope, curvature = slope + own_slope, curvature + own_curvature
        q_u = r @ (command - nominal) + b.T @ slope
        q_uu, q_ux = r + b.T @ curvature @ b, b.T @ curvature @ a
        damped = q_uu + regularization * eye
        change, free = box_qp(damped, q_u, -command, high - command)
        gain = -solve_free(damped, q_ux, free)
        slope = a.T @ slope + gain.T @ (q_uu @ change + q_u) + q_ux.T @ change
        curvature = a.T @ curvature @ a + gain.T @ q_uu @ gain + gain.T @ q_ux + q_ux.T @ gain
        return (slope, (curvature + curvature.T) / 2), (change, gain)

    size = models[0].shape[-1]
    end = (jnp.zeros(size, r.dtype), jnp.zeros((size, size), r.dtype))
    return jax.lax.scan(backward, end, models, reverse=True)[1]


def box_qp(
    hessian: Float[Array, "m m"], gradient: Float[Array, " m"], low: Float[Array, " m"], high: Float[Array, " m"]
) -> tuple[Float[Array, " m"], Bool[Array, " m"]]:
    """Minimize x H x / 2 + g x between bounds, by projected Newton steps (Tassa, Mansard, Todorov 2014, algorithm 1).

    H is symmetric and positive. Return the minimizer (m,), and the mask of its free components, between their bounds.
    """
    sizes = jnp.asarray(_QP_STEP_SIZES, gradient.dtype)

    def cost(x: Array) -> Array:
        return x @ (hessian @ x) / 2 + gradient @ x

    def free_at(x: Array) -> tuple[Array, Array]:
        slope = gradient + hessian @ x
        return slope, ~(((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0)))

    def newton(x: Array, _: None) -> tuple[Array, None]:
        slope, free = free_at(x)
        step = -solve_free(hessian, slope, free)
        tried = jax.vmap(lambda size: jnp.clip(x + size * step, low, high))(sizes)
        costs = jax.vmap(cost)(tried)
        best = jnp.argmin(costs)
        return jnp.where(costs[best] < cost(x), tried[best], x), None

    x, _ = jax.lax.scan(newton, jnp.clip(jnp.zeros_like(gradient), low, high), length=_QP_ITERATIONS)
    return x, free_at(x)[1]


def solve_free(hessian: Float[Array, "m m"], right: Float[Array, "m *n"], free: Bool[Array, " m"]) -> Array:
    """Solution of H x = right in the free components, zero in the others."""
    both = free[:, None] & free[None, :]
    part = jnp.where(both, hessian, jnp.eye(len(hessian), dtype=hessian.dtype))
    return jnp.linalg.solve(part, jnp.where(free.reshape(-1, *[1] * (right.ndim - 1)), right, 0))
