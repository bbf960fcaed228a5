"""Identifiable parameters of a vehicle by name."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
from jax.typing import ArrayLike

from jaxdrones.checks import check_whole, look_up
from jaxdrones.errors import UserError
from jaxdrones.flights.vehicle import Vehicle
from jaxdrones.params import Params

_MAX_PARAMETERS = 60
_NOT_NEGATIVE = ("rotor_inertia", "drag_coeff", "rate_damping")
_HOVER_SUMMED_SPEED = 6900.0  # rad/s, sum of the four rotor speeds, about that of a hovering Crazyflie


@dataclasses.dataclass(frozen=True)
class Parameter:
    """Scalar parameter of a vehicle and its search coordinate x, zero at the initial value.

    A positive parameter is its initial value times exp(x), any other its initial value plus `scale` times x.
    """

    name: str
    """Name of the parameter, for example `inertia_x`."""
    field: str
    """Field of `Params` or `Instruments`; or `center_of_mass`; or `rotor_lag`, both time constants of the rotors."""
    index: int | slice | tuple[()]
    """Entries of the field's array with this value."""
    scale: float | None = None
    """Change of the parameter for a step of 1 in x, SI units; `None` for a positive parameter with logarithmic x."""
    per_flight: bool = False
    """Whether every flight has its own value; the fitted vehicle then has the median."""


def _axes(field: str, scale: float | None = None, per_flight: bool = False, axes: str = "xyz") -> list[Parameter]:
    return [Parameter(f"{field}_{axis}", field, i, scale, per_flight) for i, axis in enumerate(axes)]


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
        *_axes("flapping_coeff", 1e-4 / _HOVER_SUMMED_SPEED, axes="xy"),
        Parameter("flapping_climb_x", "flapping_climb", 0, 0.1),
        Parameter("flapping_climb_y", "flapping_climb", 1, 0.1),
        Parameter("flapping_climb_squared", "flapping_climb", 2, 0.1),
        Parameter("rate_damping_xy", "rate_damping", slice(0, 2), 1e-4),
        Parameter("rate_damping_z", "rate_damping", 2, 1e-4),
        *_axes("center_of_mass", 1e-3, axes="xy"),
        *_axes("trim_torque", 1e-4, per_flight=True),
        *_axes("tilt", 0.01, per_flight=True, axes="xy"),
        Parameter("delay", "delay", (), 0.01, per_flight=True),
        Parameter("position_scale", "position_scale", (), 0.02),
        Parameter("unfelt_sag", "unfelt_sag", (), 0.3),
        Parameter("estimate_tilt", "estimate_tilt", (), 0.1),
        Parameter("estimate_delay", "estimate_delay", (), 0.01),
    )
}
"""All parameters by name."""

# Not identifiable from open-loop windows together with a delay.
_CLOSED_LOOP_ONLY = ("rotor_lag", "unfelt_sag", "estimate_tilt", "estimate_delay")
# Only the ratios of thrust to mass and of yaw torque to inertia are identifiable: one parameter of each is fixed.
# PWM identifies thrusts, not rotor speeds.
FROM_ROTOR_SPEEDS = tuple(name for name in PARAMETERS if name not in ("mass", "inertia_z", *_CLOSED_LOOP_ONLY))
FROM_PWM = tuple(name for name in PARAMETERS if name not in ("kf", "inertia_z", "rotor_inertia", *_CLOSED_LOOP_ONLY))
"""Names of the parameters of a fit by default."""


def select_parameters(names: Sequence[str]) -> tuple[str, ...]:
    """Expand names of parameters or fields to parameters, for example `inertia` to three axes."""
    known = {name: [name] for name in PARAMETERS}
    for parameter in PARAMETERS.values():
        if parameter.field != parameter.name:
            known.setdefault(parameter.field, []).append(parameter.name)
    selected = dict.fromkeys(each for name in names for each in look_up("parameter", name, known))
    check_whole("parameters", len(selected), limit=_MAX_PARAMETERS)
    return tuple(selected)


def check_guess(vehicle: Vehicle, names: Sequence[str]) -> None:
    """Raise for a positive parameter that is zero in the initial vehicle, and would stay so."""
    zero = [name for name in names if PARAMETERS[name].scale is None and value_of(vehicle, name) == 0]
    if zero:
        raise UserError(
            f"the vehicle has a {zero[0]} of 0, of which a fit finds a multiple; give a vehicle with a first guess"
        )


def negative(vehicle: Vehicle, names: Sequence[str]) -> tuple[str, ...]:
    """Names of the parameters that are negative and must not be."""
    return tuple(name for name in names if PARAMETERS[name].field in _NOT_NEGATIVE and value_of(vehicle, name) < 0)


def without(params: Params, names: Sequence[str]) -> Params:
    """Parameters of one drone with zero in place of those of these names."""
    for name in names:
        field = PARAMETERS[name].field
        params = params.replace(**{field: getattr(params, field).at[PARAMETERS[name].index].set(0)})
    return params


def with_parameters(vehicle: Vehicle, names: Sequence[str], x: Sequence[ArrayLike]) -> Vehicle:
    """Vehicle with the coordinates x of named parameters, relative to `vehicle`."""
    for name, value in zip(names, x, strict=True):
        vehicle = _with(vehicle, PARAMETERS[name], value)
    return vehicle


def value_of(vehicle: Vehicle, name: str) -> float:
    """Value of a parameter, SI units; the center of mass is relative to the mean position of the rotors."""
    parameter = PARAMETERS[name]
    if parameter.field == "center_of_mass":
        return float(-jnp.mean(vehicle.params.rotor_pos[:, parameter.index]))
    if parameter.field == "rotor_lag":
        return float(vehicle.params.rotor_rise_time)
    array = getattr(getattr(vehicle, _owner(parameter)), parameter.field)
    return float(jnp.mean(array[parameter.index]))


def scale_of(vehicle: Vehicle, name: str) -> float:
    """Magnitude of the derivative of a parameter with respect to its coordinate x, SI units."""
    scale = PARAMETERS[name].scale
    return abs(value_of(vehicle, name)) if scale is None else scale


_PARAMS = frozenset(field.name for field in dataclasses.fields(Params))


def _owner(parameter: Parameter) -> str:
    """Attribute of `Vehicle` with the parameter's field."""
    return "params" if parameter.field in _PARAMS else "instruments"


def _with(vehicle: Vehicle, parameter: Parameter, x: ArrayLike) -> Vehicle:
    if parameter.field == "center_of_mass":
        shift = -(parameter.scale or 0.0) * x
        rotor_pos = vehicle.params.rotor_pos.at[:, parameter.index].add(shift)
        return vehicle.replace(params=vehicle.params.replace(rotor_pos=rotor_pos))
    if parameter.field == "rotor_lag":
        lag = vehicle.params.rotor_rise_time * jnp.exp(x)
        return vehicle.replace(params=vehicle.params.replace(rotor_rise_time=lag, rotor_fall_time=lag))
    attribute = _owner(parameter)
    owner = getattr(vehicle, attribute)
    entries = getattr(owner, parameter.field).at[parameter.index]
    changed = entries.multiply(jnp.exp(x)) if parameter.scale is None else entries.add(parameter.scale * x)
    return vehicle.replace(**{attribute: owner.replace(**{parameter.field: changed})})
