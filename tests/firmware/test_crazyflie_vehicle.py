"""The simulated Crazyflie flies its set-points: physics, controller and commander together."""

import math
import struct

import jax
import numpy as np
import pytest

from jaxdrones.firmware.crazyflie import Crazyflie, Vehicle
from jaxdrones.firmware.crazyflie.packet import Packet, Port

pytestmark = [pytest.mark.slow, pytest.mark.float32]


class Flight:
    def __init__(self):
        with jax.enable_x64(False):  # a fixture of a module is made before the mark of a test acts
            self.crazyflie = Crazyflie(Vehicle())

    def send(self, port, data, channel=0):
        return [*self.crazyflie.answer(Packet(port, channel, data), "client", 0.0)]

    def fly(self, seconds, port=None, data=b""):
        """Fly, with a packet every 0.1 s, and return the last sample."""
        for k in range(round(100 * seconds)):
            if port is not None and k % 10 == 0:
                self.send(port, data)
            [*self.crazyflie.advance(0.0)]
        return self.crazyflie.vehicle.sample


def hover(forward=0.0, left=0.0, yaw_rate=0.0, height=0.5):
    return Port.GENERIC_SETPOINT, struct.pack("<Bffff", 10, forward, left, yaw_rate, height)


@pytest.fixture(scope="module")
def flight():
    return Flight()


def test_a_vehicle_flies_along_its_heading_and_lands(flight):
    """In the order of a flight: every part begins where the last one ended."""
    assert flight.fly(0.5).motors.max() == 0
    up = flight.fly(3, *hover())
    assert abs(up.pos[2] - 0.5) < 0.05 and np.abs(up.pos[:2]).max() < 0.02
    flight.fly(2, *hover(yaw_rate=45.0))
    turned = flight.fly(1, *hover())
    assert turned.rpy[2] == pytest.approx(90, abs=3)  # to the left
    ahead = flight.fly(3, *hover(forward=0.3))
    assert ahead.vel[1] == pytest.approx(0.3, abs=0.03) and abs(ahead.vel[0]) < 0.03
    aside = flight.fly(3, *hover(left=0.3))
    assert aside.vel[0] == pytest.approx(-0.3, abs=0.03) and abs(aside.vel[1]) < 0.03
    flight.fly(2, *hover())
    down = flight.fly(3, *hover(height=0.0))
    flight.send(Port.GENERIC_SETPOINT, b"\0")
    still = flight.fly(1)
    assert still.motors.max() == 0 and np.linalg.norm(still.pos - down.pos) < 0.05


def test_positions_and_plans_are_flown(flight):
    at = flight.crazyflie.vehicle.sample.pos
    place = np.array([at[0] + 0.3, at[1] - 0.2, 0.6])
    data = struct.pack("<Bffff", 7, *place, 45.0)
    there = flight.fly(5, Port.GENERIC_SETPOINT, data)
    np.testing.assert_allclose(there.pos, place, atol=0.05)
    assert there.rpy[2] == pytest.approx(45, abs=3)
    flight.send(Port.GENERIC_SETPOINT, struct.pack("<BI", 0, 0), channel=1)
    flight.send(Port.HIGH_LEVEL, struct.pack("<BBBBfffff", 12, 0, 1, 0, 0.0, 0.4, 0.2, 0.0, 2.0))  # relative
    assert flight.crazyflie.status >> 8 & 1
    moved = flight.fly(4)
    np.testing.assert_allclose(moved.pos - there.pos, [0, 0.4, 0.2], atol=0.06)
    flight.send(Port.HIGH_LEVEL, struct.pack("<BBff?f", 8, 0, 0.0, 0.0, True, 2.0))
    assert flight.fly(3).motors.max() == 0


def test_an_emergency_stops_the_motors_for_good(flight):
    flight.fly(2, *hover())
    answers = flight.send(Port.SUPERVISOR, b"\3", channel=1)
    assert answers == [Packet(Port.SUPERVISOR, 1, b"\x83\1")]
    assert flight.fly(0.1, *hover()).motors.max() == 0 and flight.crazyflie.status >> 6 & 1


def test_the_measured_rate_is_that_of_the_attitude(flight):
    other = Flight()
    other.fly(2, *hover())
    before = other.crazyflie.vehicle.sample
    after = other.fly(0.5, *hover(yaw_rate=90.0))
    middle = (before.omega[2] + after.omega[2]) / 2
    assert 0 < math.radians(after.rpy[2] - before.rpy[2]) < math.pi / 2 and middle > 0
