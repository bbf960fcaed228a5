"""Datagrams between Betaflight's SITL and a simulator: state and sticks in, motors out.

The simulator's axes are x forward, y left, z up. Betaflight's gyroscope and accelerometer have x forward, y right, z
down; its packet has the specific force with the opposite sign.
"""

from typing import NamedTuple

import numpy as np

STATE_PORT, RC_PORT, MOTOR_PORT, MSP_PORT = 9003, 9004, 9001, 5761
"""Ports: state and sticks to Betaflight (UDP), motors from it (UDP), MSP to it (TCP)."""
CHANNELS = 16
SEA_LEVEL = 101_325.0  # Pa
_MOTORS = 4
_OUTPUTS = 16
_CENTER, _HALF = 1500, 500  # us

STATE = np.dtype(
    [
        ("t", "<f8"),
        ("gyro", "<f8", 3),
        ("acc", "<f8", 3),
        ("quat", "<f8", 4),
        ("vel", "<f8", 3),
        ("pos", "<f8", 3),
        ("pressure", "<f8"),
    ]
)
"""State packet: time (s); rates (rad/s, x forward, y right, z down); minus the specific force (m/s^2, x forward, y
left, z up); quaternion w, x, y, z; velocity and position of the virtual GPS, which is not used; pressure (Pa)."""
RC = np.dtype([("t", "<f8"), ("channels", "<u2", CHANNELS)])
"""Packet of the receiver: time (s) and channels (us): roll, pitch, throttle, yaw and the auxiliary ones."""
MOTORS = np.dtype(
    {"names": ["count", "pulses"], "formats": ["<u2", ("<f4", _OUTPUTS)], "offsets": [0, 4], "itemsize": 68}
)
"""Packet of the motors: their number, and pulses (us) of the motors and servos."""


class Sticks(NamedTuple):
    """Positions of the sticks and switches of a transmitter."""

    roll: float = 0.0
    """-1 to 1, positive to the right."""
    pitch: float = 0.0
    """-1 to 1, positive forward: nose down."""
    throttle: float = 0.0
    """0 to 1."""
    yaw: float = 0.0
    """-1 to 1, positive to the right: clockwise from above."""
    armed: bool = False
    """Switch of AUX1."""
    angle: bool = False
    """Switch of AUX2: angle mode, in which Betaflight levels the drone; else roll and pitch are rates (acro mode)."""


def state_packet(t: float, quat: np.ndarray, omega: np.ndarray, specific_force: np.ndarray) -> bytes:
    """State packet of a simulated time (s) and an attitude (4,): x, y, z, w, body to world.

    The body rates, rad/s, and the specific force, m/s^2, 9.8 upwards at rest, have the axes x forward, y left, z up.
    """
    packet = np.zeros((), STATE)
    packet["t"] = t
    packet["gyro"] = omega * np.array([1.0, -1.0, -1.0])
    packet["acc"] = -np.asarray(specific_force)
    packet["quat"] = np.roll(quat, 1)
    packet["pressure"] = SEA_LEVEL
    return packet.tobytes()


def rc_packet(t: float, sticks: Sticks) -> bytes:
    """Packet of the receiver at a simulated time (s); stick positions are clipped to their ranges."""
    packet = np.zeros((), RC)
    channels = np.full(CHANNELS, 1000)
    centered = np.nan_to_num(np.array([sticks.roll, sticks.pitch, sticks.yaw], float))
    channels[[0, 1, 3]] = np.rint(_CENTER + _HALF * np.clip(centered, -1, 1))
    channels[2] = np.rint(1000 + 1000 * np.clip(np.nan_to_num(sticks.throttle), 0, 1))
    channels[4], channels[5] = 1000 + 1000 * sticks.armed, 1000 + 1000 * sticks.angle
    packet["t"], packet["channels"] = t, channels
    return packet.tobytes()


def motor_outputs(datagram: bytes) -> np.ndarray | None:
    """(4,) outputs of motors 1 to 4, 0 to 1; `None` for another packet."""
    if len(datagram) != MOTORS.itemsize:
        return None
    packet = np.frombuffer(datagram, MOTORS)[0]
    pulses = packet["pulses"][:_MOTORS].astype(float)
    if packet["count"] < _MOTORS or not np.isfinite(pulses).all():
        return None
    return np.clip((pulses - 1000) / 1000, 0, 1)


def motor_order(rotor_pos: np.ndarray) -> np.ndarray:
    """(4,) Betaflight's motor of each rotor, in X: 0 rear right, 1 front right, 2 rear left, 3 front left."""
    front, left = np.asarray(rotor_pos)[:, 0] > 0, np.asarray(rotor_pos)[:, 1] > 0
    order = front + 2 * left
    assert sorted(order) == [0, 1, 2, 3], rotor_pos
    return order
