"""The node in one process: what it publishes, flies and does when nobody speaks to it."""

import functools
import math
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from helpers import assert_close, mostly_slow
from in_process import InProcess, Peer, Wire, positions
from ros2_team import HZ, make_simulation, nanoseconds, team_step

import jaxdrones as jd
from jaxdrones.errors import UserError
from jaxdrones.ros2 import Command, Failsafe, Mode, Node, PeerLost, Simulation, command, convert, topics
from jaxdrones.ros2 import messages as msg
from jaxdrones.ros2.failsafe import Watch, sink
from jaxdrones.sensing import Camera

pytestmark = pytest.mark.needs("rosbags")


def make_node(wire, n=2, **options):
    warnings = []
    node = Node(make_simulation(n), InProcess(wire), clock=wire.clock, warn=warnings.append, **options)
    return node, warnings


def test_every_step_is_published_once_for_every_drone():
    wire = Wire()
    node, _ = make_node(wire, speed=2.0)
    flown = node.run(0.2)
    assert wire.now == pytest.approx(0.1, abs=0.01)
    stamps = [nanoseconds(message.clock) for message in wire.sent["clock"]]
    assert stamps == [k * 10_000_000 for k in range(21)]
    for i in range(2):
        for name in ("pose", "twist", "odom", "imu"):
            sent = wire.sent[topics.output(i, name).name]
            assert [nanoseconds(message.header.stamp) for message in sent] == stamps
    assert flown.steps == 20 and flown.published == sum(map(len, wire.sent.values())) and flown.late == 0


@pytest.mark.slow
def test_drones_fly_where_they_are_told():
    wire = Wire()
    node, warnings = make_node(wire, failsafe=Failsafe("hover", timeout=5.0))
    peer = Peer(wire, 2)
    target = np.array([[0.3, 0.0, 1.2], [0.3, 0.5, 0.8]])
    wire.script = [(0.1, lambda: peer.fly_to(target, yaw=0.5))]
    node.run(4.0)
    np.testing.assert_allclose(peer.state().pos, target, atol=0.02)
    np.testing.assert_allclose(2 * np.arctan2(peer.state().quat[:, 2], peer.state().quat[:, 3]), 0.5, atol=0.05)
    assert warnings == []


@pytest.mark.slow
def test_velocities_turn_with_the_heading():
    wire = Wire()
    node, _ = make_node(wire, n=1)
    peer = Peer(wire, 1)
    twist = msg.Twist(msg.Vector3(0.5), msg.Vector3(z=1.0))
    wire.script = [(0.005 + 0.1 * k, lambda: peer.send(0, "cmd_vel", twist)) for k in range(30)]
    node.run(3.0)
    body = wire.sent["drone_0/twist"][-1].twist
    assert body.angular.z == pytest.approx(1.0, abs=0.1)
    np.testing.assert_allclose(np.hypot(body.linear.x, body.linear.y), 0.5, atol=0.1)


@pytest.mark.slow
def test_body_rates_and_thrust_are_flown():
    wire = Wire()
    node, _ = make_node(wire)
    peer = Peer(wire, 1)
    twist = msg.Twist(msg.Vector3(z=11.0), msg.Vector3(x=1.0))
    wire.script = [(0.0, lambda: peer.send(0, "cmd_rates", twist))]
    node.run(0.3)
    imu = wire.sent["drone_0/imu"][-1]
    assert imu.angular_velocity.x == pytest.approx(1.0, abs=0.05)
    assert imu.linear_acceleration.z == pytest.approx(11.0, rel=0.02)


def test_in_lockstep_a_tape_of_rotor_speeds_is_flown_bit_for_bit_as_by_the_engine_alone():
    wire = Wire()
    node, _ = make_node(wire, lockstep=True)
    simulation = make_simulation()
    tape = np.random.default_rng(0).uniform(0.9, 1.1, (20, 2, 4)) * np.asarray(simulation.params.hover_rpm)[:, None]
    peer, seen = Peer(wire, 2), []

    def fly():
        for rpm in tape:
            for i in range(2):
                peer.send(i, "cmd_motors", convert.motors(rpm[i]))
            seen.append(peer.step())

    wire.script = [(0.5, fly)]
    assert node.run(0.2).steps == 20
    state, step = simulation.state, team_step()
    for rpm, heard in zip(tape, seen, strict=True):
        state = step(simulation.params, state, rpm)
        for name in ("pos", "quat", "omega", "rpm"):
            np.testing.assert_array_equal(getattr(heard, name), getattr(state, name))
        np.testing.assert_allclose(heard.vel, state.vel, atol=1e-15)  # it comes in body axes
    assert_close(node._flight.state, state, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize("silent_from", mostly_slow([0.0, 0.5], [0.5]))
def test_a_lost_peer_leaves_drones_that_hover_at_their_last_target(silent_from):
    wire = Wire()
    node, warnings = make_node(wire, failsafe=Failsafe("hover", timeout=0.3, wait=1.0))
    peer, target = Peer(wire, 2), np.array([[0.2, 0.0, 1.0], [0.2, 0.5, 1.0]])
    wire.script = [(0.1 * k, lambda: peer.fly_to(target)) for k in range(round(10 * silent_from))]
    flown = node.run(3.0)
    expected = target if silent_from else np.array([[0, 0, 1], [0, 0.5, 1.0]])
    np.testing.assert_allclose(peer.state().pos, expected, atol=0.03)
    limit = "0.3" if silent_from else "1"
    assert flown.lost == 2 and warnings == [f"no command for drone_{i} for {limit} s; it hovers" for i in range(2)]


@pytest.mark.slow
def test_a_peer_that_comes_back_is_heard():
    wire = Wire()
    node, warnings = make_node(wire, n=1, failsafe=Failsafe("hover", timeout=0.2, wait=0.2))
    peer = Peer(wire, 1)
    wire.script = [(1.0, lambda: peer.fly_to([[0.2, 0.0, 1.0]]))]
    node.run(1.1)
    assert warnings == ["no command for drone_0 for 0.2 s; it hovers", "commands for drone_0 arrive; it follows them"]


@pytest.mark.slow
def test_drones_of_a_lost_peer_land_and_the_flight_ends():
    wire = Wire()
    node, _ = make_node(wire, failsafe=Failsafe("land", wait=0.1))
    flown = node.run(20.0)
    assert flown.landed and flown.steps < 20 * HZ
    last = [sent[-1] for sent in (positions(wire, 0), positions(wire, 1))]
    assert all(0 < p.z < 0.06 for p in last)


def test_time_is_that_of_the_control_steps_at_any_rate():
    assert Simulation.ns.fget(SimpleNamespace(steps=7, control_hz=3)) == 2_333_333_333


def test_images_are_due_at_the_start_and_at_the_rate_of_the_camera():
    flights = [SimpleNamespace(_flight=SimpleNamespace(control_hz=100, steps=k)) for k in range(9)]
    due = [Node._image_is_due(flight, Camera(resolution=(8, 6), rate=25.0)) for flight in flights]
    assert [k for k, is_due in enumerate(due) if is_due] == [0, 4, 8]


def test_a_commanded_velocity_is_along_the_heading_that_turns_by_the_yaw_rate(monkeypatch):
    seen = []

    def followed(gains, params, memory, state, setpoint, dt):
        seen.append(setpoint)
        return memory, np.zeros(4)

    monkeypatch.setitem(command.CONTROLLERS, "own", SimpleNamespace(gains=lambda: None, control=followed))
    monkeypatch.setattr(command.rates, "follow", lambda *_: np.zeros(4))
    state = jd.State(*(np.eye(4)[3, 4 - size :] for size in (3, 4, 3, 3, 4)))
    given, memory = Command.zero(Mode.VELOCITY, vel=[1.0, 2.0, 3.0], yaw_rate=2.0), command.Memory((), np.array(0.5))
    after, _ = command.control("own", None, memory, state, given, 0.1)
    cos, sin = np.cos(0.7), np.sin(0.7)
    np.testing.assert_allclose(seen[0].vel, [cos - 2 * sin, sin + 2 * cos, 3], rtol=1e-6)
    assert after.heading == pytest.approx(0.7)


def test_the_first_command_has_a_timeout_of_its_own():
    watch = Watch(Failsafe(timeout=1.0, wait=30.0), 5.0)
    assert watch.remaining(6.0) == 29 and not watch.hear(6.0) and watch.remaining(6.5) == 0.5


def test_a_landing_sinks_by_40_cm_per_s_to_the_ground_where_the_rotors_stop():
    params = jd.repeat(jd.load_params("cf2x"), 1)
    params = params.replace(collision_offset=np.array([0.01]))
    ground = float(params.collision_height[0]) / 2 - 0.01
    command = Command.zero(Mode.POSITION, pos=[0.1, 0.2, 0.9])
    sinking = sink(command, params, jd.State.at_rest([[0.1, 0.2, 1.0]]), 0, 0.5)
    np.testing.assert_allclose(sinking.pos, [0.1, 0.2, 0.7])
    low = sink(sinking, params, jd.State.at_rest([[0.1, 0.2, 0.1]]), 0, 9.0)
    np.testing.assert_allclose(low.pos, [0.1, 0.2, ground])
    assert sink(low, params, jd.State.at_rest([[0.1, 0.2, ground + 0.02]]), 0, 0.5).mode == Mode.MOTORS


def test_a_flight_has_landed_when_all_drones_have():
    params = jd.repeat(jd.load_params("cf2x"), 2)
    off, held = Command.zero(Mode.MOTORS), Command.zero(Mode.POSITION, pos=[0.0, 0.0, 1.0])
    state = jd.State.at_rest([[0.0, 0.0, 1.0]] * 2)
    watch = SimpleNamespace(lost=True, lose=lambda now: False)
    for commands, landed in ([off, held], False), ([off, off], True):
        flight = SimpleNamespace(drones=2, commands=commands, params=params, state=state)
        node = SimpleNamespace(_flight=flight, _watches=[watch] * 2, _clock=lambda: 0.0, flown=SimpleNamespace())
        node._failsafe = Failsafe("land")
        Node._guard(node, 0.01)
        assert node.flown.landed == landed


def test_a_flight_stops_with_its_peer_if_asked_to():
    wire = Wire()
    node, _ = make_node(wire, failsafe=Failsafe("stop", wait=0.5))
    with pytest.raises(PeerLost, match=r"no command for drone_0 for 0\.5 s; the flight stops"):
        node.run(3.0)
    assert wire.now == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("action", mostly_slow(["hover", "land", "stop"], ["stop"]))
def test_without_calls_of_the_step_service_the_failsafe_acts(action):
    wire = Wire()
    node, warnings = make_node(wire, lockstep=True, failsafe=Failsafe(action, wait=0.5))
    if action == "stop":
        with pytest.raises(PeerLost, match=r"the step service was not called for 0.5 s; the flight stops"):
            node.run(1.0)
        return
    flown = node.run(10.0 if action == "land" else 0.5)
    assert flown.landed == (action == "land") and flown.lost == 1
    assert warnings == ["the step service was not called for 0.5 s; the flight continues by the clock"]


@pytest.mark.slow
@pytest.mark.parametrize("action", ["hover", "land"])
def test_without_calls_of_the_step_service_commands_are_followed_by_the_clock(action):
    """Rotor speeds do not stop the rotors of a drone in the air, and a landing begins where the commands end."""
    wire = Wire()
    node, warnings = make_node(wire, n=1, lockstep=True, failsafe=Failsafe(action, timeout=0.3, wait=0.1))
    hover = float(node._flight.params.hover_rpm[0])
    peer, message = Peer(wire, 1), convert.motors(np.full(4, hover))
    wire.script = [(0.2 + 0.05 * k, lambda: peer.send(0, "cmd_motors", message)) for k in range(20)]
    flown = node.run(5.0)
    z = np.array([p.z for p in positions(wire, 0)])
    assert len(z) > 130 and np.all(np.abs(z[:130] - 1.0) < 0.15)  # it keeps the velocity of a landing of 0.1 s
    assert flown.landed == (action == "land") and (z[-1] < 0.06) == (action == "land")
    assert warnings == [
        "the step service was not called for 0.1 s; the flight continues by the clock",
        "commands for drone_0 arrive; it follows them",
        f"no command for drone_0 for 0.3 s; it {action}s",
    ]


@pytest.mark.parametrize("action", mostly_slow(["hover", "stop"], ["stop"]))
def test_a_wrong_type_is_said_and_the_flight_goes_on_or_stops(action):
    wire = Wire()
    wire.wrong = ["a peer publishes /drone_0/cmd_vel as geometry_msgs/msg/Pose; its type is geometry_msgs/msg/Twist"]
    node, warnings = make_node(wire, failsafe=Failsafe(action))
    if action == "stop":
        with pytest.raises(PeerLost, match="its type is geometry_msgs/msg/Twist; the flight stops"):
            node.run(0.1)
    else:
        assert node.run(0.1).steps == 10 and len(warnings) == 1 and "continues without it" in warnings[0]


def test_refused_messages_of_a_kind_are_said_once_whatever_their_numbers():
    wire = Wire()
    node, warnings = make_node(wire)
    peer = Peer(wire, 1)
    bad = {  # of each kind, k-th message -> message
        "cmd_motors": [
            lambda k: msg.Float64MultiArray(data=(1.0,) * (k + 5)),
            lambda k: msg.Float64MultiArray(data=(float(k), math.nan, 0.0, 0.0)),
        ],
        "cmd_rates": [lambda k: msg.Twist(linear=msg.Vector3(0.0, 0.0, -1.0 - k))],
        "cmd_vel": [lambda k: msg.Twist(linear=msg.Vector3(math.inf, float(k), 0.0))],
        "cmd_pose": [
            lambda k: msg.PoseStamped(header=msg.Header(frame_id=f"odom{k}")),
            lambda k: msg.PoseStamped(pose=msg.Pose(orientation=msg.Quaternion(0.0, 0.0, 0.0, 2.0 + k))),
        ],
    }
    kinds = [(name, make) for name, makers in bad.items() for make in makers]
    wire.script = [
        (0.01 * k, functools.partial(peer.send, 0, name, make(k))) for k in range(20) for name, make in kinds
    ]
    flown = node.run(0.3)
    assert flown.refused == 20 * len(kinds) and flown.received == 0 and len(warnings) == len(kinds)
    assert "a message on /drone_0/cmd_motors is rejected: its data has 5 numbers; give 4 rotor speeds" in warnings[0]
    assert peer.state().pos[0, 2] == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
def test_images_come_at_the_rate_of_the_camera():
    wire = Wire()
    node, _ = make_node(wire, camera=Camera(resolution=(8, 6), rate=25.0))
    node.run(0.2)
    stamps = [nanoseconds(m.header.stamp) for m in wire.sent["drone_1/camera/image_raw"]]
    assert stamps == [k * 40_000_000 for k in range(6)]
    assert len(wire.sent["drone_1/camera/camera_info"]) == 6


@pytest.mark.slow
def test_more_images_than_control_steps_are_refused():
    with pytest.raises(UserError, match="101 images/s; give at most the control rate, 100"):
        make_node(Wire(), camera=Camera(resolution=(8, 6), rate=101.0))


def test_a_slow_computer_is_counted_and_not_caught_up_with():
    wire = Wire()
    node, _ = make_node(wire)

    def stall():
        wire.now += 0.5

    wire.script = [(0.05, stall)]
    flown = node.run(0.2)
    assert flown.late == 1 and wire.now == pytest.approx(0.7, abs=0.02)


@pytest.mark.slow
@pytest.mark.needs("pybullet")
def test_bullet_flies_behind_the_same_topics():
    from jaxdrones.engine import bullet

    wire = Wire()
    params = jd.repeat(jd.load_params("cf2x"), 1)
    with bullet.make_step(dt=1 / 300, substeps=3) as step:
        simulation = Simulation(step, params, jd.State.at_rest([[0.0, 0.0, 0.3]]), HZ)
        node = Node(simulation, InProcess(wire), clock=wire.clock, failsafe=Failsafe("land", wait=0.1))
        assert node.run(5.0).landed
        for _ in range(HZ // 2):
            simulation.advance()
        imu = convert.state_messages(jax.device_get(simulation.measure()), 0, 0)["imu"]
    assert imu.linear_acceleration.z == pytest.approx(9.8, abs=0.5)  # on the ground, which carries it
