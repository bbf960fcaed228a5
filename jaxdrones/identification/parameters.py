"""The numbers of a vehicle that flights can tell, by name, and the vehicle that has them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
from jax.typing import ArrayLike

from jaxdrones.checks import check_choice
from jaxdrones.identification.vehicle import Vehicle
from jaxdrones.limits import check_at_most
from jaxdrones.params import Params

_MOST = 60
_SUMMED_SPEED = 6900.0  # rad/s, about that of a hovering Crazyflie


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One number of a vehicle, as the coordinate that is searched: x is 0 where the search starts.

    The number is exp(x) times its start where it must be positive, and `unit` x more than its start elsewhere.
    """

    name: str
    """For example `inertia_x`."""
    field: str
    """Of `Params`, of `Instruments`, `center_of_mass`, or `rotor_lag`, the time constant up and down."""
    entries: int | slice | tuple[()]
    """Those of the field's array that are this number."""
    unit: float | None = None
    """What a step of 1 changes; `None` for a positive number, of which it is the logarithm."""
    of_flight: bool = False
    """Whether it differs from flight to flight: the vehicle has the median."""


def _axes(field: str, unit: float | None = None, of_flight: bool = False, axes: str = "xyz") -> list[Parameter]:
    return [Parameter(f"{field}_{axis}", field, i, unit, of_flight) for i, axis in enumerate(axes)]


PARAMETERS = {
    parameter.name: parameter
    for parameter in (
        Parameter("mass", "mass", ()),
        Parameter("kf", "kf", ()),
        Parameter("km", "km", ()),
        *_axes("inertia"),
        Parameter("rotor_inertia", "rotor_inertia", (), 1e-8),
        Parameter("rotor_lag", "rotor_lag", ()),
        *_axes("drag_coeff", 1e-7),
        *_axes("flapping_coeff", 1e-4 / _SUMMED_SPEED, axes="xy"),
        Parameter("flapping_climb_x", "flapping_climb", 0, 0.1),
        Parameter("flapping_climb_y", "flapping_climb", 1, 0.1),
        Parameter("flapping_climb_squared", "flapping_climb", 2, 0.1),
        Parameter("rate_damping_xy", "rate_damping", slice(0, 2), 1e-4),
        Parameter("rate_damping_z", "rate_damping", 2, 1e-4),
        *_axes("center_of_mass", 1e-3, axes="xy"),
        *_axes("trim_torque", 1e-4, of_flight=True),
        *_axes("tilt", 0.01, of_flight=True, axes="xy"),
        Parameter("delay", "delay", (), 0.01, of_flight=True),
        Parameter("position_scale", "position_scale", (), 0.02),
        Parameter("unfelt_sag", "unfelt_sag", (), 0.3),
        Parameter("estimate_tilt", "estimate_tilt", (), 0.1),
        Parameter("estimate_delay", "estimate_delay", (), 0.01),
    )
}
"""Every number that can be fitted, by name."""

_OF_TWIN = ("rotor_lag", "unfelt_sag", "estimate_tilt", "estimate_delay")  # beside a delay, pieces do not tell them
# A flight depends on thrust over mass and yaw torque over inertia: one of each is kept. PWM tells thrusts, not speeds.
_OF_ROTOR_SPEEDS = tuple(name for name in PARAMETERS if name not in ("mass", "inertia_z", *_OF_TWIN))
_OF_PWM = tuple(name for name in PARAMETERS if name not in ("kf", "inertia_z", "rotor_inertia", *_OF_TWIN))


def default_parameters(has_rotor_speeds: bool) -> tuple[str, ...]:
    """Names of what is fitted if nothing is asked for."""
    return _OF_ROTOR_SPEEDS if has_rotor_speeds else _OF_PWM


def asked_parameters(names: Sequence[str]) -> tuple[str, ...]:
    """The parameters of names and of fields: `inertia` stands for all three.

    Raises:
        ValueError: an unknown name, or more parameters than flights can tell.
    """
    fields = {parameter.field for parameter in PARAMETERS.values()}
    found: dict[str, None] = {}
    for name in names:
        check_choice("parameter", name, sorted(fields | PARAMETERS.keys()))
        found |= dict.fromkeys(p.name for p in PARAMETERS.values() if name in (p.name, p.field))
    check_at_most("parameters", len(found), _MOST)
    return tuple(found)


def with_parameters(vehicle: Vehicle, names: Sequence[str], x: Sequence[ArrayLike]) -> Vehicle:
    """The vehicle whose parameters are x from those that it is given with."""
    for name, value in zip(names, x, strict=True):
        vehicle = _with(vehicle, PARAMETERS[name], value)
    return vehicle


def value_of(vehicle: Vehicle, name: str) -> float:
    """The number itself, in SI units; of the center of mass, its place among the rotors."""
    parameter = PARAMETERS[name]
    if parameter.field == "center_of_mass":
        return float(-jnp.mean(vehicle.params.rotor_pos[:, parameter.entries]))
    if parameter.field == "rotor_lag":
        return float(vehicle.params.rotor_rise_time)
    array = getattr(getattr(vehicle, _part(parameter)), parameter.field)
    return float(jnp.mean(array[parameter.entries]))


def step_of(vehicle: Vehicle, name: str) -> float:
    """How much the number changes with x, in SI units."""
    unit = PARAMETERS[name].unit
    return abs(value_of(vehicle, name)) if unit is None else unit


_PARAMS = frozenset(field.name for field in dataclasses.fields(Params))


def _part(parameter: Parameter) -> str:
    """Of the vehicle, to which the parameter's field belongs."""
    return "params" if parameter.field in _PARAMS else "instruments"


def _with(vehicle: Vehicle, parameter: Parameter, x: ArrayLike) -> Vehicle:
    if parameter.field == "center_of_mass":
        moved = -(parameter.unit or 0.0) * x
        rotor_pos = vehicle.params.rotor_pos.at[:, parameter.entries].add(moved)
        return vehicle.replace(params=vehicle.params.replace(rotor_pos=rotor_pos))
    if parameter.field == "rotor_lag":
        lag = vehicle.params.rotor_rise_time * jnp.exp(x)
        return vehicle.replace(params=vehicle.params.replace(rotor_rise_time=lag, rotor_fall_time=lag))
    part = _part(parameter)
    owner = getattr(vehicle, part)
    place = getattr(owner, parameter.field).at[parameter.entries]
    changed = place.multiply(jnp.exp(x)) if parameter.unit is None else place.add(parameter.unit * x)
    return vehicle.replace(**{part: owner.replace(**{parameter.field: changed})})
