"""Linear quadratic regulator about hover with feedforward of the target's motion."""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.arguments import checked
from jaxdrones.control import Setpoint
from jaxdrones.control.single import OneParams, OneState
from jaxdrones.dynamics.rotors import limited
from jaxdrones.optimal.coordinates import command_unit, feedback_error, linearize_step, of_point_masses, single
from jaxdrones.optimal.problem import Weights, checked_step, checked_weights, hover, posed
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State
from jaxdrones.status import OnFailure, Status, is_finite, raise_unless_ok, status_of
from jaxdrones.vector import safe_sqrt

_DOUBLINGS = 20  # a million control steps
_TILT = 0.6  # largest tilt that errors of position and velocity ask for, rad
_LIFT = 0.3  # largest change of the rotor speeds that they ask for, over that of hover


class Settings(PyTreeNode):
    """Model and weights of the regulator."""

    weights: Weights
    step: Any = flax.struct.field(pytree_node=False)
    """Step of a team, `(params, state, rpm) -> state`, over one control period."""
    horizon: int = flax.struct.field(pytree_node=False, default=2)
    """H, future setpoints of `control`; here two, for the angular acceleration of the target."""


class Memory(PyTreeNode):
    """Solution of the regulator's problem, a function of the drone alone."""

    gain: Array
    """(4, d) K of u = -K z, z a `feedback_error`."""
    value: Array
    """(d, d) P of the cost to go, z P z / 2."""
    rpm: Array
    """(4,) last command, RPM."""
    status: Array
    """() `Status` of the last command."""


def settings(step: Any, weights: Weights | None = None) -> Settings:
    """Settings of a regulator, with the weights of the errors, by default `problem.weights()`."""
    return Settings(checked_weights(weights), checked_step(step))


def init(settings: Settings, params: Params, state: State) -> Memory:
    """Regulator of one drone with such models: linearization about hover, and solution of its Riccati equation."""
    at_rest = hover(params, state)
    a, b = linearize_step(single(settings.step), params, at_rest, at_rest.rpm)
    q, r = settings.weights.state_matrix(len(a)), settings.weights.command_matrix()
    value = riccati(a, b, q, r)
    always = jnp.ones((), bool)
    return Memory(gain(a, b, r, value), value, at_rest.rpm, status_of(always, always))


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
    """Rotor speeds of one drone, RPM, between 0 and `max_rpm`, with three setpoints; see `jaxdrones.optimal`."""
    valid, state, target = posed(settings, params, memory, state, setpoints, dt, on_failure)
    rpm = feedback(params, memory.gain, state, jax.tree.map(lambda x: x[0], target.state), target.rpm[0])
    status = status_of(valid, is_finite(rpm))
    command = jnp.where(status == Status.OK, rpm, memory.rpm)
    if on_failure == "raise":
        raise_unless_ok(status, "lqr")
    return memory.replace(rpm=command, status=status), command


def feedback(
    params: Params, gain: Float[Array, "4 d"], state: State, target: State, rpm: Float[Array, "4"]
) -> Float[Array, "4"]:
    """Command of a reference with feedback of the tracking error, limited, RPM.

    The gain holds near the reference. From afar, the drone approaches at a speed that it can brake, and errors of
    position and velocity ask for at most `_TILT` and `_LIFT`, which leaves the attitude its share of the rotor speeds.
    """
    error = feedback_error(params, state, _on_the_way(params, gain, state, target))
    moved = error.at[3:6].set(0).at[9:16].set(0)  # without attitude, angular velocity and rotor speeds
    translation, rotation = gain @ moved, gain @ (error - moved)
    collective = jnp.mean(translation)
    lateral = translation - collective
    lift = _LIFT * (1 + jnp.sum(gain[:, 12:16]) / 4)  # rotors with a lag also feed their speeds back
    most = _TILT * _length(gain[:, 3])
    lateral = lateral * most / jnp.maximum(jnp.maximum(most, _length(lateral)), jnp.finfo(most.dtype).tiny)
    return limited(params, rpm - command_unit(params) * (rotation + lateral + jnp.clip(collective, -lift, lift)))


def _on_the_way(params: Params, gain: Float[Array, "4 d"], state: State, target: State) -> State:
    """Reference whose position is moved towards a drone that is far away.

    The gain asks for a speed that is proportional to the distance. It is limited to one from which half of the
    acceleration of `_TILT` or `_LIFT` stops the drone at the target (ArduPilot's square-root controller).
    """
    away = state.pos - target.pos

    def near(axes: slice, acc: Array) -> Array:
        slowed = jnp.maximum(_length(gain[:, 6:9][:, axes]), jnp.finfo(gain.dtype).tiny)
        rate = _length(gain[:, axes]) / slowed  # speed over distance, 1/s
        x = acc / jnp.maximum(acc, rate**2 * _length(away[axes]))
        return away[axes] * (1 - jnp.sqrt(x * (2 - x)))

    shift = jnp.concatenate([near(slice(2), _TILT * params.gravity / 2), near(slice(2, 3), _LIFT * params.gravity)])
    aux = of_point_masses(lambda load: load.replace(pos=load.pos + shift), target.aux)
    return target.replace(pos=target.pos + shift, aux=aux)


def _length(x: Array) -> Float[Array, ""]:
    return safe_sqrt(jnp.sum(x**2))


def gain(
    a: Float[Array, "d d"], b: Float[Array, "d m"], r: Float[Array, "m m"], value: Float[Array, "d d"]
) -> Float[Array, "m d"]:
    """Gain K of u = -K z that minimizes u R u + z' P z', with z' = A z + B u."""
    return jnp.linalg.solve(r + b.T @ value @ b, b.T @ value @ a)


def riccati(
    a: Float[Array, "d d"], b: Float[Array, "d m"], q: Float[Array, "d d"], r: Float[Array, "m m"]
) -> Float[Array, "d d"]:
    """Stabilizing solution P of the discrete algebraic Riccati equation for z' = A z + B u, weights Q and R.

    P = Q + A' P A - A' P B (R + B' P B)^-1 B' P A, by the structure-preserving doubling algorithm (Chu, Fan, Lin, Wang
    2004): iteration k has the cost of 2^k steps, so it converges quadratically.
    """
    eye = jnp.eye(len(a), dtype=a.dtype)

    def double(carry: tuple, _: None) -> tuple[tuple, None]:
        a, g, h = carry
        inverse = jnp.linalg.solve(eye + g @ h, jnp.concatenate([a, g], axis=1))
        wa, wg = inverse[:, : len(a)], inverse[:, len(a) :]
        g_after = g + a @ wg @ a.T
        h_after = h + a.T @ h @ wa
        return (a @ wa, (g_after + g_after.T) / 2, (h_after + h_after.T) / 2), None

    start = (a, b @ jnp.linalg.solve(r, b.T), q)
    return jax.lax.scan(double, start, length=_DOUBLINGS)[0][2]
