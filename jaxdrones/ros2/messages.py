"""The standard ROS 2 messages that are used here, as plain dataclasses that need no ROS.

Fields, their order and their types are those of the `.msg` files of ROS 2 (Humble to Kilted; common_interfaces and
rcl_interfaces). Numbers are Python numbers, arrays of numbers tuples, and `uint8[]` is bytes.
"""

from typing import Annotated

from jaxdrones.ros2.schema import MESSAGES, Field, Message, decode, encode, fields, message_of

__all__ = ["MESSAGES", "Field", "Message", "decode", "encode", "fields"]  # and the types below

Bool = Annotated[bool, "bool"]
UInt8 = Annotated[int, "uint8"]
UInt32 = Annotated[int, "uint32"]
Int32 = Annotated[int, "int32"]
Float32 = Annotated[float, "float32"]
Float64 = Annotated[float, "float64"]
String = Annotated[str, "string"]
Bytes = Annotated[bytes, "uint8[]"]
Float32s = Annotated[tuple[float, ...], "float32[]"]
Float64s = Annotated[tuple[float, ...], "float64[]"]
Matrix3 = Annotated[tuple[float, ...], "float64[9]"]
Matrix34 = Annotated[tuple[float, ...], "float64[12]"]
Matrix6 = Annotated[tuple[float, ...], "float64[36]"]


@message_of("builtin_interfaces")
class Time(Message):
    """A time, s and ns."""

    sec: Int32 = 0
    nanosec: UInt32 = 0


@message_of("std_msgs")
class Header(Message):
    """When, and in which frame."""

    stamp: Time = Time()
    frame_id: String = ""


@message_of("rosgraph_msgs")
class Clock(Message):
    """Simulated time."""

    clock: Time = Time()


@message_of("geometry_msgs")
class Point(Message):
    """A position, m."""

    x: Float64 = 0.0
    y: Float64 = 0.0
    z: Float64 = 0.0


@message_of("geometry_msgs")
class Vector3(Message):
    """A vector."""

    x: Float64 = 0.0
    y: Float64 = 0.0
    z: Float64 = 0.0


@message_of("geometry_msgs")
class Quaternion(Message):
    """A rotation."""

    x: Float64 = 0.0
    y: Float64 = 0.0
    z: Float64 = 0.0
    w: Float64 = 1.0


@message_of("geometry_msgs")
class Pose(Message):
    """Position and attitude."""

    position: Point = Point()
    orientation: Quaternion = Quaternion()


@message_of("geometry_msgs")
class PoseStamped(Message):
    """A pose at a time, in the frame of its header."""

    header: Header = Header()
    pose: Pose = Pose()


@message_of("geometry_msgs")
class Twist(Message):
    """Velocity, m/s, and angular velocity, rad/s."""

    linear: Vector3 = Vector3()
    angular: Vector3 = Vector3()


@message_of("geometry_msgs")
class TwistStamped(Message):
    """A twist at a time, in the frame of its header."""

    header: Header = Header()
    twist: Twist = Twist()


@message_of("geometry_msgs")
class PoseWithCovariance(Message):
    """A pose with its covariance, rows and columns x, y, z and rotations about them."""

    pose: Pose = Pose()
    covariance: Matrix6 = (0.0,) * 36


@message_of("geometry_msgs")
class TwistWithCovariance(Message):
    """A twist with its covariance."""

    twist: Twist = Twist()
    covariance: Matrix6 = (0.0,) * 36


@message_of("nav_msgs")
class Odometry(Message):
    """Pose in the frame of the header, twist in the child frame."""

    header: Header = Header()
    child_frame_id: String = ""
    pose: PoseWithCovariance = PoseWithCovariance()
    twist: TwistWithCovariance = TwistWithCovariance()


@message_of("sensor_msgs")
class Imu(Message):
    """Attitude, angular velocity (rad/s) and specific force (m/s^2) in body axes."""

    header: Header = Header()
    orientation: Quaternion = Quaternion()
    orientation_covariance: Matrix3 = (0.0,) * 9
    angular_velocity: Vector3 = Vector3()
    angular_velocity_covariance: Matrix3 = (0.0,) * 9
    linear_acceleration: Vector3 = Vector3()
    linear_acceleration_covariance: Matrix3 = (0.0,) * 9


@message_of("sensor_msgs")
class BatteryState(Message):
    """A battery: V, degrees Celsius, A (negative when discharging), A h, and the charge as a share of 1."""

    header: Header = Header()
    voltage: Float32 = 0.0
    temperature: Float32 = 0.0
    current: Float32 = 0.0
    charge: Float32 = 0.0
    capacity: Float32 = 0.0
    design_capacity: Float32 = 0.0
    percentage: Float32 = 0.0
    power_supply_status: UInt8 = 0
    power_supply_health: UInt8 = 0
    power_supply_technology: UInt8 = 0
    present: Bool = False
    cell_voltage: Float32s = ()
    cell_temperature: Float32s = ()
    location: String = ""
    serial_number: String = ""


@message_of("sensor_msgs")
class Image(Message):
    """Pixels row by row from the upper left one."""

    header: Header = Header()
    height: UInt32 = 0
    width: UInt32 = 0
    encoding: String = ""
    is_bigendian: UInt8 = 0
    step: UInt32 = 0
    data: Bytes = b""


@message_of("sensor_msgs")
class RegionOfInterest(Message):
    """A part of an image; all of it when zero."""

    x_offset: UInt32 = 0
    y_offset: UInt32 = 0
    height: UInt32 = 0
    width: UInt32 = 0
    do_rectify: Bool = False


@message_of("sensor_msgs")
class CameraInfo(Message):
    """The calibration of a camera: distortion `d`, intrinsic `k`, rectification `r` and projection `p`."""

    header: Header = Header()
    height: UInt32 = 0
    width: UInt32 = 0
    distortion_model: String = ""
    d: Float64s = ()
    k: Matrix3 = (0.0,) * 9
    r: Matrix3 = (0.0,) * 9
    p: Matrix34 = (0.0,) * 12
    binning_x: UInt32 = 0
    binning_y: UInt32 = 0
    roi: RegionOfInterest = RegionOfInterest()


@message_of("std_msgs")
class MultiArrayDimension(Message):
    """One dimension of an array."""

    label: String = ""
    size: UInt32 = 0
    stride: UInt32 = 0


@message_of("std_msgs")
class MultiArrayLayout(Message):
    """The dimensions of an array."""

    dim: Annotated[tuple[MultiArrayDimension, ...], MultiArrayDimension] = ()
    data_offset: UInt32 = 0


@message_of("std_msgs")
class Float64MultiArray(Message):
    """Numbers with the layout of an array."""

    layout: MultiArrayLayout = MultiArrayLayout()
    data: Float64s = ()
