"""Packets and MSP: bytes as Betaflight's C structures have them, and signs as its axes have them."""

import contextlib
import dataclasses
import socket
import struct

import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones import load_params
from jaxdrones.envs import make
from jaxdrones.errors import UserError
from jaxdrones.firmware import drone
from jaxdrones.firmware.betaflight import Hover, Simulation, Sticks, TakeOff, link, msp, settings, sticks_for
from jaxdrones.firmware.betaflight.packets import motor_order, motor_outputs, rc_packet, state_packet
from jaxdrones.firmware.betaflight.pilots import Flip
from jaxdrones.firmware.drone import Sample
from jaxdrones.tasks.hover import hover
from jaxdrones.training.betaflight_pilot import PolicyPilot

LEVEL = np.array([0.0, 0, 0, 1])


def state(**given):
    start = dict(t=1.5, quat=LEVEL, omega=np.zeros(3), specific_force=np.zeros(3))
    return struct.unpack("<18d", state_packet(**(start | given)))


def test_a_state_packet_is_18_doubles_with_the_time_first_and_the_pressure_last():
    packet = state()
    assert packet[0] == 1.5 and packet[17] == 101325.0 and packet[11:17] == (0.0,) * 6


def test_rates_are_those_about_forward_right_and_down():
    assert state(omega=np.array([1.0, 2, 3]))[1:4] == (1.0, -2.0, -3.0)


def test_the_specific_force_is_sent_with_the_opposite_sign():
    assert state(specific_force=np.array([1.0, 2, 9.8]))[4:7] == (-1.0, -2.0, -9.8)


def test_the_scalar_of_a_quaternion_comes_first():
    assert state(quat=np.array([0.1, 0.2, 0.3, 0.9]))[7:11] == (0.9, 0.1, 0.2, 0.3)


def channels(**sticks):
    packet = struct.unpack("<d16H", rc_packet(2.0, Sticks(**sticks)))
    assert packet[0] == 2.0
    return packet[1:]


def test_sticks_are_in_the_order_roll_pitch_throttle_yaw_and_switches():
    assert channels() == (1500, 1500, 1000, 1500, *[1000] * 12)
    assert channels(roll=0.2, pitch=-0.4, throttle=0.3, yaw=1.0)[:4] == (1600, 1300, 1300, 2000)
    assert channels(armed=True)[4:6] == (2000, 1000) and channels(angle=True)[4:6] == (1000, 2000)


def test_sticks_end_at_their_ends_and_numbers_that_are_none_are_the_center():
    assert channels(roll=9.0, pitch=-9.0, throttle=2.0, yaw=float("nan"))[:4] == (2000, 1000, 2000, 1500)
    assert channels(throttle=float("nan"))[2] == channels(throttle=-1.0)[2] == 1000


def motors(*pulses, count=4):
    return struct.pack("<H2x16f", count, *pulses, *[0.0] * (16 - len(pulses)))


def test_motor_outputs_are_the_share_of_the_pulse_above_1_ms():
    np.testing.assert_allclose(motor_outputs(motors(1000, 1250, 2000, 1055)), [0, 0.25, 1, 0.055], atol=1e-7)
    np.testing.assert_array_equal(motor_outputs(motors(0, 900, 2500, 1500)), [0, 0, 1, 0.5])


@pytest.mark.parametrize(
    "datagram",
    [b"", b"\0", motors(1500)[:-1], motors(1500) + b"\0", motors(1, 2, 3, 4, count=3), motors(float("nan"), 1, 1, 1)],
    ids=["empty", "short", "a byte less", "a byte more", "three motors", "nan"],
)
def test_other_datagrams_are_no_motors(datagram):
    assert motor_outputs(datagram) is None


def test_motors_are_numbered_from_the_rear_right_one_on():
    places = {"rear right": (-1, -1), "front right": (1, -1), "rear left": (-1, 1), "front left": (1, 1)}
    for shuffled in ([0, 1, 2, 3], [3, 1, 0, 2]):
        pos = np.array([[*list(places.values())[i], 0.0] for i in shuffled])
        np.testing.assert_array_equal(motor_order(pos), shuffled)


def test_a_plus_and_rotors_that_turn_alike_are_refused(monkeypatch):
    with pytest.raises(UserError, match="cf2p has rotors on its body axes; give a vehicle in X configuration"):
        Simulation("cf2p")
    racer = load_params("racer")
    monkeypatch.setattr(
        "jaxdrones.firmware.betaflight.simulation.load_params", lambda name: racer.replace(rotor_spin=np.ones(4))
    )
    with pytest.raises(UserError, match="give alternating ones"):
        Simulation("racer")


@pytest.mark.parametrize("sign", [1, -1])
def test_each_rotor_has_the_output_of_its_motor_and_yaw_is_that_of_the_motor_rear_right(sign, monkeypatch):
    racer = load_params("racer")
    racer, commanded = racer.replace(rotor_spin=sign * racer.rotor_spin), []
    monkeypatch.setattr("jaxdrones.firmware.betaflight.simulation.load_params", lambda name: racer)
    with monkeypatch.context() as patched:
        patched.setattr(Simulation, "advance", lambda self, outputs: None)
        simulation = Simulation("racer")
    simulation._advance = lambda team, state, rpm: commanded.append(rpm) or (state, np.zeros(20))
    simulation.advance(np.array([0.1, 0.2, 0.3, 0.4]))
    outputs = {(-1, -1): 0.1, (1, -1): 0.2, (-1, 1): 0.3, (1, 1): 0.4}  # by the signs of x and y
    places = [tuple(np.sign(pos[:2]).astype(int).tolist()) for pos in np.asarray(racer.rotor_pos)]
    np.testing.assert_allclose(commanded[0] / racer.max_rpm, [outputs[place] for place in places], rtol=1e-6)
    assert simulation.reversed_yaw == (racer.rotor_spin[places.index((-1, -1))] < 0)


def test_sticks_for_rates_push_the_way_the_drone_turns():
    racer = load_params("racer")
    hover = sticks_for(racer, float(racer.weight), np.zeros(3))
    assert (hover.roll, hover.pitch, abs(hover.yaw)) == (0, 0, 0) and 0.05 < hover.throttle < 1
    right_down, nose_down, to_the_left = (sticks_for(racer, 1.0, np.deg2rad(350) * axis) for axis in np.eye(3))
    np.testing.assert_allclose([right_down.roll, nose_down.pitch, to_the_left.yaw], [0.5, 0.5, -0.5])


def test_the_throttle_gives_the_thrust_that_is_asked_for():
    """By Betaflight's formulas: a dead band of 50 us, then motors from idle, 5.5 %, to full speed."""
    racer = load_params("racer")
    for share in (0.1, 0.5, 1.0):
        thrust = share * float(racer.max_thrust)
        throttle = (1000 * sticks_for(racer, thrust, np.zeros(3)).throttle - 50) / 950
        rpm = (0.055 + 0.945 * throttle) * float(racer.max_rpm)
        np.testing.assert_allclose(4 * float(racer.kf) * rpm**2, thrust, rtol=1e-6)
    assert sticks_for(racer, 1e9, np.zeros(3)).throttle == 1.0
    assert sticks_for(racer, -1.0, np.zeros(3)).throttle == 0.05


@pytest.mark.parametrize("vehicle", ["cf2x", "agilicious", "hb"])
def test_a_yaw_rate_that_is_slow_by_1_rad_per_s_gives_15_rad_per_s2(vehicle):
    """By Betaflight's formulas: 3.2029e-5 of a motor's range for each degree/s and unit of the gain."""
    drone = load_params(vehicle)
    share = settings.yaw_gain(drone) * 3.2029e-5 * np.rad2deg(1) * (1 - 0.055)
    rpm = float(drone.hover_rpm) + share * float(drone.max_rpm) * np.sign(np.asarray(drone.rotor_spin))
    torque = float(drone.km) * np.sum(np.asarray(drone.rotor_spin) * rpm**2)
    np.testing.assert_allclose(torque / float(drone.inertia[2]), 15.0, rtol=0.06)  # the gain is a whole number


def test_the_yaw_gain_of_propellers_with_little_torque_is_limited():
    assert settings.yaw_gain(load_params("racer")) == 100


def test_a_request_of_msp_has_the_bytes_of_its_specification():
    assert msp.encode(204, b"\x01\x02") == b"$M<\x02\xcc\x01\x02" + bytes([0x02 ^ 0xCC ^ 0x01 ^ 0x02])


@pytest.mark.parametrize("size", [1, 2, 7, 1000])
def test_answers_are_found_in_any_pieces_and_between_other_bytes(size):
    rng = np.random.default_rng(size)
    frames = [msp.Frame(int(rng.integers(256)), rng.bytes(int(rng.integers(255)))) for _ in range(20)]
    noise = [b"", b"$", b"$M", b"#\r\n", b"$M>\x05\x01ab", b"$$M"]
    stream = b"".join(noise[i % len(noise)] + msp.encode(f.command, f.data, b">") for i, f in enumerate(frames))
    decoder, found = msp.Decoder(), []
    for at in range(0, len(stream), size):
        found += decoder.feed(stream[at : at + size])
    assert found == frames


def test_a_wrong_checksum_is_no_answer_and_a_refusal_is_one_that_says_so():
    good = msp.encode(101, b"abc", b">")
    decoder = msp.Decoder()
    assert list(decoder.feed(good[:-1] + bytes([good[-1] ^ 1]))) == []
    assert list(decoder.feed(good)) == [msp.Frame(101, b"abc")]
    assert list(decoder.feed(msp.encode(101, b"", b"!"))) == [msp.Frame(101, b"", failed=True)]


@pytest.fixture
def board():
    """Both ends of a connection of MSP."""
    with contextlib.ExitStack() as stack:
        yield tuple(map(stack.enter_context, socket.socketpair()))


def test_a_request_waits_for_its_own_answer(board):
    ours, theirs = board
    answers = iter([msp.encode(101, b"other", b">"), msp.encode(102, b"own", b">"), msp.encode(103, b"", b"!")])
    client = msp.Client(ours, lambda: theirs.sendall(next(answers)))
    assert client.request(102, b"a") == b"own" and theirs.recv(100) == msp.encode(102, b"a")
    with pytest.raises(msp.NoAnswer, match="Betaflight rejected MSP request 103"):
        client.request(103)
    with pytest.raises(msp.NoAnswer, match="Betaflight closed the MSP connection"):
        msp.Client(ours, theirs.close).request(104)


KEPT = {msp.SET_RC_TUNING: msp.RC_TUNING, msp.SET_PID: msp.PID, msp.SET_FAILSAFE: msp.FAILSAFE}
KEPT |= {msp.SET_ADVANCED: msp.ADVANCED, msp.SET_FILTERS: msp.FILTERS}


class Board:
    """Flight controller that keeps its settings, and answers with them."""

    def __init__(self):
        self.settings = {command: bytes(range(1, 50)) for command in KEPT.values()}

    def request(self, command, data=b""):
        if data:
            self.settings[KEPT.get(command, command)] = data
        return self.settings.get(command, b"")


@pytest.mark.parametrize("reversed_yaw", [False, True])
def test_settings_that_were_read_are_changed_only_where_they_must_be(reversed_yaw):
    board, racer = Board(), load_params("racer")
    before = dict(board.settings)
    assert [settings.configure(board, racer, 1000, reversed_yaw) for _ in range(2)] == [True, False]
    changed = {
        command: [i for i, x in enumerate(data) if x != before[command][i]]
        for command, data in board.settings.items()
        if command in before and command != msp.RC_TUNING
    }
    assert changed == {
        msp.PID: [6],
        msp.FAILSAFE: [0],
        msp.ADVANCED: [1],
        msp.FILTERS: [0, *range(20, 24), *range(29, 33)],
    }
    assert all(len(board.settings[command]) == 49 for command in changed)
    assert board.settings[msp.ADVANCED][1] == 8000 // 2000  # loops at twice the rate of the states
    assert board.settings[msp.SET_MIXER] == bytes([3, reversed_yaw])
    tuning = board.settings[msp.RC_TUNING]
    assert [10 * tuning[i] for i in (0, 2, 3, 4, 11, 12)] == [settings.MAX_RATE] * 6


STATUS = struct.pack("<HHHIBHBB", 125, 0, 35, 1, 0, 12, 4, 0)


def test_the_status_tells_whether_it_is_armed_and_why_not():
    now = settings.parse_status(STATUS + b"\x00" + struct.pack("<BI", 29, 1 << 7 | 1 << 12) + b"\0" * 4)
    assert now == settings.Status(True, 125, ("throttle", "calibrating"))
    more = settings.parse_status(STATUS + b"\xf2ab" + struct.pack("<BI", 29, 1 << 28))
    assert more.reasons == ("arm switch",)


@pytest.mark.parametrize("data", [b"", STATUS, STATUS + b"\x0f", STATUS + b"\0\x1d\0\0"])
def test_a_status_of_another_version_is_a_lack_of_an_answer(data):
    with pytest.raises(msp.NoAnswer, match=r"version 4\.6"):
        settings.parse_status(data)


def test_switches_act_above_1700_us():
    slot, mode, channel, first, last = settings.mode_range(1, 1, 1)
    assert (slot, mode, channel, 900 + 25 * first, 900 + 25 * last) == (1, 1, 1, 1700, 2100)


def sample(roll_rate=0.0):
    return Sample(np.zeros(3), LEVEL, np.zeros(3), np.array([roll_rate, 50.0, 50.0]), np.zeros(4), np.zeros(3))


def test_the_outer_loop_commands_a_force_from_a_thrust_per_mass(monkeypatch):
    racer = load_params("racer")
    monkeypatch.setattr("jaxdrones.firmware.betaflight.pilots._command", lambda *_: (2 * racer.gravity, np.ones(3)))
    assert Hover(racer)(0.0, sample()) == sticks_for(racer, 2 * float(racer.weight), np.ones(3))


def test_the_second_pilot_begins_at_its_own_time_zero():
    pilot = TakeOff(lambda t, _: ("first", t), lambda t, _: ("then", t), after=4.0)
    assert [pilot(t, None) for t in (3.0, 4.0, 5.5)] == [("first", 3.0), ("then", 0.0), ("then", 1.5)]


def test_a_flip_is_a_climb_and_three_quarters_of_a_roll_at_full_stick():
    racer, other = load_params("racer"), Sticks(yaw=0.5)
    flip = Flip(racer, lambda t, _: other, at=1.0)
    assert flip(0.99, sample(10.0)) == other
    assert flip(1.2, sample(10.0)) == sticks_for(racer, 2 * float(racer.weight), np.zeros(3))
    rolled = [flip(1.35 + 0.01 * k, sample(10.0)).roll for k in range(60)]
    assert rolled == [1.0] * 49 + [0.0] * 11  # 0.1 rad a step, until 0.75 of a turn, 4.71 rad


def test_a_long_flight_keeps_its_last_rows(monkeypatch):
    monkeypatch.setattr(drone, "_MOST_ROWS", 3)
    recorder = drone.Recorder()
    for k in range(5):
        recorder.add(float(k), sample())
    assert recorder.log(load_params("racer"), {"vehicle": "racer"}, "").t.tolist() == [2, 3, 4]


def test_twice_as_fast_as_the_clock_is_a_factor_of_two():
    assert (drone.Pace(4.0, 2.0).real_time_factor, drone.Pace().real_time_factor) == (2, 0)


def test_a_drone_stands_on_the_ground_below_it():
    """With the center of its collision shape above its center of mass, that is lower by as much."""
    racer = load_params("racer")
    heights = [float(drone.on_ground(racer.replace(collision_offset=x)).pos[0, 2]) for x in (0.0, 0.01)]
    assert heights[0] - heights[1] == pytest.approx(0.01) and heights[1] > 0
    fallen = drone.on_ground(racer).replace(pos=np.array([[1.0, 2.0, 3.0]]), aux={"charge": np.ones(1)})
    stands = drone.set_upright(racer, fallen)
    np.testing.assert_allclose(stands.pos, drone.on_ground(racer, 1.0, 2.0).pos)
    assert stands.aux == fallen.aux


def test_betaflight_is_reached_from_this_computer_only():
    assert link.HOST == "127.0.0.1"


def test_a_policy_faster_than_the_sticks_is_refused():
    """At 200 Hz it would act at every second of its steps, and its moving target would fly at half of its speed."""
    env = make("hover", vehicle="racer", action="thrust_and_rates", control_hz=200)
    with pytest.raises(UserError, match="the policy acts at 200 Hz, and sticks move at 100 Hz"):
        PolicyPilot(env, lambda obs: obs)


@pytest.mark.slow
def test_a_policy_with_a_load_is_refused_which_the_simulated_drone_would_not_carry():
    with pytest.raises(UserError, match="single drone without cameras, sensors and loads"):
        PolicyPilot(make("sling", vehicle="racer"), lambda obs: obs)


def test_the_variables_of_a_task_follow_the_flight_of_a_policy():
    """As the next gate does: without it, a drone would turn back to the first one."""

    def passed(task, world):
        return {"goal": world.variables["goal"] + world.drones.pos}

    env = make(dataclasses.replace(hover(), advance=passed), vehicle="racer", action="thrust_and_rates")
    pilot, zero, up = PolicyPilot(env, lambda obs: jnp.zeros((1, 4))), np.zeros(3), np.array([0, 0, 1.0])
    heights = [pilot.target[2]]
    for k in range(3):
        pilot(k * env.dt, Sample(up, np.eye(4)[3], zero, zero, np.ones(4), zero))
        heights.append(pilot.target[2])
    np.testing.assert_allclose(np.diff(heights), [0, 1, 1])
