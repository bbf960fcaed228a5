"""Ports of the simulated Crazyflie, packet by packet; test_cflib.py has the real client."""

import dataclasses
import math
import struct
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jaxdrones import State, rotation
from jaxdrones.control import firmware_pid
from jaxdrones.firmware.crazyflie.commander import LEVEL_AFTER, OFF_AFTER, Commander, decompress
from jaxdrones.firmware.crazyflie.firmware import Crazyflie
from jaxdrones.firmware.crazyflie.high_level import HighLevel
from jaxdrones.firmware.crazyflie.log import TOC, Log
from jaxdrones.firmware.crazyflie.packet import E2BIG, EEXIST, ENOENT, ENOMEM, MAX_DATA, Packet, Port, decode, encode
from jaxdrones.firmware.crazyflie.parameters import GAINS, Parameters
from jaxdrones.firmware.crazyflie.planner import Goal, go_to
from jaxdrones.firmware.crazyflie.server import Server
from jaxdrones.firmware.crazyflie.supervisor import Supervisor
from jaxdrones.firmware.crazyflie.toc import TYPES, Toc
from jaxdrones.firmware.crazyflie.variables import VARIABLES, Readings
from jaxdrones.firmware.crazyflie.vehicle import Sample, _in_world, motors_off, target

SAMPLE = Sample(
    pos=np.array([1.0, 2, 3]),
    quat=np.array([0.0, 0, 0, 1]),
    vel=np.array([4.0, 5, 6]),
    omega=np.deg2rad([7.0, 8, 9]),
    rpm=np.ones(4),
    acc=np.array([0.0, 0, 9.8]),
    rpy=np.array([10.0, 11, 12]),
    motors=np.array([1e4, 2e4, 3e4, 4e4]),
)


def test_a_packet_is_what_it_was_after_the_wire():
    for port in range(16):
        for channel in range(4):
            packet = Packet(port, channel, bytes(range(MAX_DATA)))
            assert decode(encode(packet)) == packet
    assert encode(Packet(5, 2, b"")) == b"\x5e"  # the port in the upper four bits, the channel in the lowest two


@pytest.mark.parametrize("datagram", [b"", b"\x5c" + bytes(MAX_DATA + 1), bytes(2000)])
def test_other_datagrams_are_no_packets(datagram):
    assert decode(datagram) is None


def test_every_name_fits_into_a_packet():
    toc = Parameters(firmware_pid.gains()).toc
    for table in (toc, TOC):
        for i in range(len(table.names)):
            assert len(table.answer(struct.pack("<BH", 2, i))) <= MAX_DATA


def test_a_table_is_described_by_its_size_and_its_checksum():
    answers = [Toc({"a.b": 1, "a.c": kind}).answer(b"\3") for kind in (1, 1, 2)]
    assert struct.unpack("<BHI", answers[0])[:2] == (3, 2)
    assert answers[0] == answers[1] != answers[2]
    assert Toc({"a.b": 7}).answer(struct.pack("<BH", 2, 0)) == b"\2\0\0\7a\0b\0"
    assert Toc({"a.b": 7}).answer(struct.pack("<BH", 2, 1)) == bytes([2, ENOENT])
    assert Toc({f"a.{i}": 1 for i in range(300)}).answer(b"\1")[:2] == b"\1\xff"  # of older clients, in a byte


def test_numbers_are_limited_to_their_type():
    assert TYPES["uint8_t"].pack(300.7) == b"\xff" and TYPES["int8_t"].pack(-300) == b"\x80"
    assert TYPES["uint16_t"].pack(0x1234) == b"\x34\x12"
    assert TYPES["int16_t"].pack(math.nan) == b"\0\0" and TYPES["uint32_t"].pack(math.inf) == b"\xff" * 4
    assert TYPES["FP16"].unpack(TYPES["FP16"].pack(1e9)) == 65504.0


def parameter(parameters, name):
    return struct.pack("<H", parameters.toc.names.index(name))


def test_a_gain_that_is_set_acts_and_no_other():
    changed = []
    gains = firmware_pid.gains()
    parameters = Parameters(gains, changed.append)
    for name, (field, i) in GAINS.items():
        number = parameter(parameters, name)
        assert struct.unpack("<f", parameters.answer(1, number)[3:])[0] == pytest.approx(
            float(getattr(gains, field)[i])
        )
        assert parameters.answer(2, number + struct.pack("<f", 7.5)) == number + struct.pack("<f", 7.5)
        assert getattr(changed[-1], field)[i] == 7.5
    assert all(np.all(np.asarray(getattr(changed[-1], field)[i]) == 7.5) for field, i in GAINS.values())
    first = Parameters(gains, changed.append)
    first.answer(2, parameter(first, "pid_rate.pitch_kp") + struct.pack("<f", 1.0))
    np.testing.assert_array_equal(changed[-1].rate_p, [gains.rate_p[0], 1.0, gains.rate_p[2]])
    np.testing.assert_array_equal(changed[-1].pos_p, gains.pos_p)


def test_wrong_writes_change_nothing():
    parameters = Parameters(firmware_pid.gains())
    before = dict(parameters.values)
    gain, deck = parameter(parameters, "pid_rate.roll_kp"), parameter(parameters, "deck.bcFlow2")
    for data in (gain + b"\0", gain + struct.pack("<f", math.nan), deck + b"\0", b"\xff\xff\0", b"\1", b""):
        parameters.answer(2, data)
    assert parameters.values == before
    assert parameters.answer(1, b"\xff\xff") == b"\xff\xff" + bytes([ENOENT])


def test_a_parameter_is_set_by_its_name_and_its_default_is_told():
    parameters = Parameters(firmware_pid.gains())
    name = b"pid_rate\0roll_kp\0"
    assert parameters.answer(3, b"\0" + name + b"\6" + struct.pack("<f", 3.0)) == b"\0" + name + b"\0"
    assert parameters["pid_rate.roll_kp"] == 3.0
    number = parameter(parameters, "pid_rate.roll_kp")
    assert parameters.answer(3, b"\x08" + number) == b"\x08" + number + b"\0" + struct.pack("<f", 250.0)
    assert parameters.answer(3, b"\7" + number) == b"\7" + number + bytes([ENOENT])  # no extended type


def test_an_answer_is_a_packet_also_to_a_name_without_an_end():
    assert len(Parameters(firmware_pid.gains()).answer(3, b"\0" + b"x" * (MAX_DATA - 1))) <= MAX_DATA


def test_a_plan_of_any_velocity_is_one_of_numbers():
    commander = make_commander()
    for height, velocity in (1e30, 1e-30), (1.0, 1e30):
        plan(commander, 9, "f?f?f", height, False, 0.0, True, velocity)
        goal = commander.high_level.trajectory.at(0.5)
        assert np.isfinite(np.concatenate([goal.pos, goal.vel, goal.acc])).all()


def variable(name, kind):
    return struct.pack("<BH", TYPES[kind].log, TOC.names.index(name))


def test_a_block_is_sent_at_its_period_with_its_variables_in_order():
    log, now = Log(), Readings(SAMPLE, motors_off(), 1 << 4)
    made = variable("stateEstimate.y", "float") + variable("motor.m3", "uint32_t")
    assert log.answer(1, b"\6\5" + made) == b"\6\5\0"
    assert log.answer(1, b"\7\5" + variable("sys.isFlying", "uint8_t")) == b"\7\5\0"
    assert [*log.rows(2, now)] == []
    assert log.answer(1, b"\3\5\2") == b"\3\5\0"  # every 20 ms
    packets = {row: [p for p in log.rows(row, now)] for row in range(1, 7)}
    assert [row for row, sent in packets.items() if sent] == [2, 4, 6]
    assert packets[4][0] == Packet(5, 2, b"\5" + b"\x28\0\0" + struct.pack("<fIB", 2.0, 30000, 1))
    assert log.answer(1, b"\4\5") == b"\4\5\0" and [*log.rows(8, now)] == []


def test_mistakes_with_blocks_have_error_numbers():
    log = Log()
    one = variable("stateEstimate.x", "float")
    assert log.answer(1, b"\6\1" + one)[2] == 0
    assert log.answer(1, b"\6\1" + one)[2] == EEXIST
    assert log.answer(1, b"\6\2" + 7 * one)[2] == E2BIG
    assert log.answer(1, b"\3\2\1")[2] == ENOENT and log.answer(1, b"\6\3\7\xff\xff")[2] == ENOENT
    assert log.answer(1, b"\5") == b"\5\0\0" and log.answer(1, b"\3\1\1")[2] == ENOENT  # all blocks are gone
    assert log.answer(1, b"") == b""


def test_a_client_has_16_blocks_and_128_variables_at_most():
    log, one = Log(), variable("pm.state", "int8_t")
    assert [log.answer(1, bytes([6, number]) + one)[2] for number in range(17)] == [0] * 16 + [ENOMEM]
    log.answer(1, b"\5")
    assert [log.answer(1, bytes([6, number]) + 26 * one)[2] for number in range(5)] == [0] * 4 + [ENOMEM]
    assert log.answer(1, b"\6\5" + 24 * one)[2] == 0


def test_logged_angles_and_rates_are_degrees_and_accelerations_multiples_of_gravity():
    now = Readings(SAMPLE, motors_off(), 0)
    read = {name: variable.read(now) for name, variable in VARIABLES.items()}
    assert [read[f"gyro.{axis}"] for axis in "xyz"] == pytest.approx([7, 8, 9])
    assert [read[f"stabilizer.{axis}"] for axis in ("roll", "pitch", "yaw")] == [10, 11, 12]
    assert (read["acc.z"], read["stateEstimate.az"]) == pytest.approx((1, 0))
    assert [read[f"stateEstimate.v{axis}"] for axis in "xyz"] == [4, 5, 6]
    assert read["range.zrange"] == 3000  # mm


def test_logged_accelerations_are_in_world_axes():
    to_the_right = dataclasses.replace(SAMPLE, quat=np.array([0.5**0.5, 0, 0, 0.5**0.5]))  # rolled by a quarter
    now = Readings(to_the_right, motors_off(), 0)
    found = [VARIABLES[f"stateEstimate.a{axis}"].read(now) for axis in "xyz"]
    np.testing.assert_allclose(found, [0, -1, -1], atol=1e-12)


@pytest.mark.parametrize(("name", "bit"), [("armed", 1), ("canfly", 3), ("isFlying", 4), ("isTumbled", 5)])
def test_states_of_the_supervisor_are_logged(name, bit):
    read = VARIABLES[f"sys.{name}"].read
    assert [read(Readings(SAMPLE, motors_off(), 1 << k)) for k in range(10)] == [k == bit for k in range(10)]


def make_commander():
    parameters = Parameters(firmware_pid.gains())
    return Commander(parameters, HighLevel(parameters.values))


def generic(kind, *values, form="ffff"):
    commander = make_commander()
    commander.generic(0, struct.pack("<B" + form, kind, *values), 0.0)
    return commander.target(0.0)


def test_hover_set_points_go_along_the_heading_and_hold_the_height():
    found = generic(10, 0.1, 0.2, 90.0, 0.5)
    assert found.in_heading and not found.yaw_given and found.yaw_rate == pytest.approx(math.pi / 2)  # to the left
    np.testing.assert_allclose(found.setpoint.vel, [0.1, 0.2, 0])
    assert found.setpoint.by_pos.tolist() == [False, False, True] and found.setpoint.pos[2] == 0.5
    assert generic(5, 0.1, 0.2, 90.0, 0.5).yaw_rate == pytest.approx(-math.pi / 2)  # legacy: clockwise
    assert generic(2, 0.0, 0.0, 90.0, 0.5).yaw_rate == pytest.approx(-math.pi / 2)
    assert generic(9, 0.0, 0.0, 90.0, 0.5).yaw_rate == pytest.approx(math.pi / 2)


def test_velocities_and_positions_are_in_the_world():
    vel = generic(8, 0.1, 0.2, 0.3, -90.0)
    assert not vel.in_heading and vel.yaw_rate == pytest.approx(-math.pi / 2) and not vel.setpoint.by_pos.any()
    np.testing.assert_allclose(vel.setpoint.vel, [0.1, 0.2, 0.3])
    pos = generic(7, 1.0, 2.0, 3.0, 90.0)
    assert pos.yaw_given and pos.setpoint.rpy[2] == pytest.approx(math.pi / 2) and pos.setpoint.by_pos.all()
    np.testing.assert_allclose(pos.setpoint.pos, [1, 2, 3])


def test_a_pitch_on_the_wire_is_positive_nose_up():
    for found in (
        generic(9, 10.0, 20.0, 0.0, 0.5),
        generic(4, 10.0, 20.0, 0.0, 0.5),
        generic(11, 10.0, 20.0, 0.0, 30000, 0, form="fffHB"),
    ):
        np.testing.assert_allclose(np.rad2deg(found.setpoint.rpy[:2]), [10, -20])
        assert found.setpoint.tilt_given
    rates = generic(11, 10.0, 20.0, 30.0, 30000, 1, form="fffHB").setpoint
    np.testing.assert_allclose(np.rad2deg(rates.omega[:2]), [10, -20])
    assert rates.rates_given.all() and rates.thrust == 30000


def compress(quat):
    """Bits of a quaternion, from the description in the firmware."""
    largest = int(np.argmax(np.abs(quat)))
    quat = quat * np.sign(quat[largest])
    bits = largest
    for i in range(4):
        if i != largest:
            bits = bits << 10 | int(quat[i] < 0) << 9 | round(511 * abs(quat[i]) * math.sqrt(2))
    return bits


def test_a_full_state_has_a_position_in_mm_and_its_heading_in_a_compressed_attitude():
    rng = np.random.default_rng(0)
    for _ in range(50):
        quat = rng.normal(size=4)
        quat /= np.linalg.norm(quat)
        assert abs(decompress(compress(quat)) @ quat) > 1 - 1e-5
    quat = np.array([0, 0, math.sin(0.4), math.cos(0.4)])
    found = generic(6, 1000, -2000, 500, 100, -200, 50, 0, 0, 0, compress(quat), 0, 0, 0, form="hhhhhhhhhIhhh")
    np.testing.assert_allclose(found.setpoint.pos, [1, -2, 0.5])
    np.testing.assert_allclose(found.setpoint.vel, [0.1, -0.2, 0.05])
    assert found.setpoint.rpy[2] == pytest.approx(0.8, abs=2e-3)


def rpyt(commander, roll=0.0, pitch=0.0, yaw=0.0, thrust=0, t=0.0):
    commander.rpyt(struct.pack("<fffH", roll, pitch, yaw, thrust), t)
    return commander.target(t)


def test_thrust_is_locked_until_it_was_zero_and_its_yaw_rate_is_clockwise():
    commander = make_commander()
    assert rpyt(commander, thrust=30000).setpoint.thrust == 0
    rpyt(commander)
    found = rpyt(commander, roll=10, pitch=20, yaw=90, thrust=65000)
    assert found.setpoint.thrust == 60000 and found.yaw_rate == pytest.approx(-math.pi / 2)
    np.testing.assert_allclose(np.rad2deg(found.setpoint.rpy[:2]), [10, -20])


def test_a_yaw_angle_is_counterclockwise_in_its_mode():
    commander = make_commander()
    commander._parameters.values["flightmode.stabModeYaw"] = 1.0
    found = rpyt(commander, yaw=90)
    assert found.yaw_given and found.setpoint.rpy[2] == pytest.approx(math.pi / 2)


@pytest.mark.parametrize("by_rate", [(False, False), (True, False), (False, True), (True, True)])
def test_roll_and_pitch_are_angles_or_rates_by_a_mode_each(by_rate):
    commander = make_commander()
    for axis, is_rate in zip(("Roll", "Pitch"), by_rate, strict=True):
        commander._parameters.values[f"flightmode.stabMode{axis}"] = float(not is_rate)
    rpyt(commander)
    found = rpyt(commander, roll=10, pitch=20, thrust=30000).setpoint
    followed = np.where(found.rates_given, found.omega[:2], found.rpy[:2])
    np.testing.assert_allclose(np.rad2deg(followed), [10, -20])
    assert found.tilt_given and found.rates_given.tolist() == list(by_rate)


def test_without_set_points_the_vehicle_levels_and_then_stops():
    commander = make_commander()
    commander.generic(0, struct.pack("<Bffff", 10, 0.5, 0.0, 90.0, 0.4), 0.0)
    assert commander.target(LEVEL_AFTER - 0.01).setpoint.vel[0] == 0.5
    level = commander.target(LEVEL_AFTER + 0.01)
    assert level.setpoint.tilt_given and not level.setpoint.rpy[:2].any() and level.yaw_rate == 0
    assert level.setpoint.by_pos[2] and level.setpoint.pos[2] == pytest.approx(0.4)
    off = commander.target(OFF_AFTER + 0.01)
    assert off.setpoint.thrust_given and off.setpoint.thrust == 0


def test_the_last_set_point_of_a_stream_holds_for_the_time_that_its_end_says():
    commander = make_commander()
    commander.generic(0, struct.pack("<Bffff", 10, 0.5, 0.0, 0.0, 0.4), 0.0)
    commander.generic(1, struct.pack("<BI", 0, 5000), 0.1)
    assert commander.target(5.0).setpoint.vel[0] == 0.5 and commander.target(5.2).setpoint.thrust_given


@pytest.mark.parametrize(
    "data", [b"", b"\x0a", b"\x0a" + bytes(15), b"\xc8" + bytes(16), b"\x08" + struct.pack("<4f", *[math.nan] * 4)]
)
def test_invalid_set_points_are_ignored(data):
    commander = make_commander()
    commander.generic(0, data, 0.0)
    commander.rpyt(data, 0.0)
    assert commander.target(0.0).setpoint.thrust_given


@pytest.mark.parametrize("angle", [math.nan, math.inf])
def test_angles_that_are_not_finite_are_ignored(angle):
    commander = make_commander()
    before = [rpyt(commander), rpyt(commander, roll=5, thrust=30000)][-1]
    for name in ("roll", "pitch", "yaw"):
        assert rpyt(commander, thrust=40000, **{name: angle}) is before


def plan(commander, kind, form, *values, t=0.0):
    return commander.plan(struct.pack("<BB" + form, kind, 0, *values), t, dataclasses.replace(SAMPLE, pos=np.zeros(3)))


def test_a_stream_ends_a_plan_and_a_plan_waits_for_the_end_of_a_stream():
    commander = make_commander()
    plan(commander, 7, "ff?f", 1.0, 0.0, False, 2.0)
    assert commander.target(3.0).setpoint.pos[2] == pytest.approx(1.0)
    commander.generic(0, struct.pack("<Bffff", 7, 0, 0, 0.3, 0), 3.0)
    assert commander.high_level.trajectory is None and commander.target(3.0).setpoint.pos[2] == pytest.approx(0.3)
    plan(commander, 7, "ff?f", 1.0, 0.0, False, 2.0, t=3.1)  # while the stream is valid
    assert commander.target(3.1).setpoint.pos[2] == pytest.approx(0.3)
    commander.generic(1, struct.pack("<BI", 0, 0), 3.2)
    plan(commander, 7, "ff?f", 1.0, 0.0, False, 2.0, t=3.3)
    assert commander.target(5.4).setpoint.pos[2] == pytest.approx(1.0)


def test_heights_and_headings_may_be_relative():
    commander, yaw = make_commander(), math.radians(12)  # that of the drone
    for kind, height, reached in (9, 1.0, 1.0), (10, 0.4, 0.6):
        plan(commander, kind, "f?f?f", height, True, 0.3, kind == 9, 0.5, t=3.0 * kind)
        end = commander.high_level.trajectory.at(3.0 * kind + 2)
        assert end.pos[2] == pytest.approx(reached) and end.yaw == pytest.approx(yaw if kind == 9 else 0.3)
    plan(commander, 12, "??fffff", True, False, 0.0, 0.0, 0.0, 0.2, 1.0, t=33.0)
    assert commander.high_level.trajectory.at(34.0).yaw == pytest.approx(0.5)


def test_commands_for_other_groups_are_not_for_this_drone():
    commander = make_commander()
    commander.plan(b"\0\2", 0.0, SAMPLE)
    for group, flies in (4, False), (6, True):
        assert commander.plan(struct.pack("<BBff?f", 7, group, 1.0, 0.0, False, 2.0), 0.0, SAMPLE)[3] == 0
        assert (commander.high_level.trajectory is not None) == flies


def test_a_trajectory_may_begin_at_the_heading_of_the_drone():
    commander, yaw = make_commander(), math.radians(12)
    piece = np.zeros(33, "<f4")
    piece[24], piece[-1] = 0.5, 2.0  # its heading and its duration
    commander.high_level.memory[:132] = piece.tobytes()
    plan(commander, 6, "BBIB", 1, 0, 0, 1)
    for relative in True, False:
        data = struct.pack("<BB???Bf", 13, 0, False, relative, False, 0, 1.0)
        assert commander.plan(data, 0.0, dataclasses.replace(SAMPLE, pos=np.zeros(3)))[3] == 0
        assert commander.high_level.trajectory.at(1.0).yaw == pytest.approx(yaw if relative else 0.5)
        commander.off()


def test_after_a_landing_the_motors_stop():
    commander = make_commander()
    plan(commander, 7, "ff?f", 1.0, 0.0, False, 2.0)
    plan(commander, 8, "ff?f", 0.0, 0.0, False, 2.0, t=3.0)
    assert not commander.target(4.9).setpoint.thrust_given
    assert commander.target(5.1).setpoint.thrust_given


def test_a_take_off_or_landing_without_a_velocity_has_that_of_the_parameters():
    commander = make_commander()
    plan(commander, 9, "f?f?f", 1.0, False, 0.0, True, 0.0)
    assert commander.high_level.trajectory.duration == pytest.approx(1 / 0.5)
    set_by_name = b"\0hlCommander\0vland\0" + struct.pack("<Bf", TYPES["float"].parameter, 0.25)
    commander._parameters.answer(3, set_by_name)
    plan(commander, 10, "f?f?f", 0.0, False, 0.0, True, 0.0, t=3.0)
    assert commander.high_level.trajectory.duration == pytest.approx(1 / 0.25)


@pytest.mark.parametrize(
    "data", [b"", b"\7", b"\7" + bytes(30), b"\x0b" + bytes(24), b"\7\0" + struct.pack("<ff?f", *[math.nan] * 2, 0, 1)]
)
def test_invalid_plans_are_answered_with_an_error(data):
    commander = make_commander()
    assert commander.plan(data, 0.0, SAMPLE)[3] and commander.high_level.trajectory is None


def test_a_trajectory_begins_and_ends_as_it_should_and_turns_the_shorter_way():
    start = Goal(np.array([1.0, 0, 0]), np.array([0.3, 0, 0]), np.array([0, 0.2, 0]), 3.0, 0.1)
    way = go_to(start, np.array([2.0, 3, 4]), -3.0, 2.5, begin=10.0)
    for name in ("pos", "vel", "acc", "yaw", "yaw_rate"):
        np.testing.assert_allclose(getattr(way.at(10.0), name), getattr(start, name), atol=1e-9)
    end = way.at(12.5)
    np.testing.assert_allclose(end.pos, [2, 3, 4])
    assert not end.vel.any() and not end.acc.any() and end.yaw == pytest.approx(2 * math.pi - 3)
    t, h = 11.2, 1e-4
    np.testing.assert_allclose((way.at(t + h).pos - way.at(t - h).pos) / (2 * h), way.at(t).vel, rtol=1e-6)
    np.testing.assert_allclose((way.at(t + h).vel - way.at(t - h).vel) / (2 * h), way.at(t).acc, rtol=1e-6)


def test_the_vehicle_tumbles_locks_and_recovers():
    upside_down = SimpleNamespace(quat=np.array([1.0, 0, 0, 0]), motors=np.zeros(4))
    supervisor = Supervisor()
    for k in range(150):
        supervisor.watch(upside_down, 0.01 * k, 0.01)
    assert supervisor.tumbled and not supervisor.can_fly
    assert supervisor.answer(1, b"\2", 2.0, 0)[0] == 0x82 and supervisor.can_fly and supervisor.recovery_asked
    assert supervisor.answer(1, b"\1\0", 2.0, 0) == bytes([0x81, 1, 0]) and not supervisor.can_fly
    supervisor.answer(1, b"\1\1", 2.0, 0)
    supervisor.answer(1, b"\4", 2.0, 0)
    level = SimpleNamespace(quat=np.array([0.0, 0, 0, 1]), motors=np.zeros(4))
    supervisor.watch(level, 2.9, 0.01)
    assert supervisor.can_fly
    supervisor.watch(level, 3.1, 0.01)  # the watchdog was not repeated
    assert supervisor.locked and not supervisor.can_fly


def test_the_state_tells_whether_motors_turn_and_has_its_low_byte_first():
    supervisor = Supervisor()
    still = dataclasses.replace(SAMPLE, motors=np.zeros(4))
    assert [supervisor.status(x, False, False) >> 4 & 1 for x in (SAMPLE, still)] == [1, 0]
    assert supervisor.answer(0, b"\x0c", 0.0, 0x0102) == b"\x8c\2\1"


def test_eight_clients_are_answered_until_one_is_silent_for_five_seconds():
    vehicle: Any = SimpleNamespace(gains=firmware_pid.gains(), sample=SAMPLE, advance=lambda target: SAMPLE)
    crazyflie = Crazyflie(vehicle)

    def heard(client, now):
        return len([*crazyflie.answer(Packet(Port.LINK, 1, b""), client, now)]) > 0

    assert [heard(client, 0.1 * client) for client in range(9)] == [True] * 8 + [False]
    for now, free in (4.9, False), (5.0, True):
        assert not [*crazyflie.advance(now)] and heard("new", now) == free


def test_there_is_one_memory_of_4096_bytes_for_trajectories():
    crazyflie = Crazyflie(SimpleNamespace(gains=firmware_pid.gains(), sample=SAMPLE))
    asked = (crazyflie.answer(Packet(Port.MEMORY, 0, data), "client", 0.0) for data in (b"\1", b"\2\0"))
    (*_, number), (about,) = map(list, asked)
    assert number.data == b"\1\1" and about.data == struct.pack("<BBBIQ", 2, 0, 0x12, 4096, 0)


def test_a_crazyflie_is_reached_from_this_computer_only():
    with Server(SimpleNamespace(), 0) as server:
        assert server._socket.getsockname() == ("127.0.0.1", server.port)


def test_what_is_written_to_the_memory_is_read_up_to_the_size_of_a_packet():
    """Older versions of cflib write 25 bytes at once, which fill a packet; an answer has room for 24."""
    vehicle: Any = SimpleNamespace(gains=firmware_pid.gains(), sample=SAMPLE)
    crazyflie, content = Crazyflie(vehicle), bytes(range(25))

    def ask(channel, address, data):
        *_, answer = crazyflie.answer(
            Packet(Port.MEMORY, channel, struct.pack("<BI", 0, address) + data), "client", 0.0
        )
        return answer.data[5:]

    assert ask(2, 7, content) == b"\0"
    assert ask(1, 7, b"\x18") == b"\0" + content[:24] and ask(1, 31, b"\1") == b"\0" + content[24:]
    assert ask(1, 7, b"\x19") == ask(2, 4090, content) == bytes([ENOENT])


def test_a_velocity_along_the_heading_is_turned_by_the_present_yaw():
    """Of the drone, tilted or not; another velocity is that of the world."""
    yaw, vel = 0.7, np.array([1.0, 2, 3])
    state = State(*(np.zeros(k) for k in (3, 4, 3, 3, 4))).replace(quat=rotation.from_rpy(np.array([0.2, -0.1, yaw])))
    found = [_in_world(state, np.array(2.0), target(vel=vel, in_heading=way)).vel for way in (True, False)]
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    np.testing.assert_allclose(found, [turn @ vel, vel], rtol=1e-6)
