"""Model predictive path integral control with feedback.

Williams et al. 2017, "Information theoretic MPC for model-based reinforcement learning": the samples are weighted by
exp(-cost / temperature). Every sample is simulated with the regulator's feedback, so the samples are corrections of a
stable flight, not rotor speeds of an unstable body (as in tube-based MPPI, Williams et al. 2018). The temperature is
relative to the spread of the costs above the lowest one, and the cost of the noise itself is left out.
"""

from typing import Annotated, Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.arguments import Count, checked, number
from jaxdrones.control import Setpoint
from jaxdrones.control.allocation import mixer
from jaxdrones.control.single import OneParams, OneState
from jaxdrones.optimal import lqr
from jaxdrones.optimal.coordinates import command_unit, single, tracking_error
from jaxdrones.optimal.problem import Horizon, Reference, Weights, checked_step, checked_weights, hover, posed
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State
from jaxdrones.status import OnFailure, Status, is_finite, raise_unless_ok, status_of


class Settings(lqr.Settings, kw_only=True):
    """Model, weights, horizon (H, planned control steps) and sampling of the planner."""

    noise: Array
    """(4,) standard deviation of sampled commands in collective, roll, pitch and yaw, over the hover speed."""
    temperature: Array
    """() over the root mean square of the samples' costs above the lowest one."""
    samples: int = flax.struct.field(pytree_node=False)
    """Samples per call of `control`."""
    hold: int = flax.struct.field(pytree_node=False)
    """Control steps between samples of the noise."""


class Memory(PyTreeNode):
    """State of the planner between calls."""

    key: Array
    """Random key of the next call."""
    correction: Array
    """(H, 4) planned corrections of the feedback's commands, over the rotor speed of hover."""
    lqr: lqr.Memory
    """Regulator about hover, for feedback and terminal cost."""
    rpm: Array
    """(4,) last safe command, RPM; initially that of hover."""
    status: Array
    """() `Status` of the last call, an integer."""


@checked
def settings(
    step: Any,
    weights: Weights | None = None,
    horizon: Horizon = 24,
    samples: Count = 256,
    temperature: Annotated[float, number(at_least=0)] = 0.3,
    hold: Count = 3,
) -> Settings:
    """Settings of a planner, with the weights of the errors, by default `problem.weights()`.

    The terminal cost after `horizon` control steps, at least two, is that of the regulator of `lqr`. The temperature is
    over the root mean square of the costs of the samples above the lowest one; a lower value favors the best sample.
    `hold` control steps lie between samples of the noise: noise at every step hardly moves a drone.
    """
    return Settings(
        checked_weights(weights),
        checked_step(step),
        horizon,
        noise=jnp.array([0.05, 0.02, 0.02, 0.02]),
        temperature=jnp.asarray(temperature, float),
        samples=samples,
        hold=hold,
    )


def init(settings: Settings, params: Params, state: State, key: Array) -> Memory:
    """Memory of one drone with such models before its first call; every drone has its own random key."""
    regulator = lqr.init(settings, params, state)
    always = jnp.ones((), bool)
    correction = jnp.zeros((settings.horizon, 4), regulator.gain.dtype)
    return Memory(key, correction, regulator, hover(params, state).rpm, status_of(always, always))


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
    """Rotor speeds of one drone, RPM, between 0 and `max_rpm`: the first command of the averaged plan.

    See `jaxdrones.optimal` for arguments and errors.
    """
    valid, state, target = posed(settings, params, memory, state, setpoints, dt, on_failure)
    next_key, noise_key = jax.random.split(memory.key)
    guess = jnp.concatenate([memory.correction[1:], memory.correction[-1:]])
    plans = guess[None] + _noise(noise_key, settings, params, guess)
    plans = plans.at[0].set(guess).at[1].set(0)
    costs = jax.vmap(lambda plan: cost(settings, params, state, target, plan, memory.lqr))(plans)
    plan = jnp.tensordot(importance(costs, settings.temperature), plans, 1)
    status = status_of(valid, jnp.any(jnp.isfinite(costs)) & is_finite(plan))
    plan = jnp.where(status == Status.OK, plan, 0)  # the next call starts without a plan
    now = jax.tree.map(lambda x: x[0], target)
    rpm = now.rpm + command_unit(params) * plan[0]
    command = lqr.feedback(params, memory.lqr.gain, state, now.state, rpm)
    command = jnp.where(status == Status.OK, command, memory.rpm)
    if on_failure == "raise":
        raise_unless_ok(status, "mppi")
    return memory.replace(key=next_key, correction=plan, rpm=command, status=status), command


def importance(costs: Float[Array, " k"], temperature: Float[Array, ""]) -> Float[Array, " k"]:
    """Weights of the samples, exp(-cost / (temperature x spread)) up to a factor that makes their sum one.

    The spread is the root mean square of the finite costs above the lowest one. A sample with a cost that is not finite
    has weight zero; without any finite cost all weights are equal.
    """
    finite = jnp.isfinite(costs)
    lowest = jnp.min(jnp.where(finite, costs, jnp.inf))
    above = jnp.where(finite, jnp.where(finite, costs, 0) - lowest, 0)
    spread = jnp.sqrt(jnp.sum(above**2) / jnp.maximum(jnp.sum(finite), 1))
    scaled = above / jnp.maximum(temperature * spread, jnp.finfo(costs.dtype).tiny)
    return jax.nn.softmax(jnp.where(finite | ~jnp.any(finite), -scaled, -jnp.inf))


def cost(
    settings: Settings,
    params: Params,
    state: State,
    target: Reference,
    plan: Float[Array, "H 4"],
    regulator: lqr.Memory,
) -> Float[Array, ""]:
    """Cost of a flight over the horizon with the regulator's feedback and the corrections of a plan."""
    step, unit = single(settings.step), command_unit(params)
    q = settings.weights.state_matrix(len(regulator.value))
    r = settings.weights.command_matrix()

    def advance(now: State, given: tuple) -> tuple[State, Array]:
        correction, here, ahead = given
        rpm = lqr.feedback(params, regulator.gain, now, here.state, here.rpm + unit * correction)
        after = step(params, now, rpm)
        z, u = tracking_error(params, after, ahead), (rpm - here.rpm) / unit
        return after, (z @ (q @ z) + u @ (r @ u)) / 2

    here = jax.tree.map(lambda x: x[:-1], target)
    ahead = jax.tree.map(lambda x: x[1:], target.state)
    end, costs = jax.lax.scan(advance, state, (plan, here, ahead))
    z = tracking_error(params, end, jax.tree.map(lambda x: x[-1], ahead))
    return jnp.sum(costs) + z @ (regulator.value @ z) / 2


def _noise(key: Array, settings: Settings, params: Params, like: Float[Array, "H 4"]) -> Float[Array, "k H 4"]:
    knots = -(-settings.horizon // settings.hold)
    drawn = jax.random.normal(key, (settings.samples, knots, 4), like.dtype) * settings.noise[None, None]
    held = jnp.repeat(drawn, settings.hold, axis=1)[:, : settings.horizon]
    mixing = jnp.concatenate([jnp.ones((4, 1), like.dtype), mixer(params)], axis=1)
    return held @ mixing.T
