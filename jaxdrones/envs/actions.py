"""Action types: functions from a few numbers in [-1, 1] to rotor speeds.

All are scaled with the nominal parameters of the vehicle, so that an action of 0 hovers, whatever the mass.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import rotation, vector
from jaxdrones.checks import check_callable, check_number, check_shape, check_whole
from jaxdrones.control import Setpoint, attitude, for_team, geometric, pid, rates, velocity
from jaxdrones.control.allocation import rpm_from_wrench
from jaxdrones.params import Params
from jaxdrones.state import State

Command = Callable[[Params, Any, State, Array, Setpoint, float], tuple[Any, Float[Array, "4"]]]


def _no_memory() -> None:
    """The memory of an action type that keeps none."""


@dataclasses.dataclass(frozen=True)
class Action:
    """An action type: functions of one drone."""

    size: int
    """How many numbers an action of one drone has."""
    rpm: Command
    """(params, memory, state, action (size,), setpoint of the task, control period) -> (memory, rotor speeds, RPM)."""
    init: Callable[[], Any] = _no_memory
    """() -> memory of one drone at the start of an episode."""
    for_vehicle: Callable[[Params], Action] | None = None
    """Nominal parameters of the team -> the action type for this vehicle; `None` where it is the same for all."""

    def team_memory(self, n: int) -> Any:
        """The memory of a team of n drones at the start of an episode."""
        return for_team(self.init(), n)

    def fitted(self, params: Params) -> Action:
        """The action type for this vehicle.

        Raises:
            ValueError: the action type does not suit the vehicle.
        """
        return self if self.for_vehicle is None else self.for_vehicle(params)

    def __post_init__(self):
        check_whole("size of an action type", self.size)
        check_callable("rpm of an action type", self.rpm, "jaxdrones.envs.ACTIONS['rpm']().rpm")
        check_callable("init of an action type", self.init, "lambda: None")


def rpm(near_hover: float | None = None) -> Action:
    """Four rotor speeds: -1 is standstill, 0 hover speed, 1 full speed; or hover speed times 1 +- `near_hover`."""
    _check_share("near_hover", near_hover)

    def command(params, memory, state, action, setpoint, dt):
        return memory, _rotor_speed(params, action, near_hover)

    return Action(4, command)


def one_d_rpm(near_hover: float | None = 0.05) -> Action:
    """One speed for all rotors; the default range of 5 % about hover is that of gym-pybullet-drones (2021)."""
    _check_share("near_hover", near_hover)

    def command(params, memory, state, action, setpoint, dt):
        return memory, jnp.broadcast_to(_rotor_speed(params, action, near_hover), (4,))

    return Action(1, command)


def thrust_and_torques(torque_share: float = 0.05) -> Action:
    """Collective thrust from zero to twice the weight, and torques up to a share of the largest.

    As in gym-pybullet-drones (2021), they are allocated to rotors without an upper limit, and then limited.
    """
    _check_share("torque_share", torque_share)

    def command(params, memory, state, action, setpoint, dt):
        limits = torque_share * jnp.stack([params.max_xy_torque, params.max_xy_torque, params.max_z_torque])
        unlimited = params.replace(max_rpm=jnp.full_like(params.max_rpm, jnp.inf))
        rpm = rpm_from_wrench(unlimited, params.weight * (1 + action[0]), limits * action[1:])
        return memory, jnp.minimum(rpm, params.max_rpm)

    return Action(4, command)


def one_d_thrust(share: float = 0.05) -> Action:
    """Collective thrust, the weight times 1 +- `share`."""
    _check_share("share", share)

    def command(params, memory, state, action, setpoint, dt):
        thrust = params.weight * (1 + share * action[0])
        return memory, rpm_from_wrench(params, thrust, jnp.zeros(3, thrust.dtype))

    return Action(1, command)


def velocity_input() -> Action:
    """Velocity command of gym-pybullet-drones (2021): a direction and a share of the speed limit."""
    return _setpoint(4, velocity.setpoint)


def one_d_velocity() -> Action:
    """The velocity command along z alone."""

    def target(params, state, action):
        vertical = jnp.stack([0 * action[0], 0 * action[0], jnp.sign(action[0]), jnp.abs(action[0])])
        return velocity.setpoint(params, state, vertical)

    return _setpoint(1, target)


def position(step: float = 0.1) -> Action:
    """A position up to `step` (m) away along each axis."""
    check_number("step", step, "m", above=0)
    return _setpoint(3, lambda params, state, action: Setpoint.at(state.pos + step * action))


def one_d_position(step: float = 0.1) -> Action:
    """A position up to `step` (m) above or below."""
    check_number("step", step, "m", above=0)

    def target(params, state, action):
        return Setpoint.at(state.pos + jnp.stack([0 * action[0], 0 * action[0], step * action[0]]))

    return _setpoint(1, target)


def destination(max_step: float = 1.0) -> Action:
    """A position in the world within 1 m of the origin along each axis, m: the `pid` action of (2.x).

    The setpoint is on the straight line there, at most `max_step` (m) ahead of the drone.
    """
    check_number("max_step", max_step, "m", above=0)

    def target(params, state, action):
        away = action - state.pos
        distance = jnp.maximum(vector.dot(away, vector.unit(away)), max_step)
        return Setpoint.at(state.pos + away * max_step / distance)

    return _setpoint(3, target)


def pid_gains() -> Action:
    """Six numbers that scale the PID's six gain vectors by 0 to 2; the PID flies to the task's target."""

    def command(params, memory, state, action, setpoint, dt):
        own = pid.gains()
        scaled = pid.Gains(*((1 + a) * gain for a, gain in zip(action, vars(own).values(), strict=True)))
        return pid.control(scaled, params, memory, state, setpoint, dt=dt)

    def for_vehicle(params):
        if pid.fits(params):
            return Action(6, command, pid.init)
        raise ValueError(
            f"the action type 'pid_gains' scales the gains of the PID, which suit {', '.join(pid.VEHICLES)} and no "
            "vehicle of other mass, inertia, arm or coefficients; take one of these, or another action type"
        )

    return Action(6, command, pid.init, for_vehicle)


def thrust_and_rates(max_rate: tuple[float, float, float] = (10.0, 10.0, 5.0)) -> Action:
    """Collective thrust (-1 none, 0 the weight, 1 the largest) and body rates up to `max_rate` (rad/s)."""
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


_MAX_PERIOD = 1 / 30  # s; at 27 Hz the PID loses a Crazyflie; the geometric controller is stable down to 15 Hz
_MAX_ROTOR_TIME = 0.02  # s, mean of rise and fall; with 0.022 the PID loses a Crazyflie at 48 Hz


def _setpoint(size: int, target: Callable[[Params, State, Array], Setpoint]) -> Action:
    """An action type that commands a setpoint, whatever the task.

    The PID follows it with vehicles that its gains suit, the geometric controller with all others.
    """

    def flown_by(controller) -> Action:
        def command(params, memory, state, action, setpoint, dt):
            wanted = target(params, state, action)
            return controller.control(controller.gains(), params, memory, state, wanted, dt=dt)

        return Action(size, command, controller.init, lambda params: flown_by(pid if pid.fits(params) else geometric))

    return flown_by(pid)


def check_loop(name: str, action: Action, params: Params, lagging: bool, dt: float) -> None:
    """Raise `ValueError` if the controller of an action type would be called too seldom, or its rotors lag too much.

    Args:
        name: name of the action type.
        action: the action type.
        params: nominal parameters of the vehicle.
        lagging: whether the rotors lag.
        dt: control period, s.
    """
    if action.for_vehicle is None:
        return
    if dt > _MAX_PERIOD * (1 + 1e-6):
        raise ValueError(
            f"control_hz is {1 / dt:g}; the action type {name!r} is flown by a controller that needs "
            f"{1 / _MAX_PERIOD:g} or more"
        )
    time = float(np.max(params.rotor_rise_time + params.rotor_fall_time)) / 2
    if lagging and time > _MAX_ROTOR_TIME * (1 + 1e-6):
        raise ValueError(
            f"the action type {name!r} is flown by a controller that needs rotors with a time constant of up to "
            f"{_MAX_ROTOR_TIME} s; those of this vehicle, which lag, have {time:.2g} s; give rotors='instant', or an "
            "action type that commands rotors, thrust and torques, or rates"
        )


def _check_share(name: str, share: float | None) -> None:
    if share is not None:
        check_number(name, share, above=0, at_most=1)


def _rotor_speed(params: Params, action: Array, near_hover: float | None) -> Array:
    if near_hover is not None:
        return params.hover_rpm * (1 + near_hover * action)
    return _from_hover(action, params.hover_rpm, params.max_rpm)


def _collective(params: Params, action: Array) -> Array:
    """Collective thrust per mass, m/s^2."""
    return _from_hover(action, params.weight, params.max_thrust) / params.mass


def _from_hover(action: Array, hover: Array, highest: Array) -> Array:
    """Piecewise linear: -1 -> 0, 0 -> hover, 1 -> highest."""
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
