"""Control of collective thrust and body rates in an outer and an inner loop."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation, vector
from jaxdrones.arguments import checked
from jaxdrones.control.allocation import rpm_from_wrench
from jaxdrones.control.setpoint import Setpoint
from jaxdrones.control.single import Finite, OneParams, OneSetpoint, OneState
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State
from jaxdrones.vector import sin_cos


class Gains(PyTreeNode):
    """Gains of the outer loop (those of gym-pybullet-drones for its racer) and of the inner one."""

    pos: Array
    """(3,) 1/s^2."""
    vel: Array
    """(3,) 1/s."""
    attitude: Array
    """(3,) rad/s per half radian of error."""
    rate: Array
    """(3,) 1/s."""


def gains() -> Gains:
    """Gains of gym-pybullet-drones for the outer loop; the inner loop has 40 rad/s in roll and pitch, 15 in yaw."""
    return Gains(
        pos=jnp.array([3.0, 3.0, 8.0]),
        vel=jnp.array([2.5, 2.5, 5.0]),
        attitude=jnp.array([5.0, 5.0, 1.0]),
        rate=jnp.array([40.0, 40.0, 15.0]),
    )


def init() -> None:
    """Empty memory."""


def control(
    gains: Gains, params: Params, memory: Any, state: State, setpoint: Setpoint, *, dt: float
) -> tuple[Any, Float[Array, "4"]]:
    """Rotor speeds of one drone by both loops, RPM, up to `max_rpm`.

    Of the setpoint, pos, vel, acc and yaw are used, omega is not. See `jaxdrones.control`.
    """
    collective, omega = command(gains, params, state, setpoint)
    return memory, follow(gains, params, state, collective, omega)


@checked
def command(
    gains: Finite[Gains], params: OneParams, state: OneState, setpoint: OneSetpoint
) -> tuple[Float[Array, ""], Float[Array, "3"]]:
    """Outer loop: collective thrust per mass (m/s^2, body z) and body rates (rad/s) towards a setpoint."""
    acc = setpoint.acc + gains.pos * (setpoint.pos - state.pos) + gains.vel * (setpoint.vel - state.vel)
    acc = acc + vector.along_z(params.gravity)
    collective = vector.dot(acc, rotation.z_axis(state.quat))

    sin, cos = sin_cos(setpoint.yaw)
    left = jnp.stack([-sin, cos, jnp.zeros_like(sin)])
    z = vector.unit(acc)
    x = vector.unit(vector.cross(left, z))
    target = rotation.from_matrix(jnp.stack([x, vector.cross(z, x), z], axis=-1))
    error = rotation.multiply(rotation.conjugate(state.quat), target)
    shorter_way = jnp.where(error[3] < 0, -1, 1)
    turn = jnp.where(jnp.any(acc != 0), shorter_way, 0)  # without a force there is no desired attitude
    return collective, 2 * gains.attitude * error[:3] * turn


@checked
def follow(
    gains: Finite[Gains], params: Params, state: State, collective: Float[Array, ""], omega: Float[Array, "3"]
) -> Float[Array, "4"]:
    """Inner loop: rotor speeds (RPM, up to `max_rpm`) for a collective thrust per mass and body rates."""
    gyroscopic = vector.cross(state.omega, params.inertia * state.omega)
    torque = params.inertia * gains.rate * (omega - state.omega) + gyroscopic
    return rpm_from_wrench(params, jnp.maximum(params.mass * collective, 0), torque)
