"""Conversion of states to messages and of messages to commands."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from jaxdrones.checks import short_repr
from jaxdrones.errors import UserError
from jaxdrones.ros2 import messages as msg
from jaxdrones.ros2 import topics
from jaxdrones.ros2.command import Command, Mode
from jaxdrones.rotation import yaw_of
from jaxdrones.sensing import Camera

_NS = 1_000_000_000
_LITHIUM_POLYMER, _DISCHARGING, _HEALTH_GOOD = 3, 2, 1  # constants of sensor_msgs/BatteryState
_LARGEST = 1e9  # in any unit: the controllers' squares of larger numbers are beyond float32
_AMPERE_HOUR = 3600.0  # A s


class Measurement(NamedTuple):
    """Published data of a team of n drones at an instant, as NumPy or JAX arrays."""

    pos: Array | np.ndarray  # (n, 3) m, world
    quat: Array | np.ndarray  # (n, 4) x, y, z, w, body to world
    vel: Array | np.ndarray  # (n, 3) m/s, body
    omega: Array | np.ndarray  # (n, 3) rad/s, body
    acc: Array | np.ndarray | None  # (n, 3) specific force, m/s^2, body; unknown for a log
    rpm: Array | np.ndarray  # (n, 4) RPM
    battery: dict[str, Array | np.ndarray] | None  # (n,) each; see `Simulation`


def stamp(ns: int) -> msg.Time:
    """Convert a time, ns, to a message."""
    return msg.Time(*divmod(ns, _NS))


def state_messages(now: Measurement, i: int, ns: int) -> dict[str, msg.Message]:
    """Messages of drone `i` at the simulated time `ns`, by the names of `topics.OUTPUTS`, without images.

    Motor speeds have no stamp. They precede the odometry, so a receiver of the odometry has them.
    """
    world, body = msg.Header(stamp(ns), topics.WORLD), msg.Header(stamp(ns), f"{topics.drone(i)}/base_link")
    orientation = msg.Quaternion(*now.quat[i].tolist())
    omega = msg.Vector3(*now.omega[i].tolist())
    pose = msg.Pose(msg.Point(*now.pos[i].tolist()), orientation)
    twist = msg.Twist(msg.Vector3(*now.vel[i].tolist()), omega)
    found: dict[str, msg.Message] = {
        "motors": motors(now.rpm[i]),
        "pose": msg.PoseStamped(world, pose),
        "twist": msg.TwistStamped(body, twist),
        "odom": msg.Odometry(world, body.frame_id, msg.PoseWithCovariance(pose), msg.TwistWithCovariance(twist)),
    }
    if now.acc is not None:
        acc = msg.Vector3(*now.acc[i].tolist())
        found["imu"] = msg.Imu(body, orientation, angular_velocity=omega, linear_acceleration=acc)
    if now.battery is not None:
        found["battery"] = _battery({name: float(x[i]) for name, x in now.battery.items()}, body)
    return found


def motors(rpm: ArrayLike) -> msg.Float64MultiArray:
    """Message of rotor speeds (4,), RPM."""
    layout = msg.MultiArrayLayout((msg.MultiArrayDimension("rotor, RPM", 4, 4),))
    return msg.Float64MultiArray(layout, tuple(np.asarray(rpm, float).tolist()))


def _battery(reading: dict[str, float], header: msg.Header) -> msg.BatteryState:
    """Message of a battery, with NaN for unknown readings."""
    unknown = math.nan
    charge, capacity = (reading.get(name, unknown) / _AMPERE_HOUR for name in ("charge", "capacity"))
    readings = {
        "voltage": reading.get("voltage", unknown),
        "temperature": unknown,
        "current": -reading.get("current", unknown),
        "charge": charge,
        "capacity": capacity,
        "design_capacity": capacity,
        "percentage": charge / capacity if capacity else unknown,
    }
    rounded: dict[str, Any] = {name: float(np.float32(value)) for name, value in readings.items()}  # as they arrive
    return msg.BatteryState(
        header,
        **rounded,
        power_supply_status=_DISCHARGING,
        power_supply_health=_HEALTH_GOOD,
        power_supply_technology=_LITHIUM_POLYMER,
        present=True,
    )


def image_messages(rgb: np.ndarray, camera: Camera, i: int, ns: int) -> dict[str, msg.Message]:
    """Messages of the image (h, w, 4) of the camera of drone `i` and of its calibration."""
    header = msg.Header(stamp(ns), f"{topics.drone(i)}/camera_optical_frame")
    height, width = rgb.shape[:2]
    pixels = np.ascontiguousarray(rgb[..., :3])
    image = msg.Image(header, height, width, "rgb8", step=3 * width, data=pixels.tobytes())
    return {"camera/image_raw": image, "camera/camera_info": camera_info(camera, header)}


def camera_info(camera: Camera, header: msg.Header) -> msg.CameraInfo:
    """Calibration of a camera: pinhole, no distortion, pixel centers at integers."""
    (width, height), (across, down) = camera.resolution, camera.principal_point
    fx, fy = (pixels / 2 / slope for pixels, slope in zip(camera.resolution, camera.slopes, strict=True))
    cx, cy = width / 2 + across - 0.5, height / 2 + down - 0.5
    return msg.CameraInfo(
        header,
        height,
        width,
        "plumb_bob",
        d=(0.0,) * 5,
        k=(fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0),
        r=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        p=(fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0),
    )


def to_body(quat: np.ndarray, v: np.ndarray) -> np.ndarray:
    """R^T v of every row of `quat` (n, 4) and `v` (n, 3): v - w t + u x t with t = 2 u x v and q = (u, w)."""
    t = 2 * np.cross(quat[:, :3], v)
    return v - quat[:, 3:] * t + np.cross(quat[:, :3], t)


class Refused(UserError):
    """Invalid message; errors of one `kind` differ only in values."""

    def __init__(self, field: str, found: str, advice: str):
        super().__init__(f"its {field} {found}; {advice}")
        self.kind = field, advice


def to_command(name: str, message: Any) -> Command:
    """Convert a message of the topic `name` of `topics.COMMANDS` to a command of one drone.

    Raises:
        Refused: numbers that are not finite or too large, an unknown frame, a zero quaternion, or a wrong number of
            rotors.
    """
    if name == "cmd_motors":
        if len(message.data) != 4:
            raise Refused("data", f"has {len(message.data)} numbers", "give 4 rotor speeds, RPM")
        return Command.zero(Mode.MOTORS, rpm=_finite(message.data, "data"))
    if name == "cmd_pose":
        frame = message.header.frame_id
        if frame not in ("", topics.WORLD):
            raise Refused("frame_id", f"is {frame!r}", f"give poses in {topics.WORLD!r}")
        x, y, z, w = _finite(numbers(message.pose.orientation), "orientation")
        length = math.hypot(x, y, z, w)
        if not abs(length - 1) < 1e-3:
            raise Refused("orientation", f"has length {length:g}", "give a unit quaternion (x, y, z, w)")
        yaw = yaw_of(x, y, z, w)
        return Command.zero(Mode.POSITION, pos=_finite(numbers(message.pose.position), "position"), yaw=yaw)
    linear, angular = _finite(numbers(message.linear), "linear"), _finite(numbers(message.angular), "angular")
    if name == "cmd_vel":
        return Command.zero(Mode.VELOCITY, vel=linear, yaw_rate=angular[2])
    if linear[2] < 0:
        raise Refused("linear.z, the collective thrust per mass,", f"is {linear[2]:g} m/s^2", "give 0 or more")
    return Command.zero(Mode.RATES, omega=angular, thrust=linear[2])


def numbers(vector: Any) -> tuple[float, ...]:
    """Components of a point, a vector or a quaternion."""
    return tuple(getattr(vector, field.name) for field in msg.fields(vector.NAME))


def _finite(values: tuple[float, ...], name: str) -> tuple[float, ...]:
    if not all(abs(x) <= _LARGEST for x in values):
        raise Refused(name, f"is {short_repr(values)}", f"give finite numbers, at most {_LARGEST:g}")
    return values
