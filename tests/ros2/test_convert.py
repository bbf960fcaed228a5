"""States to messages and back, and messages to commands."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, flying
from in_process import from_messages
from ros2_team import make_simulation

import jaxdrones as jd
from jaxdrones.ros2 import Mode, convert, topics
from jaxdrones.ros2 import messages as msg
from jaxdrones.ros2.simulation import Simulation
from jaxdrones.sensing import Camera

pytestmark = pytest.mark.needs("rosbags")


def measured(n=3):
    simulation = make_simulation(n)
    simulation.state = flying(simulation.params)
    return simulation, simulation.measure()


@pytest.mark.slow
def test_a_state_comes_back_from_its_messages():
    simulation, now = measured()
    sent = [convert.state_messages(now, i, 0) for i in range(3)]
    assert_close(from_messages(sent), jax.device_get(simulation.state), atol=1e-14)


@pytest.mark.slow
def test_whoever_hears_the_odometry_has_the_motors_speeds_of_that_time():
    """They have no stamp, so they are sent first."""
    sent = list(convert.state_messages(measured(1)[1], 0, 0))
    assert sent.index("motors") < sent.index("odom")


def test_twists_are_in_body_axes_and_poses_in_the_world():
    simulation, now = measured(2)
    sent = convert.state_messages(now, 0, 1_500_000_000)
    assert sent["pose"].header == msg.Header(msg.Time(1, 500_000_000), "world")
    assert sent["odom"].child_frame_id == sent["twist"].header.frame_id == "drone_0/base_link"
    forward = jd.rotation.rotate(simulation.state.quat[0], jnp.array([1.0, 0, 0]))
    np.testing.assert_allclose(sent["twist"].twist.linear.x, simulation.state.vel[0] @ forward, rtol=1e-12)
    in_body = convert.to_body(np.asarray(simulation.state.quat), np.asarray(simulation.state.vel))
    np.testing.assert_allclose(in_body, now.vel, rtol=1e-12)  # as of a log
    assert sent["odom"].twist.twist == sent["twist"].twist and sent["odom"].pose.pose == sent["pose"].pose


def test_the_imu_reads_gravity_at_rest_in_the_air_and_nothing_in_free_fall():
    simulation = make_simulation(2)
    hover = jnp.broadcast_to(simulation.params.hover_rpm[:, None], (2, 4))
    for rpm, reading in ((hover, 9.8), (0 * hover, 0.0)):
        simulation._rpm = rpm
        imu = convert.state_messages(simulation.measure(), 0, 0)["imu"]
        np.testing.assert_allclose(convert.numbers(imu.linear_acceleration), (0, 0, reading), atol=1e-9)


@pytest.mark.slow
def test_a_battery_is_published_where_the_team_has_one():
    def battery(params, state):
        return {"voltage": 3.9 + 0 * params.mass, "current": 2.0 + 0 * params.mass, "charge": 450.0, "capacity": 900.0}

    now = make_simulation(1, battery=battery).measure()
    state = convert.state_messages(now, 0, 0)["battery"]
    assert state.voltage == pytest.approx(3.9) and state.current == -2.0 and state.percentage == 0.5
    assert state.charge == 0.125 and state.present and math.isnan(state.temperature)
    assert "battery" not in convert.state_messages(make_simulation(1).measure(), 0, 0)


@pytest.mark.slow
def test_the_camera_matrix_projects_as_the_camera_renders():
    camera = Camera(resolution=(40, 30), principal_point=(2.0, -1.0))
    params = jd.repeat(jd.load_params("cf2x"), 1)
    state = jd.State.at_rest([[0.0, 0.0, 1.0]])
    target = np.array([2.0, 0.3, 1.2])
    scene = jd.Scene.of(jd.sensing.Sphere(pos=target, radius=0.1), ground=False)
    seen = np.argwhere(np.asarray(jd.render(scene, params, state, camera).segmentation[0]) > 0)
    x, y, z = target - [0, 0, 1]
    u, v, w = np.array(convert.camera_info(camera, msg.Header()).k).reshape(3, 3) @ [-y, -z, x]
    np.testing.assert_allclose(seen.mean(axis=0), [v / w, u / w], atol=0.5)


def test_an_image_message_holds_the_pixels_row_by_row():
    rgb = np.arange(2 * 3 * 4, dtype=np.uint8).reshape(2, 3, 4)
    image, info = convert.image_messages(rgb, Camera(resolution=(3, 2)), 0, 0).values()
    assert image.header.frame_id == info.header.frame_id == "drone_0/camera_optical_frame"
    assert (info.k[2], info.k[5]) == (1, 0.5)  # the middle of the image, where the center of the first pixel is 0, 0
    assert (image.height, image.width, image.step, image.encoding) == (2, 3, 9, "rgb8")
    np.testing.assert_array_equal(np.frombuffer(image.data, np.uint8).reshape(2, 3, 3), rgb[..., :3])


def pose(frame="world", w=1.0, x=1.0):
    return msg.PoseStamped(msg.Header(frame_id=frame), msg.Pose(msg.Point(x, 2.0, 3.0), msg.Quaternion(w=w)))


def test_a_message_becomes_a_command():
    turned = msg.Quaternion(z=math.sin(0.4), w=math.cos(0.4))
    command = convert.to_command("cmd_pose", msg.PoseStamped(pose=msg.Pose(msg.Point(1.0, 2.0, 3.0), turned)))
    assert command.mode == Mode.POSITION and command.yaw == pytest.approx(0.8)
    np.testing.assert_array_equal(command.pos, [1, 2, 3])
    twist = msg.Twist(msg.Vector3(1.0, 2.0, 3.0), msg.Vector3(4.0, 5.0, 6.0))
    command = convert.to_command("cmd_vel", twist)
    assert command.mode == Mode.VELOCITY and command.yaw_rate == 6
    np.testing.assert_array_equal(command.vel, [1, 2, 3])
    command = convert.to_command("cmd_rates", twist)
    assert command.mode == Mode.RATES and command.thrust == 3
    np.testing.assert_array_equal(command.omega, [4, 5, 6])
    command = convert.to_command("cmd_motors", convert.motors(np.arange(4)))
    assert command.mode == Mode.MOTORS
    np.testing.assert_array_equal(command.rpm, range(4))


@pytest.mark.parametrize(
    ("name", "message", "says"),
    [
        ("cmd_pose", pose(frame="map"), "frame_id is 'map'; give poses in 'world'"),
        ("cmd_pose", pose(w=0.0), "orientation has length 0"),
        ("cmd_pose", pose(x=math.nan), "position is .*finite"),
        ("cmd_vel", msg.Twist(msg.Vector3(math.inf)), "linear is .*finite"),
        ("cmd_vel", msg.Twist(msg.Vector3(-1e15)), "linear is .*; give finite numbers, at most 1e.09"),
        ("cmd_vel", msg.Twist(angular=msg.Vector3(z=1e300)), "angular is .*; give finite numbers, at most 1e.09"),
        ("cmd_motors", msg.Float64MultiArray(data=(1.0, 2.0, 3.0, 2e9)), "data is .*at most 1e.09"),
        ("cmd_rates", msg.Twist(msg.Vector3(z=-1.0)), "collective thrust"),
        ("cmd_motors", msg.Float64MultiArray(data=(1.0, 2.0)), "data has 2 numbers; give 4 rotor speeds"),
    ],
)
def test_a_message_that_cannot_be_flown_is_refused(name, message, says):
    with pytest.raises(ValueError, match=says):
        convert.to_command(name, message)


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.parametrize("vehicle", ["cf2x", "hb"])
def test_a_command_with_the_largest_numbers_leaves_a_drone_that_follows_the_next_one(vehicle):
    """A velocity of 1e15 m/s was finite, and the drone had no finite position for the rest of the flight."""
    step = jd.make_step(dt=1 / 240, substeps=2)
    simulation = Simulation(step, jd.repeat(jd.load_params(vehicle), 1), jd.State.at_rest([[0.0, 0.0, 1.0]]), 120)
    (hold,), most = simulation.commands, 1e9
    twist = msg.Twist(msg.Vector3(most, -most, most), msg.Vector3(most, -most, most))
    commands = {
        "cmd_pose": pose(x=-most),
        "cmd_vel": twist,
        "cmd_rates": twist,
        "cmd_motors": convert.motors([most] * 4),
    }
    for name, message in commands.items():
        for command in convert.to_command(name, message), hold:
            simulation.commands = [command]
            simulation.advance()
        assert all(np.isfinite(x).all() for x in jax.tree.leaves((simulation.state, simulation._memory))), name


def test_drones_and_their_topics_have_the_names_of_the_table():
    assert topics.output(2, "camera/image_raw").name == "drone_2/camera/image_raw"
    assert topics.command(0, "cmd_vel").type == msg.Twist.NAME


def test_a_battery_without_a_capacity_has_no_known_percentage():
    """It was a division by zero."""
    reading = {"voltage": 4.0, "current": 2.0, "charge": 0.0, "capacity": 0.0}
    state = convert._battery(reading, msg.Header(convert.stamp(0), "base"))
    assert math.isnan(state.percentage) and state.capacity == 0 and state.current == -2  # it is discharged
