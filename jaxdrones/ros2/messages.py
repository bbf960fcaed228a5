"""Standard ROS 2 messages from the type store of rosbags, such as `messages.Pose`.

Numbers are Python numbers, arrays of numbers tuples, and `uint8[]` is bytes. Fields default to zero, rotations to the
identity. Needs the extra `ros2`.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import numpy as np

from jaxdrones.errors import needs

_NAMES = {
    "builtin_interfaces": "Time",
    "geometry_msgs": "Point Pose PoseStamped PoseWithCovariance Quaternion Twist TwistStamped TwistWithCovariance "
    "Vector3",
    "nav_msgs": "Odometry",
    "rosgraph_msgs": "Clock",
    "sensor_msgs": "BatteryState CameraInfo Image Imu RegionOfInterest",
    "std_msgs": "Float64MultiArray Header MultiArrayDimension MultiArrayLayout",
}
MESSAGES = tuple(f"{package}/msg/{name}" for package, names in _NAMES.items() for name in names.split())
"""Names of all message types."""

Message = Any
"""Instance of a message type; `NAME` is its type, such as `geometry_msgs/msg/Pose`."""

_IDENTITY = {("geometry_msgs/msg/Quaternion", "w"): 1.0}  # defaults of .msg files other than zero


class Field(NamedTuple):
    """Field of a message."""

    name: str
    kind: str
    """`float64` etc., or the name of a message type."""
    length: int | None = None
    """Length of an array; 0 for any length; `None` for a single value."""

    @property
    def is_message(self) -> bool:
        """Whether the field has messages."""
        return "/" in self.kind


@functools.cache
def typestore() -> Any:
    """ROS 2 message types of rosbags."""
    with needs("rosbags", "ros2"):
        from rosbags.typesys import Stores, get_typestore
    return get_typestore(Stores.ROS2_JAZZY)


@functools.cache
def fields(name: str) -> tuple[Field, ...]:
    """Fields of a message type by name, in their order on the wire."""

    def field(name: str, described: tuple[int, Any]) -> Field:
        kind, of = described  # 1: number or text, 2: message, 3: array, 4: sequence
        if kind <= 2:
            return Field(name, of[0] if kind == 1 else of)
        return field(name, of[0])._replace(length=of[1] if kind == 3 else 0)

    return tuple(field(*entry) for entry in typestore().fielddefs[name][1])


@functools.cache
def message_class(name: str) -> Any:
    """Class of a message type by name, a frozen dataclass."""
    entries = [(field.name, Any, _IDENTITY.get((name, field.name), _default(field))) for field in fields(name)]
    return dataclasses.make_dataclass(name.rpartition("/")[2], entries, frozen=True, namespace={"NAME": name})


def _default(field: Field) -> Any:
    numbers: dict[str, Any] = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}
    one = message_class(field.kind)() if field.is_message else numbers.get(field.kind, 0)
    if field.length is None:
        return one
    return b"" if field.kind == "uint8" else (one,) * field.length


def __getattr__(name: str) -> Any:
    for known in MESSAGES:
        if known.endswith(f"/{name}"):
            globals()[name] = message_class(known)
            return globals()[name]
    raise AttributeError(name)


def serialize(message: Message) -> bytes:
    """Encode a message as CDR, little-endian, with its header of four bytes."""
    return bytes(typestore().serialize_cdr(_encode(message), message.NAME))


def deserialize(data: bytes, name: str) -> Message:
    """Decode a message of the type `name` from CDR."""
    return decode(name, typestore().deserialize_cdr(data, name))


def _encode(message: Message) -> Any:
    """Convert a message to a class of rosbags."""

    def encoded(field: Field, value: Any) -> Any:
        if field.is_message:
            return _encode(value) if field.length is None else [_encode(x) for x in value]
        if field.length is None:
            return value
        return np.frombuffer(value, np.uint8) if field.kind == "uint8" else np.array(value, field.kind)

    values = {field.name: encoded(field, getattr(message, field.name)) for field in fields(message.NAME)}
    return typestore().types[message.NAME](**values)


def decode(name: str, foreign: Any) -> Message:
    """Convert an object of another library to a message of the type `name`."""
    return message_class(name)(**{field.name: _decode(field, getattr(foreign, field.name)) for field in fields(name)})


def _decode(field: Field, value: Any) -> Any:
    if field.is_message:
        return decode(field.kind, value) if field.length is None else tuple(decode(field.kind, x) for x in value)
    if field.length is None:
        return value
    return bytes(value) if field.kind == "uint8" else tuple(map(float, value))
