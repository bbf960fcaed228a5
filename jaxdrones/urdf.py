"""URDF -> Params.

Mass and inertia are the base link's, rotor positions are the origins of the fixed joints `rotor0` to
`rotor3`, the collision cylinder is the base link's, and what URDF has no word for stands in a
`<properties>` tag.
"""

import os
import xml.etree.ElementTree as ET
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxdrones import assets
from jaxdrones.checks import check_choice, shown
from jaxdrones.params import Params

GRAVITY = 9.8  # m/s^2, the reference's value
AIR_DENSITY = 1.225  # kg/m^3, standard atmosphere at sea level

_PROPERTIES = {  # attribute: (length, meaning and unit, lowest value)
    "kf": (1, "thrust coefficient, N/RPM^2", "positive"),
    "km": (1, "torque coefficient, N m/RPM^2", "positive"),
    "thrust2weight": (1, "highest thrust over weight", "positive"),
    "max_speed_kmh": (1, "highest speed, km/h", "positive"),
    "rotor_spin": (4, "signs of the reaction torques about body z", "signs"),
    "rotor_rise_time": (1, "rotor time constant when speeding up, s", "positive"),
    "rotor_fall_time": (1, "rotor time constant when slowing down, s", "positive"),
    "drag_coeff": (3, "rotor drag, N per m/s and rad/s", "any"),
    "ground_effect_coeff": (1, "k_G of equation 5", "any"),
    "downwash_coeff": (3, "k_D1 (N), k_D2, k_D3 (m) of equation 6", "any"),
    "inflow_loss": (1, "share of thrust lost per m/s of downwash, s/m", "any"),
    "prop_radius": (1, "propeller radius, m", "positive"),
}


def load_params(vehicle: str | os.PathLike) -> Params:
    """The constants of one drone.

    Args:
        vehicle: a bundled vehicle (`cf2x`, `cf2p`, `hb`, `racer`) or the path of a URDF.

    Raises:
        ValueError: an unknown vehicle, or a URDF that lacks something or holds nonsense; says what.
    """
    if not isinstance(vehicle, str | os.PathLike):
        raise ValueError(f"vehicle is {shown(vehicle)}; give the name of a bundled vehicle or the path of a URDF")
    path = Path(vehicle)
    if path.suffix != ".urdf":
        check_choice("vehicle", str(vehicle), assets.vehicles())
        path = assets.vehicles()[str(vehicle)]
    return _params(_Urdf(path))


def _params(urdf: "_Urdf") -> Params:
    inertial = "link[@name='base_link']/inertial"
    cylinder = "link[@name='base_link']/collision/geometry/cylinder"
    properties = {name: urdf.property(name) for name in _PROPERTIES}
    mass = urdf.number(f"{inertial}/mass", "value", "mass, kg", "positive")
    weight = mass * GRAVITY
    for product in ("ixy", "ixz", "iyz"):
        if urdf.number(f"{inertial}/inertia", product, "product of inertia, kg m^2", default="0") != 0:
            raise ValueError(f"{urdf.name}: {product} is not zero; turn the body axes into principal axes")
    kf = properties["kf"]
    values = dict(
        mass=mass,
        inertia=[
            urdf.number(f"{inertial}/inertia", f"i{a}{a}", "moment of inertia, kg m^2", "positive") for a in "xyz"
        ],
        rotor_pos=[
            urdf.numbers(f"joint[@name='rotor{i}']/origin", "xyz", 3, f"position of rotor {i}, m") for i in range(4)
        ],
        rotor_spin=properties["rotor_spin"],
        kf=kf,
        km=properties["km"],
        max_rpm=np.sqrt(properties["thrust2weight"] * weight / (4 * kf)),
        rotor_rise_time=properties["rotor_rise_time"],
        rotor_fall_time=properties["rotor_fall_time"],
        gravity=GRAVITY,
        air_density=AIR_DENSITY,
        wind=[0, 0, 0],
        push=[0, 0, 0],
        drag_coeff=properties["drag_coeff"],
        ground_effect_coeff=properties["ground_effect_coeff"],
        downwash_coeff=properties["downwash_coeff"],
        inflow_loss=properties["inflow_loss"],
        prop_radius=properties["prop_radius"],
        max_speed=properties["max_speed_kmh"] / 3.6,
        collision_radius=urdf.number(cylinder, "radius", "collision radius, m", "positive"),
        collision_height=urdf.number(cylinder, "length", "collision height, m", "positive"),
        collision_offset=urdf.numbers(
            "link[@name='base_link']/collision/origin", "xyz", 3, "centre of the collision cylinder, m", default="0 0 0"
        )[2],
    )
    return Params(**{name: jnp.asarray(value, float) for name, value in values.items()})


class _Urdf:
    """A parsed file whose look-ups raise errors that name the file, the tag and the attribute."""

    def __init__(self, path: Path):
        self.name = path.name
        try:
            self._root = ET.parse(path).getroot()
        except OSError as error:
            raise ValueError(f"{path}: cannot be read ({error.strerror}); give the path of a URDF file") from None
        except ET.ParseError as error:
            raise ValueError(f"{path}: is not well-formed XML ({error}); mend the file") from None

    def property(self, name: str) -> float | np.ndarray:
        length, meaning, kind = _PROPERTIES[name]
        values = self.numbers("properties", name, length, meaning, kind)
        return values[0] if length == 1 else values

    def number(self, path: str, attribute: str, meaning: str, kind: str = "any", default: str | None = None) -> float:
        return self.numbers(path, attribute, 1, meaning, kind, default)[0]

    def numbers(
        self, path: str, attribute: str, length: int, meaning: str, kind: str = "any", default: str | None = None
    ) -> np.ndarray:
        tag = self._root.find(path)
        text = default if tag is None else tag.get(attribute, default)
        if text is None:
            there = "the tag is missing" if tag is None else f"found {', '.join(tag.keys()) or 'no attribute'}"
            raise ValueError(f"{self.name}: <{path}> lacks '{attribute}' ({meaning}); {there}")
        where = f'{self.name}: <{path}> {attribute}="{text}" ({meaning})'
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            raise ValueError(f"{where} is not a list of numbers; give {length}") from None
        if len(values) != length or not np.all(np.isfinite(values)):
            raise ValueError(f"{where} should be {length} finite number(s)")
        if kind == "positive" and not np.all(values > 0):
            raise ValueError(f"{where} should be positive")
        if kind == "signs" and not np.all(np.abs(values) == 1):
            raise ValueError(f"{where} should be +1 or -1 each")
        return values
