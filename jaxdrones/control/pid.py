"""PID of gym-pybullet-drones for Crazyflies: position loop, attitude loop, PWM mixer.

It originates from the Dynamic Systems Lab of the University of Toronto. For every vehicle, torques and thrust are in
units of the Crazyflie's 16-bit PWM.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import rotation, vector
from jaxdrones.arguments import TimeStep, checked
from jaxdrones.control import attitude
from jaxdrones.control.allocation import mixer
from jaxdrones.control.setpoint import Setpoint
from jaxdrones.control.single import Finite, OneParams, OneSetpoint, OneState
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State
from jaxdrones.urdf import load_params
from jaxdrones.vector import safe_sqrt

VEHICLES = ("cf2x", "cf2p")

_TOLERANCE = np.log(1.25)  # largest logarithmic difference from the parameters of cf2x or cf2p
_PWM_TO_RPM = 0.2685  # RPM per unit of the 16-bit PWM
_PWM_OFFSET = 4070.3  # RPM
_PWM_RANGE = (20000.0, 65535.0)
_MAX_TORQUE = 3200.0  # PWM
_MAX_POS_INTEGRAL = (2.0, 2.0, 0.15)  # m s
_MAX_RPY_INTEGRAL = (1.0, 1.0, 1500.0)  # rad s


class Gains(PyTreeNode):
    """Gains of the two loops."""

    pos_p: Array
    """(3,) N/m."""
    pos_i: Array
    """(3,) N/(m s)."""
    pos_d: Array
    """(3,) N s/m."""
    rpy_p: Array
    """(3,) PWM/rad."""
    rpy_i: Array
    """(3,) PWM/(rad s)."""
    rpy_d: Array
    """(3,) PWM s/rad."""


class Memory(PyTreeNode):
    """State of the controller of one drone between calls; zero before the first call."""

    pos_integral: Array
    """(3,) integrated position error, m s."""
    rpy_integral: Array
    """(3,) integrated attitude error, rad s."""
    rpy: Array
    """(3,) roll, pitch, yaw at the last call, rad."""


def rpm_to_pwm(rpm: Any) -> Any:
    """Crazyflie's 16-bit PWM for a rotor speed (RPM), any shape."""
    return (rpm - _PWM_OFFSET) / _PWM_TO_RPM


def gains(vehicle: str = "cf2x") -> Gains:
    """Gains of gym-pybullet-drones for `cf2x` and `cf2p`.

    Raises:
        ValueError: another vehicle; the gains fit a Crazyflie's mass, inertia and PWM.
    """
    if vehicle not in VEHICLES:
        raise UserError(
            f"there are no PID gains for {vehicle!r}, only for {', '.join(VEHICLES)}; use another controller"
        )
    return Gains(
        pos_p=jnp.array([0.4, 0.4, 1.25]),
        pos_i=jnp.array([0.05, 0.05, 0.05]),
        pos_d=jnp.array([0.2, 0.2, 0.5]),
        rpy_p=jnp.array([70000.0, 70000.0, 60000.0]),
        rpy_i=jnp.array([0.0, 0.0, 500.0]),
        rpy_d=jnp.array([20000.0, 20000.0, 12000.0]),
    )


def fits(params: Params) -> bool:
    """Whether the gains suit a drone, or every drone of a team, by its parameters.

    They do if mass, inertia, arm, thrust and torque coefficient are within 25 % of those of `cf2x` or of `cf2p`.

    Raises:
        ValueError: the parameters are being traced.
    """
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(params)):
        raise UserError(
            "params are being traced, so their numbers cannot be looked at; give values, outside of jax.jit"
        )
    numbers = _numbers(params)
    unlike = [np.max(np.abs(np.log(numbers / _numbers(load_params(vehicle)))), axis=-1) for vehicle in VEHICLES]
    return bool(np.all(np.min(unlike, axis=0) <= _TOLERANCE))


def _numbers(params: Params) -> np.ndarray:
    """Parameters behind the gains: (7,) for one drone, (n, 7) for a team."""
    scalars = np.stack([params.mass, params.arm, params.kf, params.km], axis=-1)
    return np.concatenate([scalars, params.inertia], axis=-1)


def init() -> Memory:
    """Memory of a drone before the first call."""
    return Memory(jnp.zeros(3), jnp.zeros(3), jnp.zeros(3))


@checked
def control(
    gains: Finite[Gains], params: OneParams, memory: Memory, state: OneState, setpoint: OneSetpoint, *, dt: TimeStep
) -> tuple[Memory, Float[Array, "4"]]:
    """Rotor speeds of one drone, RPM, between 9,440 and 21,666 and no more than `max_rpm`.

    Of the setpoint, pos, vel, yaw and omega (as Euler rates) are used, acc is not. See `jaxdrones.control`.
    """
    memory, thrust, target = position_loop(gains, params, memory, state, setpoint, dt)
    memory, torque = attitude_loop(gains, memory, state, target, setpoint.omega, dt)
    return memory, rotor_speeds(params, thrust, torque)


@jax.checkpoint  # recomputing both loops in a backward pass is cheaper than storing
def position_loop(
    gains: Gains, params: Params, memory: Memory, state: State, setpoint: Setpoint, dt: float
) -> tuple[Memory, Float[Array, ""], attitude.Axes]:
    """Thrust per rotor (PWM, not clipped) and target attitude for the desired force."""
    error = setpoint.pos - state.pos
    limit = jnp.array(_MAX_POS_INTEGRAL)
    integral = jnp.clip(memory.pos_integral + error * dt, -limit, limit)
    force = gains.pos_p * error + gains.pos_i * integral + gains.pos_d * (setpoint.vel - state.vel)
    force = force + vector.along_z(params.weight)
    thrust = jnp.maximum(vector.dot(force, rotation.z_axis(state.quat)), 0)
    pwm = rpm_to_pwm(safe_sqrt(thrust / (4 * params.kf)))
    return memory.replace(pos_integral=integral), pwm, attitude.from_thrust(force, setpoint.yaw)


@jax.checkpoint
def attitude_loop(
    gains: Gains, memory: Memory, state: State, target: attitude.Axes, rpy_rate: Float[Array, "3"], dt: float
) -> tuple[Memory, Float[Array, "3"]]:
    """Torque (PWM) towards the attitude `target`.

    The rate is a difference of roll, pitch and yaw without unwrapping, as in gym-pybullet-drones: it jumps where yaw
    crosses +-180 degrees.
    """
    rpy = rotation.to_rpy(state.quat)
    error = 2 * attitude.error(rotation.axes(state.quat), target)
    rate_error = rpy_rate - (rpy - memory.rpy) / dt
    limit = jnp.array(_MAX_RPY_INTEGRAL)
    integral = jnp.clip(memory.rpy_integral - error * dt, -limit, limit)
    torque = -gains.rpy_p * error + gains.rpy_d * rate_error + gains.rpy_i * integral
    memory = memory.replace(rpy_integral=integral, rpy=rpy)
    return memory, jnp.clip(torque, -_MAX_TORQUE, _MAX_TORQUE)


def rotor_speeds(params: Params, thrust: Float[Array, ""], torque: Float[Array, "3"]) -> Float[Array, "4"]:
    """Rotor speeds (RPM) for a thrust per rotor and a torque (PWM), limited to the Crazyflie's PWM and to `max_rpm`."""
    pwm = [jnp.clip(thrust + vector.dot(share, torque), *_PWM_RANGE) for share in vector.components(mixer(params))]
    return jnp.minimum(_PWM_TO_RPM * jnp.stack(pwm) + _PWM_OFFSET, params.max_rpm)
