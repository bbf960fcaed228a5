"""Action types: numbers in [-1, 1] to rotor speeds, scaled by the vehicle; 0 is hover, except for `throttle`."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable
from typing import Annotated, Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation, vector
from jaxdrones.arguments import Count, checked, function, number, shape
from jaxdrones.control import Setpoint, attitude, for_team, geometric, pid, rates, velocity
from jaxdrones.control.allocation import rpm_from_wrench
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.quantity import Quantity, quantities
from jaxdrones.state import State

Command = Callable[[Params, Any, State, Array, Setpoint, float], tuple[Any, Float[Array, "4"]]]
Entries = tuple[Quantity, ...]
_ROTORS = [f"speed of rotor {i}" for i in range(4)]
_AHEAD = "way from the drone to the setpoint"
_Share = Annotated[float, number(above=0, at_most=1)]
_Length = Annotated[float, number("m", above=0)]
_Tilt = Annotated[float, number("degrees", above=0, at_most=180)]
_Rates = Annotated[tuple[float, float, float], shape(3, meaning="roll, pitch and yaw, rad/s", finite=True)]


@checked
@dataclasses.dataclass(frozen=True)
class Action:
    """Action type: functions of one drone."""

    size: Count
    """Length of the action of one drone."""
    rpm: Annotated[Command, function("hover", ("params", "memory", "state", "action", "setpoint", "dt"))]
    """(params, memory, state, action (size,), setpoint of the task, control period) -> (memory, rotor speeds, RPM)."""
    init: Annotated[Callable[[], Any], function("dict", ())] = lambda: None
    """() -> memory of one drone at the start of an episode."""
    for_vehicle: Callable[[Params], Action] | None = None
    """Nominal parameters of the team -> action type for this vehicle; `None` if independent of the vehicle."""
    entries: Callable[[Params], tuple[Quantity, ...]] | None = None
    """Nominal parameters of one drone -> description of each entry, for `jaxdrones.explain`."""
    before_first: Callable[[State], Float[Array, " a"]] | None = None
    """(state) -> action in effect until the first one, which a delay holds back; `None` for zeros."""
    name: str = ""
    """Name of the action type, set by `jaxdrones.make`."""

    def team_memory(self, n: int) -> Any:
        """Memory of a team of n drones at the start of an episode."""
        return for_team(self.init(), n)

    def fitted(self, params: Params) -> Action:
        """Action type for this vehicle."""
        return self if self.for_vehicle is None else dataclasses.replace(self.for_vehicle(params), name=self.name)


@checked
def rpm(near_hover: _Share | None = None) -> Action:
    """Four rotor speeds: -1 is standstill, 0 hover speed, 1 full speed; or hover speed times 1 +- `near_hover`."""
    return _rotor_speeds(_ROTORS, functools.partial(_rotor_speed, near_hover=near_hover))


def throttle() -> Action:
    """Four rotor speeds over the largest: -1 is standstill, 1 full speed. The policy has to learn the hover speed."""
    return _rotor_speeds(_ROTORS, lambda params, action: (action + 1) / 2 * params.max_rpm)


@checked
def one_d_rpm(near_hover: _Share | None = 0.05) -> Action:
    """One speed for all rotors; the default range of 5 % about hover is that of gym-pybullet-drones (2021)."""
    return _rotor_speeds(["speed of all rotors"], functools.partial(_rotor_speed, near_hover=near_hover))


def _rotor_speeds(names: list[str], speed: Callable[[Params, Array], Array]) -> Action:
    def command(params, memory, state, action, setpoint, dt):
        return memory, jnp.broadcast_to(speed(params, action), (4,))

    def entries(params: Params) -> Entries:
        return tuple(Quantity(name, "RPM", values=_at_ends(speed, params)) for name in names)

    return Action(len(names), command, entries=entries)


@checked
def thrust_and_torques(torque_share: _Share = 0.05) -> Action:
    """Collective thrust from zero to twice the weight, and torques up to a fraction of the largest.

    As in gym-pybullet-drones (2021), they are allocated to rotors without an upper limit, and then limited.
    """

    def limits(params: Params) -> Array:
        return torque_share * jnp.stack([params.max_xy_torque, params.max_xy_torque, params.max_z_torque])

    def command(params, memory, state, action, setpoint, dt):
        unlimited = params.replace(max_rpm=jnp.full_like(params.max_rpm, jnp.inf))
        rpm = rpm_from_wrench(unlimited, params.weight * (1 + action[0]), limits(params) * action[1:])
        return memory, jnp.minimum(rpm, params.max_rpm)

    def entries(params: Params) -> Entries:
        return _thrust(0.0, params.weight, 2 * params.weight) + _about_axes("torque", "N m", limits(params))

    return Action(4, command, entries=entries)


@checked
def one_d_thrust(share: _Share = 0.05) -> Action:
    """Collective thrust, the weight times 1 +- `share`."""

    def command(params, memory, state, action, setpoint, dt):
        thrust = params.weight * (1 + share * action[0])
        return memory, rpm_from_wrench(params, thrust, jnp.zeros(3, thrust.dtype))

    def entries(params: Params) -> Entries:
        return _thrust((1 - share) * params.weight, params.weight, (1 + share) * params.weight)

    return Action(1, command, entries=entries)


def velocity_input() -> Action:
    """Velocity command of gym-pybullet-drones (2021): a direction and a fraction of the speed limit."""

    def entries(params: Params) -> Entries:
        highest = float(velocity.SPEED_SHARE * params.max_speed)
        speed = Quantity("speed", "m/s", "world", (highest, 0.0, highest))
        return (*quantities("direction of the velocity", "-", "world"), speed)

    return _setpoint(4, velocity.setpoint, entries)


def one_d_velocity() -> Action:
    """Velocity command along z alone."""

    def target(params, state, action):
        vertical = jnp.stack([0 * action[0], 0 * action[0], jnp.sign(action[0]), jnp.abs(action[0])])
        return velocity.setpoint(params, state, vertical)

    def entries(params: Params) -> Entries:
        highest = float(velocity.SPEED_SHARE * params.max_speed)
        return (Quantity("z of the velocity", "m/s", "world", (-highest, 0.0, highest)),)

    return _setpoint(1, target, entries)


@checked
def position(step: _Length = 0.1) -> Action:
    """A position up to `step` (m) away along each axis."""
    entries = quantities(_AHEAD, "m", "world", values=(-step, 0.0, step))
    return _setpoint(3, lambda params, state, action: Setpoint.at(state.pos + step * action), lambda params: entries)


@checked
def one_d_position(step: _Length = 0.1) -> Action:
    """A position up to `step` (m) above or below."""
    entries = quantities(_AHEAD, "m", "world", "z", (-step, 0.0, step))

    def target(params, state, action):
        return Setpoint.at(state.pos + vector.along_z(step * action[0]))

    return _setpoint(1, target, lambda params: entries)


@checked
def destination(max_step: _Length = 1.0) -> Action:
    """A position in the world within 1 m of the origin along each axis, m: the `pid` action of (2.x).

    The setpoint is on the line to it, at most `max_step` (m) ahead. With a delay, a drone first keeps its place.
    """

    def target(params, state, action):
        away = action - state.pos
        distance = jnp.maximum(vector.dot(away, vector.unit(away)), max_step)
        return Setpoint.at(state.pos + away * max_step / distance)

    entries = quantities("destination", "m", "world")
    return _setpoint(3, target, lambda params: entries, lambda state: jnp.clip(state.pos, -1, 1))


def pid_gains() -> Action:
    """Factors of 0 to 2 for the PID's six gain vectors; the PID flies to the task's target."""

    def command(params, memory, state, action, setpoint, dt):
        own = pid.gains()
        scaled = pid.Gains(*((1 + a) * gain for a, gain in zip(action, vars(own).values(), strict=True)))
        return pid.control(scaled, params, memory, state, setpoint, dt=dt)

    def entries(params: Params) -> Entries:
        gains = dataclasses.fields(pid.Gains)
        return tuple(Quantity(f"factor of the gain {gain.name}", values=(0.0, 1.0, 2.0)) for gain in gains)

    def for_vehicle(params):
        if pid.fits(params):
            return Action(6, command, pid.init, entries=entries)
        raise UserError(
            f"the action type 'pid_gains' scales the gains of the PID, which suit only {', '.join(pid.VEHICLES)} "
            "and vehicles with similar parameters; give one of these, or another action type"
        )

    return Action(6, command, pid.init, for_vehicle, entries)


@checked
def thrust_and_rates(max_rate: _Rates = (10.0, 10.0, 5.0)) -> Action:
    """Collective thrust (-1 none, 0 the weight, 1 the largest) and body rates up to `max_rate` (rad/s)."""

    def command(params, memory, state, action, setpoint, dt):
        omega = jnp.array(max_rate, action.dtype) * action[1:]
        return memory, rates.follow(rates.gains(), params, state, _collective(params, action[0]), omega)

    def entries(params: Params) -> Entries:
        return _thrust(0.0, params.weight, params.max_thrust) + _about_axes("body rates", "rad/s", max_rate)

    return Action(4, command, entries=entries)


@checked
def attitude_and_thrust(max_tilt: _Tilt = 60.0) -> Action:
    """Collective thrust as above, roll and pitch up to `max_tilt` (degrees), yaw up to half a turn."""

    def command(params, memory, state, action, setpoint, dt):
        limits = jnp.array([jnp.radians(max_tilt), jnp.radians(max_tilt), jnp.pi], action.dtype)
        target = rotation.axes(rotation.from_rpy(limits * action[1:]))
        gains = rates.gains()
        omega = -2 * gains.attitude * attitude.error(rotation.axes(state.quat), target)
        return memory, rates.follow(gains, params, state, _collective(params, action[0]), omega)

    def entries(params: Params) -> Entries:
        angles = (("roll", max_tilt), ("pitch", max_tilt), ("yaw", 180.0))
        turns = [Quantity(angle, "degrees", "body to world", (-limit, 0.0, limit)) for angle, limit in angles]
        return (*_thrust(0.0, params.weight, params.max_thrust), *turns)

    return Action(4, command, entries=entries)


def _setpoint(
    size: int,
    target: Callable[[Params, State, Array], Setpoint],
    entries: Callable[[Params], Entries],
    before_first: Callable[[State], Array] | None = None,
) -> Action:
    """Action type that commands a setpoint.

    It is tracked by the PID for vehicles within its gains' range, and by the geometric controller for all others.
    """

    def flown_by(controller) -> Action:
        def command(params, memory, state, action, setpoint, dt):
            wanted = target(params, state, action)
            return controller.control(controller.gains(), params, memory, state, wanted, dt=dt)

        def fitted(params):
            return flown_by(pid if pid.fits(params) else geometric)

        return Action(size, command, controller.init, fitted, entries, before_first)

    return flown_by(pid)


def _about_axes(name: str, unit: str, largest: Iterable) -> Entries:
    """Entries about the three body axes, with the value at an action of 1."""
    axes = zip("xyz", map(float, largest), strict=True)
    return tuple(Quantity(f"{axis} of the {name}", unit, "body", (-value, 0.0, value)) for axis, value in axes)


def _at_ends(speed: Callable[[Params, Array], Array], params: Params) -> tuple[float, float, float]:
    """Rotor speeds at -1, 0 and 1, RPM."""
    low, middle, high = (float(speed(params, jnp.asarray(x))) for x in (-1.0, 0.0, 1.0))
    return low, middle, high


def _thrust(low: Array | float, zero: Array, high: Array) -> Entries:
    """Collective thrust at -1, 0 and 1, N."""
    return (Quantity("collective thrust", "N", "body", (float(low), float(zero), float(high))),)


def _rotor_speed(params: Params, action: Array, near_hover: float | None = None) -> Array:
    if near_hover is None:
        return _from_hover(action, params.hover_rpm, params.max_rpm)
    return params.hover_rpm * (1 + near_hover * action)


def _collective(params: Params, action: Array) -> Array:
    """Collective thrust per mass, m/s^2."""
    return _from_hover(action, params.weight, params.max_thrust) / params.mass


def _from_hover(action: Array, hover: Array, highest: Array) -> Array:
    """Piecewise linear: -1 -> 0, 0 -> hover, 1 -> highest."""
    return hover + action * jnp.where(action > 0, highest - hover, hover)


_NAMED_AS_THEIR_FUNCTION = (
    *(rpm, throttle, one_d_rpm, thrust_and_torques, one_d_thrust, one_d_velocity, position, one_d_position),
    *(destination, pid_gains, thrust_and_rates),
)
ACTIONS: dict[str, Callable[..., Action]] = {function.__name__: function for function in _NAMED_AS_THEIR_FUNCTION}
ACTIONS |= {"velocity": velocity_input, "attitude": attitude_and_thrust}
