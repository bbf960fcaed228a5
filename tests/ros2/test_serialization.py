"""Bytes on the wire and in bags: two serializers that know nothing of each other, and this package's types, agree."""

import dataclasses
import random

import numpy as np
import pytest

from jaxdrones.ros2 import messages as msg
from jaxdrones.ros2 import topics

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
        entries = [one() for _ in range(field.length or rng.randrange(6))]
        return bytes(entries) if field.kind == "uint8" else tuple(entries)

    return msg.message_class(kind)(**{field.name: value(field) for field in msg.fields(kind)})


@pytest.mark.needs("cyclonedds", "rosbags")
@pytest.mark.parametrize("name", TYPES)
def test_cyclonedds_and_rosbags_write_the_same_bytes_and_read_each_others(name):
    from jaxdrones.ros2 import bag, idl

    for seed in range(5):
        message = example(name, seed)
        by_cyclone = bytes(idl.encode(message).serialize())
        by_rosbags = bag.serialize(message)
        assert by_cyclone == by_rosbags
        assert bag.deserialize(by_cyclone, name) == message
        assert msg.decode(name, idl.idl_type(name).deserialize(by_rosbags)) == message


@pytest.mark.needs("rosbags")
@pytest.mark.parametrize("name", TYPES)
def test_fields_are_those_of_the_message_definitions_of_ros(name):
    from rosbags.typesys import Stores, get_typestore

    for store in (Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED):
        defined = [field for field, _ in get_typestore(store).fielddefs[name][1]]
        assert defined == [field.name for field in msg.fields(name)]


@pytest.mark.needs("cyclonedds")
def test_names_on_dds_are_those_of_ros():
    from jaxdrones.ros2 import idl

    assert idl.dds_name(msg.PoseStamped.NAME) == "geometry_msgs::msg::dds_::PoseStamped_"
    assert idl.idl_type(msg.PoseStamped.NAME).__idl_typename__ == idl.dds_name(msg.PoseStamped.NAME)


@pytest.mark.needs("cyclonedds")
def test_a_request_is_a_header_of_16_bytes_and_one_byte_for_nothing():
    from jaxdrones.ros2 import idl

    request = idl.REQUEST(guid=0x0102030405060708, seq=2, structure_needs_at_least_one_member=0)
    head = bytes([0, 1, 0, 0, 8, 7, 6, 5, 4, 3, 2, 1, 2, 0, 0, 0, 0, 0, 0, 0, 0])
    assert bytes(request.serialize())[: len(head)] == head


def test_every_topic_has_a_standard_message_type():
    for kind, _ in (topics.OUTPUTS | topics.COMMANDS).values():
        assert dataclasses.is_dataclass(msg.message_class(kind)) and kind in msg.MESSAGES
