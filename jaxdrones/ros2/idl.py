"""CycloneDDS message types, with the DDS names and encoding of ROS 2."""

import functools
from typing import Any

from cyclonedds.idl import IdlStruct, make_idl_struct, types
from cyclonedds.idl.annotations import final

from jaxdrones.ros2 import messages as msg

_KINDS: dict[str, Any] = {
    "bool": bool,
    "uint8": types.uint8,
    "int32": types.int32,
    "uint32": types.uint32,
    "int64": types.int64,
    "uint64": types.uint64,
    "float32": types.float32,
    "float64": types.float64,
    "string": str,
}
_HEADER = {"guid": "uint64", "seq": "int64"}  # of requests and replies in rmw_cyclonedds: client and sequence number


def dds_name(name: str) -> str:
    """DDS name of a message type: `geometry_msgs::msg::dds_::Pose_`."""
    package, _, short = name.split("/")
    return f"{package}::msg::dds_::{short}_"


@functools.cache
def idl_type(name: str) -> Any:
    """CycloneDDS type of a message type, encoded as plain CDR."""
    return _struct(dds_name(name), {field.name: _idl_field(field) for field in msg.fields(name)})


def _struct(name: str, fields: dict[str, Any]) -> type[IdlStruct]:
    struct = make_idl_struct(name.rpartition("::")[2], name, fields)
    final(struct)
    return struct


def _idl_field(field: msg.Field) -> Any:
    base = idl_type(field.kind) if field.is_message else _KINDS[field.kind]
    if field.length is None:
        return base
    if field.length:
        return types.array[base, field.length]
    return bytes if base is types.uint8 else types.sequence[base]  # the same encoding, without a number for every pixel


def encode(message: msg.Message) -> IdlStruct:
    """Convert a message to CycloneDDS."""
    return msg.encode(message, idl_type, lambda field, given: given if field.kind == "uint8" else list(given))


REQUEST = _struct(
    "std_srvs::srv::dds_::Trigger_Request_",
    {name: _KINDS[kind] for name, kind in (_HEADER | {"structure_needs_at_least_one_member": "uint8"}).items()},
)
"""Request of `std_srvs/srv/Trigger`; an empty message has one byte on DDS."""
REPLY = _struct(
    "std_srvs::srv::dds_::Trigger_Response_",
    {name: _KINDS[kind] for name, kind in (_HEADER | {"success": "bool", "message": "string"}).items()},
)
"""Reply of `std_srvs/srv/Trigger`."""
