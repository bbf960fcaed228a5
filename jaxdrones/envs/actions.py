"""Action types: what four, three or one number in [-1, 1] ask of a drone.

All are scaled from the nominal parameters of the vehicle, so that 0 hovers whatever its mass.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.checks import check_callable, check_number, check_shape, check_whole
from jaxdrones.control import Setpoint, attitude, pid, rates, velocity
from jaxdrones.control.allocation import rpm_from_wrench
from jaxdrones.params import Params
from jaxdrones.state import State

Rpm = Callable[[Params, Any, State, Array, Setpoint, float], tuple[Any, Float[Array, "4"]]]


def _no_memory(n: int) -> None:
    return None


@dataclasses.dataclass(frozen=True)
class Action:
    """An action type: functions of one drone."""

    size: int
    """Numbers per drone."""
    rpm: Rpm
    """(params, memory, state, action (size,), setpoint of the task, control period) -> (memory, rotor speeds, RPM)."""
    init: Callable[[int], Any] = _no_memory
    """Number of drones -> fresh memory of the team."""

    def __post_init__(self):
        check_whole("size of an action type", self.size)
        check_callable("rpm of an action type", self.rpm, "jaxdrones.envs.ACTIONS['rpm']().rpm")
        check_callable("init of an action type", self.init, "lambda n: None")


def rpm(near_hover: float | None = None) -> Action:
    """Four rotor speeds: -1 stands still, 0 hovers, 1 is full speed; or hover speed times 1 +- `near_hover`."""
    _check_share("near_hover", near_hover)

    def command(params, memory, state, action, setpoint, dt):
        return memory, _rotor_speed(params, action, near_hover)

    return Action(4, command)


def one_d_rpm(near_hover: float | None = 0.05) -> Action:
    """One speed for all rotors; the paper's range is 5 % about hover."""
    _check_share("near_hover", near_hover)

    def command(params, memory, state, action, setpoint, dt):
        return memory, jnp.broadcast_to(_rotor_speed(params, action, near_hover), (4,))

    return Action(1, command)


def thrust_and_torques(torque_share: float = 0.05) -> Action:
    """Collective thrust from zero to twice the weight, and torques up to a share of the largest."""
    _check_share("torque_share", torque_share)

    def command(params, memory, state, action, setpoint, dt):
        limits = torque_share * jnp.stack([params.max_xy_torque, params.max_xy_torque, params.max_z_torque])
        return memory, rpm_from_wrench(params, params.weight * (1 + action[0]), limits * action[1:])

    return Action(4, command)


def one_d_thrust(share: float = 0.05) -> Action:
    """Collective thrust, the weight times 1 +- `share`."""
    _check_share("share", share)

    def command(params, memory, state, action, setpoint, dt):
        thrust = params.weight * (1 + share * action[0])
        return memory, rpm_from_wrench(params, thrust, jnp.zeros(3, thrust.dtype))

    return Action(1, command)


def velocity_input() -> Action:
    """The paper's velocity input (equation 8): a direction and a share of the speed limit, flown by the PID."""
    return _by_pid(
        4, lambda params, memory, state, action, dt: velocity.control(pid.gains(), params, memory, state, action, dt=dt)
    )


def one_d_velocity() -> Action:
    """The velocity input along z alone."""

    def command(params, memory, state, action, dt):
        vertical = jnp.stack([0 * action[0], 0 * action[0], jnp.sign(action[0]), jnp.abs(action[0])])
        return velocity.control(pid.gains(), params, memory, state, vertical, dt=dt)

    return _by_pid(1, command)


def position(step: float = 0.1) -> Action:
    """A place up to `step` (m) away along each axis, flown to by the PID."""
    check_number("step", step, "m", above=0)

    def command(params, memory, state, action, dt):
        return pid.control(pid.gains(), params, memory, state, Setpoint.at(state.pos + step * action), dt=dt)

    return _by_pid(3, command)


def one_d_position(step: float = 0.1) -> Action:
    """A place up to `step` (m) above or below, flown to by the PID."""
    check_number("step", step, "m", above=0)

    def command(params, memory, state, action, dt):
        up = jnp.stack([0 * action[0], 0 * action[0], step * action[0]])
        return pid.control(pid.gains(), params, memory, state, Setpoint.at(state.pos + up), dt=dt)

    return _by_pid(1, command)


def destination(stride: float = 1.0) -> Action:
    """A place in the world (m, within 1 m of the origin along each axis), approached at most `stride` (m) ahead.

    The `pid` action of today's version of the paper's simulator.
    """
    check_number("stride", stride, "m", above=0)

    def command(params, memory, state, action, dt):
        way = action - state.pos
        length = jnp.maximum(rotation.dot(way, rotation.unit(way)), stride)
        setpoint = Setpoint.at(state.pos + way * stride / length)
        return pid.control(pid.gains(), params, memory, state, setpoint, dt=dt)

    return _by_pid(3, command)


def pid_gains() -> Action:
    """Six numbers that scale the PID's six gain vectors by 0 to 2; the PID flies to the task's target."""

    def command(params, memory, state, action, setpoint, dt):
        own = pid.gains()
        scaled = pid.Gains(*((1 + a) * gain for a, gain in zip(action, vars(own).values(), strict=True)))
        return pid.control(scaled, params, memory, state, setpoint, dt=dt)

    return Action(6, command, pid.init)


def thrust_and_rates(max_rate: tuple[float, float, float] = (10.0, 10.0, 5.0)) -> Action:
    """Collective thrust (-1 none, 0 the weight, 1 all there is) and body rates up to `max_rate` (rad/s)."""
    check_shape("max_rate", max_rate, (3,), "about x, y and z, rad/s")
    for rate in max_rate:
        check_number("an entry of max_rate", rate, "rad/s", above=0)

    def command(params, memory, state, action, setpoint, dt):
        omega = jnp.array(max_rate, action.dtype) * action[1:]
        return memory, rates.follow(rates.gains(), params, state, _collective(params, action[0]), omega)

    return Action(4, command)


def attitude_and_thrust(max_tilt: float = 60.0) -> Action:
    """Collective thrust as above, roll and pitch up to `max_tilt` (degrees), yaw up to half a turn."""
    check_number("max_tilt", max_tilt, "degrees", above=0, at_most=180)

    def command(params, memory, state, action, setpoint, dt):
        limits = jnp.array([jnp.radians(max_tilt), jnp.radians(max_tilt), jnp.pi], action.dtype)
        target = rotation.axes(rotation.from_rpy(limits * action[1:]))
        gains = rates.gains()
        omega = -2 * gains.attitude * attitude.error(rotation.axes(state.quat), target)
        return memory, rates.follow(gains, params, state, _collective(params, action[0]), omega)

    return Action(4, command)


def _check_share(name: str, share: float | None) -> None:
    if share is not None:
        check_number(name, share, above=0, at_most=1)


def _by_pid(size: int, command: Callable) -> Action:
    """An action type that the PID flies, whatever the task."""
    return Action(size, lambda params, memory, state, a, setpoint, dt: command(params, memory, state, a, dt), pid.init)


def _rotor_speed(params: Params, action: Array, near_hover: float | None) -> Array:
    if near_hover is not None:
        return params.hover_rpm * (1 + near_hover * action)
    return _from_hover(action, params.hover_rpm, params.max_rpm)


def _collective(params: Params, action: Array) -> Array:
    """Thrust per mass, m/s^2."""
    return _from_hover(action, params.weight, params.max_thrust) / params.mass


def _from_hover(action: Array, hover: Array, highest: Array) -> Array:
    """-1 -> 0, 0 -> hover, 1 -> highest, straight in between."""
    return hover + action * jnp.where(action > 0, highest - hover, hover)


ACTIONS: dict[str, Callable[..., Action]] = {
    "rpm": rpm,
    "one_d_rpm": one_d_rpm,
    "thrust_and_torques": thrust_and_torques,
    "one_d_thrust": one_d_thrust,
    "velocity": velocity_input,
    "one_d_velocity": one_d_velocity,
    "position": position,
    "one_d_position": one_d_position,
    "destination": destination,
    "pid_gains": pid_gains,
    "thrust_and_rates": thrust_and_rates,
    "attitude": attitude_and_thrust,
}
