"""The backend for Crazyswarm2, held to the interface and the laws of Crazyswarm2's own backend."""

import time

import numpy as np
import pytest

pytestmark = pytest.mark.filterwarnings("default")


class Swarm:
    """A state as Crazyswarm2's server hands it over: pos, vel, quat (w, x, y, z), omega."""

    def __init__(self, pos):
        self.pos, self.vel, self.omega = np.array(pos, float), np.zeros(3), np.zeros(3)
        self.quat = np.array([1.0, 0.0, 0.0, 0.0])


class Action:
    def __init__(self, rpm):
        self.rpm = rpm


@pytest.fixture
def backend(request):
    rclpy = pytest.importorskip("rclpy")
    request.getfixturevalue("ros")
    from rosgraph_msgs.msg import Clock

    from jaxdrones.ros2.crazyswarm import Backend

    rclpy.init()
    servers = []

    def make(heights=(1.0,), **parameters):
        """The backend in a server, which has its parameters as a node that declares those of its file."""
        given = [rclpy.Parameter(f"sim.jaxdrones.{name}", value=value) for name, value in parameters.items()]
        server = rclpy.create_node(
            "crazyflie_server", parameter_overrides=given, automatically_declare_parameters_from_overrides=True
        )
        servers.append(server)
        server.clocks = []
        server.create_subscription(Clock, "clock", server.clocks.append, 10)
        states = [Swarm([i, 0.0, z]) for i, z in enumerate(heights)]
        return Backend(server, [f"cf{i}" for i in range(len(heights))], states), server

    yield make
    for server in servers:
        server.destroy_node()
    rclpy.shutdown()


def hover_rpm():
    """Crazyswarm2's motor speed whose thrust, by its own fit, is a quarter of the weight of a cf2x."""
    from jaxdrones.ros2.crazyswarm import thrust_of

    speeds = np.linspace(10_000, 25_000, 200_001)
    return speeds[np.argmin(np.abs(thrust_of(speeds) - 0.027 * 9.8 / 4))]


def test_motors_are_numbered_from_the_front_right_one_clockwise():
    from jaxdrones.ros2.crazyswarm import _rotors_of_motors

    front_left, front_right, rear_right, rear_left = (1, 1), (1, -1), (-1, -1), (-1, 1)
    places = 0.03 * np.array([front_left, rear_left, front_right, rear_right])
    assert _rotors_of_motors(places).tolist() == [3, 2, 0, 1]


def test_a_motor_that_stands_still_has_no_thrust():
    from jaxdrones.ros2.crazyswarm import thrust_of

    assert thrust_of(np.zeros(4)).tolist() == [0] * 4


def test_an_attitude_of_crazyswarm_has_its_scalar_first():
    from jaxdrones.ros2.crazyswarm import _from_swarm

    start = Swarm([1.0, 2.0, 3.0])
    start.quat = 2 * np.array([0.8, 0.0, 0.6, 0.0])
    state = _from_swarm([start], float)
    np.testing.assert_allclose(state.quat, [[0, 0.6, 0, 0.8]])
    np.testing.assert_array_equal(state.pos, [[1, 2, 3]])


def test_time_goes_by_dt_and_the_clock_is_published(backend):
    import rclpy

    made, server = backend(dt=0.001)
    assert made.time() == 0
    states = None
    for _ in range(3):
        states = made.step([None], [Action([0, 0, 0, 0])])
    end = time.monotonic() + 20
    while len(server.clocks) < 3 and time.monotonic() < end:
        rclpy.spin_once(server, timeout_sec=0.1)
    assert [message.clock.nanosec for message in server.clocks] == [10**6, 2 * 10**6, 3 * 10**6]
    assert made.time() == pytest.approx(0.003) and len(states) == 1 and made.shutdown() is None


@pytest.mark.slow
def test_thrust_that_cancels_gravity_holds_a_drone_up(backend):
    made, _ = backend()
    for _ in range(500):
        (state,) = made.step([None], [Action([hover_rpm()] * 4)])
    assert abs(state.pos[2] - 1) < 1e-3 and abs(state.vel[2]) < 1e-3
    np.testing.assert_allclose(state.quat, [1, 0, 0, 0], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("faster", "axis", "sign"),
    [((0, 1), 0, -1), ((2, 3), 0, 1), ((1, 2), 1, 1), ((0, 3), 1, -1), ((1, 3), 2, 1), ((0, 2), 2, -1)],
)
def test_motors_turn_a_drone_as_those_of_a_crazyflie_do(faster, axis, sign, backend):
    made, _ = backend()
    rpm = np.full(4, hover_rpm())
    rpm[list(faster)] += 500
    (state,) = made.step([None], [Action(rpm)])
    assert sign * state.omega[axis] > 1e-3 * (0.01 if axis == 2 else 1)
    assert np.abs(np.delete(state.omega, axis)).max() < 1e-6


@pytest.mark.slow
def test_a_drone_falls_without_an_action_and_rests_on_the_ground(backend):
    made, _ = backend(heights=(0.05, 1.0), dt=0.002)
    for _ in range(500):
        low, high = made.step([None, None], [None, Action([hover_rpm()] * 4)])
    assert 0 < low.pos[2] < 0.03 and abs(low.vel[2]) < 0.02 and high.pos[2] == pytest.approx(1, abs=0.05)


def test_a_vehicle_that_is_no_x_is_refused(backend):
    with pytest.raises(ValueError, match="X configuration"):
        backend(vehicle="cf2p")
