"""Bytes on the wire and in bags: two serializers that know nothing of each other, and this package's types, agree."""

import dataclasses
import random

import numpy as np
import pytest

from jaxdrones.ros2 import messages as msg
from jaxdrones.ros2 import topics

pytestmark = pytest.mark.filterwarnings("default")  # of what rclpy imports

TYPES = sorted(msg.MESSAGES)
TEXT = "drone_0/base_link é"
VALUES = {"bool": True, "uint8": 200, "int32": -7, "uint32": 2**32 - 3, "string": TEXT}


def example(kind, seed):
    """A message of a type with something in every field; lengths of texts and arrays vary, so alignments do."""
    rng = random.Random(seed)

    def value(field):
        def one():
            if field.is_message:
                return example(field.kind, rng.random())
            if field.kind == "string":
                return TEXT[: rng.randrange(len(TEXT))]
            if field.kind == "float32":
                return float(np.float32(rng.normalvariate()))
            return VALUES.get(field.kind, rng.normalvariate())

        if field.length is None:
            return one()
        # At least one: Fast CDR aligns an empty sequence like one with entries, which rosbags rejects as too long.
        entries = [one() for _ in range(field.length or rng.randrange(1, 6))]
        return bytes(entries) if field.kind == "uint8" else tuple(entries)

    return msg.message_class(kind)(**{field.name: value(field) for field in msg.fields(kind)})


@pytest.mark.needs("rclpy", "rosbags")
@pytest.mark.parametrize("name", TYPES)
def test_rclpy_and_rosbags_read_each_others_bytes(name):
    from rclpy.serialization import deserialize_message, serialize_message

    from jaxdrones.ros2.rclpy_transport import ros_class

    for seed in range(5):
        message = example(name, seed)  # the padding between fields is undefined, so the bytes differ there
        received = deserialize_message(msg.serialize(message), ros_class(name))
        assert msg.decode(name, received) == message
        assert msg.deserialize(bytes(serialize_message(received)), name) == message


@pytest.mark.needs("rosbags")
@pytest.mark.parametrize("name", TYPES)
def test_fields_are_those_of_the_message_definitions_of_ros(name):
    from rosbags.typesys import Stores, get_typestore

    for store in (Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED):
        defined = [field for field, _ in get_typestore(store).fielddefs[name][1]]
        assert defined == [field.name for field in msg.fields(name)]


@pytest.mark.needs("rosbags")
def test_a_rotation_is_none_where_it_is_not_given():
    assert msg.Pose().orientation == msg.Quaternion(0.0, 0.0, 0.0, 1.0)


def test_every_topic_has_a_standard_message_type():
    for kind, _ in (topics.OUTPUTS | topics.COMMANDS).values():
        assert dataclasses.is_dataclass(msg.message_class(kind)) and kind in msg.MESSAGES
