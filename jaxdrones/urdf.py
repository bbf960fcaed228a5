"""Load vehicles from URDF files.

Mass, inertia and collision cylinder are those of the base link, rotor positions the origins of the fixed joints
`rotor0` to `rotor3`, and other constants are in a `<properties>` tag. Features without a counterpart in `Params`
(tilted rotors, a mass on another link) are errors, as are drones that cannot fly.
"""

import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdrones import assets
from jaxdrones.checks import look_up, short_repr
from jaxdrones.errors import UserError
from jaxdrones.params import AIR_DENSITY, Params

GRAVITY = 9.8  # m/s^2, as in gym-pybullet-drones

_ANY = (-np.inf, np.inf)
_SIGN = (-1, 1)
_LENGTH = (1e-4, 100)  # m
_PLACE = (-100, 100)  # m
_TIME_CONSTANT = (0.0025, 10)  # s; an explicit step of 1/240 s is unstable below 2.1 ms
PROPERTIES = {  # attribute: (length, meaning and unit, range)
    "kf": (1, "thrust coefficient, N/RPM^2", (1e-20, 1)),
    "km": (1, "torque coefficient, N m/RPM^2", (1e-20, 1)),
    "thrust2weight": (1, "highest thrust over weight", (0, 100)),
    "max_speed_kmh": (1, "highest speed, km/h", (0.001, 1e5)),
    "rotor_spin": (4, "signs of the reaction torques about body z", _SIGN),
    "rotor_rise_time": (1, "rotor time constant when speeding up, s", _TIME_CONSTANT),
    "rotor_fall_time": (1, "rotor time constant when slowing down, s", _TIME_CONSTANT),
    "rotor_inertia": (1, "moment of inertia of a rotor about its axis, kg m^2", (0, 1e6)),
    "drag_coeff": (3, "rotor drag, N per m/s and rad/s", (0, 1)),
    "flapping_coeff": (2, "moment of rotors that move along x and y, N m per m/s and rad/s", (-0.1, 0.1)),
    "flapping_climb": (3, "share of that moment lost per m/s of climb, and gained per its square", (-10, 10)),
    "rate_damping": (3, "torque against the angular velocity, N m per rad/s", (0, 1e6)),
    "trim_torque": (3, "constant torque, N m", (-1e6, 1e6)),
    "ground_effect_coeff": (1, "k_G of equation 5", (0, 100)),
    "downwash_coeff": (3, "k_D1 (N), k_D2, k_D3 (m) of equation 6", (-1e6, 1e6)),
    "inflow_loss": (1, "share of thrust lost per m/s of downwash, s/m", (0, 10)),
    "prop_radius": (1, "propeller radius, m", _LENGTH),
}
"""Ranges from an insect to an airliner, within single precision."""
_OTHER_WORDS = ("thrust2weight", "max_speed_kmh")  # for `max_rpm` and `max_speed`
_DEFAULTS = {"rotor_inertia": "0", "flapping_coeff": "0 0"}
_DEFAULTS |= dict.fromkeys(("flapping_climb", "rate_damping", "trim_torque"), "0 0 0")

_MASS = (1e-6, 1e6)  # kg
_INERTIA = (1e-15, 1e9)  # kg m^2
_MAX_RPM = (10, 1e6)
_ANGULAR_ACCELERATION = (0.01, 3e4)  # rad/s^2 at the largest torque; the bundled vehicles reach 14 to 600
_UNBALANCED = 100.0  # rad/s^2 with all rotors at hover speed; limit for controllers
_CONDITION = 20.0  # of the map from thrusts to thrust and torques; 1 for a cross, 1.3 for the racer
_DRAG_RATE = 100.0  # 1/s, speed lost to drag with all rotors at full speed
_BASE = "link[@name='base_link']"
_ROTORS = tuple(f"rotor{i}" for i in range(4))


def load_params(vehicle: str | os.PathLike) -> Params:
    """Load the constants of one drone by the path of a URDF or a name of `jaxdrones.assets.vehicles()`.

    Raises:
        ValueError: an unknown vehicle, or a URDF with missing or invalid entries.
    """
    if not isinstance(vehicle, str | os.PathLike):
        raise UserError(f"vehicle is {short_repr(vehicle)}; give the name of a bundled vehicle or the path of a URDF")
    path = Path(vehicle)
    if path.suffix != ".urdf":
        found = sorted(path.glob("*.urdf")) if str(vehicle) not in assets.vehicles() else []
        if found:
            raise UserError(f"vehicle is the folder {str(vehicle)!r}; give the file, {str(found[0])!r}")
        path = look_up("vehicle", str(vehicle), assets.vehicles())
    return _params(_Urdf(path))


def parse_params(name: str, text: str) -> Params:
    """Constants of one drone from the text of a URDF; `name` is that of the file, for messages."""
    return _params(_Urdf(Path(name), text.encode()))


def _params(urdf: "_Urdf") -> Params:
    inertial, cylinder = f"{_BASE}/inertial", f"{_BASE}/collision/geometry/cylinder"
    urdf.check_properties()
    properties = {name: urdf.property(name) for name in PROPERTIES}
    mass = urdf.number(f"{inertial}/mass", "value", "mass, kg", _MASS)
    kf, thrust2weight = properties["kf"], properties["thrust2weight"]
    values = {name: value for name, value in properties.items() if name not in _OTHER_WORDS} | dict(
        mass=mass,
        inertia=[urdf.number(f"{inertial}/inertia", f"i{a}{a}", "moment of inertia, kg m^2", _INERTIA) for a in "xyz"],
        rotor_pos=[
            urdf.numbers(f"joint[@name='rotor{i}']/origin", "xyz", 3, f"position of rotor {i}, m", _PLACE)
            for i in range(4)
        ],
        max_rpm=np.sqrt(thrust2weight * mass * GRAVITY / (4 * kf)),
        gravity=GRAVITY,
        air_density=AIR_DENSITY,
        wind=[0, 0, 0],
        external_force=[0, 0, 0],
        max_speed=properties["max_speed_kmh"] / 3.6,
        collision_radius=urdf.number(cylinder, "radius", "collision radius, m", _LENGTH),
        collision_height=urdf.number(cylinder, "length", "collision height, m", _LENGTH),
        collision_offset=urdf.numbers(
            f"{_BASE}/collision/origin", "xyz", 3, "center of the collision cylinder, m", _PLACE, default="0 0 0"
        )[2],
    )
    urdf.check_what_params_cannot_hold()
    arrays: dict[str, Any] = {name: np.asarray(value, float) for name, value in values.items()}
    _check_flies(urdf.name, arrays, float(thrust2weight))
    return Params(**jax.tree.map(jax.numpy.asarray, arrays))


def _check_flies(file: str, v: dict[str, np.ndarray], thrust2weight: float) -> None:
    """Raise unless the rotors can lift and rotate the drone, and the moments of inertia are valid."""

    def demand(condition, problem: str, remedy: str) -> None:
        if not condition:
            raise UserError(f"{file}: {problem}; {remedy}")

    demand(
        thrust2weight > 1,
        f"thrust2weight is {thrust2weight:g}, with which a drone cannot hover",
        "give the highest thrust over the weight, above 1",
    )
    weight, inertia, max_rpm = v["mass"] * GRAVITY, v["inertia"], v["max_rpm"]
    demand(
        _MAX_RPM[0] <= max_rpm <= _MAX_RPM[1],
        f"mass, kf and thrust2weight make a highest rotor speed of {max_rpm:.4g} RPM",
        f"expected {_MAX_RPM[0]:g} to {_MAX_RPM[1]:g}; give kf in N/RPM^2 and the mass in kg",
    )
    # thrust / (density n^2 D^4) with n in 1/s; the bundled vehicles have 0.066 to 0.2, racer.urdf of (2021) has 0.006
    coefficient, hover = 3600 * v["kf"] / (AIR_DENSITY * (2 * v["prop_radius"]) ** 4), max_rpm / thrust2weight**0.5
    demand(
        0.001 <= coefficient <= 1,
        f"kf and prop_radius make a thrust coefficient of {coefficient:.3g} and a hover at {hover:.4g} RPM",
        "expected 0.001 to 1; give prop_radius in m, and kf in N/RPM^2, which is 0.010966 times that in N/(rad/s)^2",
    )
    largest = np.max(inertia)
    demand(
        largest <= (np.sum(inertia) - largest) * (1 + 1e-6),
        f"the moments of inertia {short_repr(inertia)} are impossible for a rigid body",
        "give moments of at most the sum of the other two",
    )
    (x, y, _), spin = v["rotor_pos"].T, v["rotor_spin"]
    demand(
        np.sum(spin) == 0,
        f'rotor_spin="{" ".join(f"{s:g}" for s in spin)}" makes the drone spin in hover',
        "give two rotors each direction",
    )
    arm = np.mean(np.hypot(x, y))
    allocation = np.stack([np.ones(4), y / max(arm, _LENGTH[0]), x / max(arm, _LENGTH[0]), spin])
    values = np.linalg.svd(allocation, compute_uv=False)
    demand(
        values[0] <= _CONDITION * values[-1],
        f"rotors at {short_repr(v['rotor_pos'])} m, spin {short_repr(spin)}, cannot rotate the drone about every axis",
        "place them around the center of mass, with neighbors that turn in opposite directions",
    )
    full = v["kf"] * max_rpm**2
    torque = np.array([full * np.sum(np.abs(y)) / 2, full * np.sum(np.abs(x)) / 2, 2 * v["km"] * max_rpm**2])
    for axis, acceleration in zip(("roll", "pitch", "yaw"), torque / inertia, strict=True):
        demand(
            _ANGULAR_ACCELERATION[0] <= acceleration <= _ANGULAR_ACCELERATION[1],
            f"its rotors accelerate it in {axis} by up to {acceleration:.3g} rad/s^2",
            f"expected {_ANGULAR_ACCELERATION[0]:g} to {_ANGULAR_ACCELERATION[1]:g}; check inertia, kf, km and mass",
        )
    tumbling = weight * np.hypot(np.mean(y) / inertia[0], np.mean(x) / inertia[1])
    demand(
        tumbling <= _UNBALANCED,
        f"its rotors are centered on ({np.mean(x):.3g}, {np.mean(y):.3g}) m and tumble it by {tumbling:.3g} rad/s^2 "
        "when they carry its weight",
        "center them on the center of mass, the origin of base_link",
    )
    rate = np.max(v["drag_coeff"]) * 4 * max_rpm * 2 * np.pi / 60 / v["mass"]
    demand(rate <= _DRAG_RATE, f"drag takes {rate:.3g} of the speed per second", f"expected at most {_DRAG_RATE:g}")


class _Urdf:
    """Parsed file with errors that name the file, the tag and the attribute."""

    def __init__(self, path: Path, content: bytes | None = None):
        self.name = path.name
        try:
            self._root = ET.fromstring(path.read_bytes() if content is None else content)
        except OSError as error:
            raise UserError(f"{path}: cannot be read ({error.strerror}); give the path of a URDF file") from None
        except ET.ParseError as error:
            raise UserError(f"{path}: is not well-formed XML ({error}); correct the file") from None
        except (LookupError, ValueError) as error:  # of its encoding, or of its name
            raise UserError(f"{short_repr(str(path))[1:-1]}: cannot be read ({error}); save it as UTF-8") from None
        if self._root.tag != "robot":
            raise UserError(f"{path}: is not a URDF, its root is <{self._root.tag}>; give a file with <robot>")

    def check_what_params_cannot_hold(self) -> None:
        """Raise for features without a counterpart in `Params`."""
        for joint in self._root.iter("joint"):
            if re.fullmatch(r"rotor\d+", joint.get("name", "")) and joint.get("name") not in _ROTORS:
                raise UserError(
                    f"{self.name}: has a joint {joint.get('name')!r}; give only the rotors rotor0 to rotor3"
                )
        for rotor in _ROTORS:
            parent = self._tag(f"joint[@name='{rotor}']/parent")
            if parent is not None and parent.get("link") != "base_link":
                raise UserError(f"{self.name}: {rotor} is attached to {parent.get('link')!r}; attach it to base_link")
        origin, collision = f"{_BASE}/inertial/origin", f"{_BASE}/collision/origin"
        upright = "rotors push along body z; give no roll and pitch"
        for path, attribute, count, remedy in (
            *((f"joint[@name='{rotor}']/origin", "rpy", 2, upright) for rotor in _ROTORS),
            (origin, "xyz", 3, "put the origin of base_link at the center of mass"),
            (origin, "rpy", 3, "turn the body axes into principal axes"),
            (collision, "xyz", 2, "center the cylinder on body z"),
            (collision, "rpy", 2, "the cylinder must be along body z; give no roll and pitch"),
        ):
            values = self.numbers(path, attribute, 3, "origin, m or rad", default="0 0 0")
            if np.any(values[:count] != 0):
                raise UserError(f"{self.name}: <{path}> {attribute} is {short_repr(values)}; {remedy}")
        for product in ("ixy", "ixz", "iyz"):
            if self.number(f"{_BASE}/inertial/inertia", product, "product of inertia, kg m^2", default="0") != 0:
                raise UserError(f"{self.name}: {product} is not zero; turn the body axes into principal axes")
        for link in self._root.findall("link"):
            mass = link.find("inertial/mass")
            if link.get("name") != "base_link" and mass is not None and not _is_zero(mass.get("value", "0")):
                raise UserError(
                    f"{self.name}: the link {link.get('name')!r} has a mass, {mass.get('value')} kg; "
                    "add it, and its inertia, to those of base_link"
                )

    def check_properties(self) -> None:
        """Raise for missing properties, with the names of all of them."""
        tag = self._tag("properties")
        known = _DEFAULTS if tag is None else _DEFAULTS | tag.attrib
        missing = [f"'{name}' ({meaning})" for name, (_, meaning, _) in PROPERTIES.items() if name not in known]
        if missing:
            raise UserError(f"{self.name}: <properties> lacks {', '.join(missing)}; {_found(tag)}")

    def property(self, name: str) -> float | np.ndarray:
        length, meaning, within = PROPERTIES[name]
        values = self.numbers("properties", name, length, meaning, within, _DEFAULTS.get(name))
        return values[0] if length == 1 else values

    def number(
        self, path: str, attribute: str, meaning: str, within: tuple = _ANY, default: str | None = None
    ) -> float:
        return self.numbers(path, attribute, 1, meaning, within, default)[0]

    def numbers(
        self, path: str, attribute: str, length: int, meaning: str, within: tuple = _ANY, default: str | None = None
    ) -> np.ndarray:
        tag = self._tag(path)
        text = default if tag is None else tag.get(attribute, default)
        if text is None:
            raise UserError(f"{self.name}: <{path}> lacks '{attribute}' ({meaning}); {_found(tag)}")
        where = f'{self.name}: <{path}> {attribute}="{short_repr(text)[1:-1]}" ({meaning})'
        try:
            values = np.array([_float(word) for word in text.split()])
        except ValueError:
            raise UserError(f"{where} is not a list of numbers; give {length}") from None
        if len(values) != length or not np.all(np.isfinite(values)):
            raise UserError(f"{where} should be {length} finite number(s)")
        if within == _SIGN and not np.all(np.abs(values) == 1):
            raise UserError(f"{where} should be +1 or -1 each")
        low, high = within
        if low > 0 and not np.all(values > 0):
            raise UserError(f"{where} should be positive")
        if not np.all((values >= low) & (values <= high)):
            raise UserError(f"{where} should be {low:g} to {high:g}")
        return values

    def _tag(self, path: str) -> ET.Element | None:
        tag = self._root
        for part in path.split("/"):
            found = tag.findall(part)
            if len(found) > 1:
                raise UserError(f"{self.name}: <{part}> of <{path}> occurs {len(found)} times; leave one")
            if not found:
                return None
            tag = found[0]
        return tag


def _found(tag: ET.Element | None) -> str:
    """Attributes of a tag, for messages."""
    return "the tag is missing" if tag is None else f"found {', '.join(tag.keys()) or 'no attribute'}"


def _float(word: str) -> float:
    """Parse a number of XML; Python's 1_000 is invalid."""
    if "_" in word:
        raise UserError(word)
    return float(word)


def _is_zero(text: str) -> bool:
    try:
        return _float(text) == 0
    except ValueError:
        return False
