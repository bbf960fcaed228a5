"""Integrators `(derivative, state, dt) -> state` of one world; arrays have a leading drone axis.

A derivative has the type of its state, so a step is `x + dt k` leaf by leaf. Only the quaternion is special:
it is normalized, or rotated by the exponential of a rotation vector.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.dynamics.model import PointMass
from jaxdrones.state import State

Derivative = Callable[[State], State]
Integrator = Callable[[Derivative, State, float], State]

_MIDPOINT_ITERATIONS = 8
_MAX_TURN = math.pi / 2  # rad about an axis in a step; Bullet's limit of the angle


def euler(derivative: Derivative, state: State, dt: float) -> State:
    """Explicit Euler, order 1."""
    return _normalized(_add(state, dt, derivative(state)))


def semi_implicit_euler(derivative: Derivative, state: State, dt: float) -> State:
    """Semi-implicit Euler, order 1: velocities first, then poses with the new velocities.

    The attitude is rotated by the exponential map. The order of operations is that of gym-pybullet-drones. The explicit
    gyroscopic term gains energy in a tumble (docs/physics.md), so use another integrator above a few rad/s. The new
    body rates are at most a quarter turn per step, which keeps the fastest tumble finite.
    """
    state = _normalized(state)  # the exponential map keeps the length only up to rounding
    after = _add(state, dt, derivative(state))
    after = after.replace(omega=jnp.clip(after.omega, -_MAX_TURN / dt, _MAX_TURN / dt))
    pos, quat = state.pos + dt * after.vel, jax.vmap(_turn)(state.quat, dt * after.omega)
    return after.replace(pos=pos, quat=quat, aux=_moved(state.aux, after.aux, dt))


def midpoint(derivative: Derivative, state: State, dt: float) -> State:
    """Explicit midpoint rule, order 2, on the whole state, with one normalization per step."""
    halfway = _add(state, dt / 2, derivative(state))
    return _normalized(_add(state, dt, derivative(halfway)))


def rk4(derivative: Derivative, state: State, dt: float) -> State:
    """Classical Runge-Kutta method, order 4, on the whole state, with one normalization per step."""
    k1 = derivative(state)
    k2 = derivative(_add(state, dt / 2, k1))
    k3 = derivative(_add(state, dt / 2, k2))
    k4 = derivative(_add(state, dt, k3))
    mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
    return _normalized(_add(state, dt, mean))


def implicit_midpoint(derivative: Derivative, state: State, dt: float) -> State:
    """Implicit midpoint rule x + dt f((x + x')/2), order 2.

    It conserves quadratic invariants, so a tumbling body neither gains nor loses energy. The equation is solved by
    eight fixed-point iterations; each reduces the error by a factor of about |omega| dt / 2.
    """

    def iterate(rate: State, _: None) -> tuple[State, None]:
        return derivative(_add(state, dt / 2, rate)), None

    rate, _ = jax.lax.scan(iterate, derivative(state), length=_MIDPOINT_ITERATIONS)
    return _normalized(_add(state, dt, rate))


def models_after(aux: dict[str, Any], rate: dict[str, Any], dt: float) -> dict[str, Any]:
    """States of models by name after a semi-implicit Euler step of `dt` (s), from their time derivatives."""
    return _moved(aux, jax.tree.map(lambda x, k: x + dt * k, aux, rate), dt)


def _moved(before: dict[str, Any], after: dict[str, Any], dt: float) -> dict[str, Any]:
    """States of models after an explicit Euler step, with point masses moved by their new velocity."""
    return {
        name: x.replace(pos=before[name].pos + dt * x.vel) if isinstance(x, PointMass) else x
        for name, x in after.items()
    }


def _add(state: State, dt: float, rate: State) -> State:
    return jax.tree.map(lambda x, k: x + dt * k, state, rate)


def _normalized(state: State) -> State:
    return state.replace(quat=jax.vmap(rotation.normalize)(state.quat))


def _turn(quat: Float[Array, "4"], rotation_vector: Float[Array, "3"]) -> Float[Array, "4"]:
    """Attitude after a rotation about body axes, q exp(v)."""
    return rotation.multiply(quat, rotation.exp_half_turn(rotation_vector))
