"""Trajectories of the high-level commander."""

import numpy as np

from jaxdrones.firmware.crazyflie.planner import Goal, Trajectory, go_to, unpack

START = Goal(np.array([0.0, 1, 2]), np.ones(3), np.zeros(3), 0.1, 0.2)
PIECES = go_to(START, np.array([3.0, 0, 1]), 0.7, 2.0, begin=0.0).pieces


def test_a_trajectory_that_is_turned_and_shifted_turns_the_heading_with_the_path():
    turn, shift = 0.9, np.array([3.0, -1.0, 0.5])
    plain, moved = Trajectory(PIECES, 0.0), Trajectory(PIECES, 0.0, shift=shift, turn=turn)
    cos, sin = np.cos(turn), np.sin(turn)
    about = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    for t in 0.3, 1.1:
        a, b = plain.at(t), moved.at(t)
        np.testing.assert_allclose(b.pos, about @ a.pos + shift, atol=1e-12)
        np.testing.assert_allclose([b.vel, b.acc], [about @ a.vel, about @ a.acc], atol=1e-12)
        np.testing.assert_allclose([b.yaw, b.yaw_rate], [a.yaw + turn, a.yaw_rate], atol=1e-12)


def test_a_trajectory_backwards_is_that_of_the_reversed_time():
    there, back = (Trajectory(PIECES, 5.0, 1.5, backwards) for backwards in (False, True))
    for t in 0.1, 0.4, 1.9, 2.6:
        a, b = there.at(5 + t), back.at(5 + 3 - t)
        for name, sign in ("pos", 1), ("vel", -1), ("acc", 1), ("yaw", 1), ("yaw_rate", -1):
            np.testing.assert_allclose(getattr(b, name), sign * np.asarray(getattr(a, name)), atol=1e-12)


def test_pieces_fill_the_memory_and_follow_each_other():
    numbers = np.zeros((2, 33), "<f4")
    numbers[:, -1] = 2.0, 3.0  # s
    numbers[:, 1] = 0.5, 1.0  # m/s along x
    numbers[1, 0] = 1.0  # m, where the first one ends
    pieces = unpack(numbers.tobytes(), 0, 2)
    assert unpack(numbers.tobytes(), 1, 2) is None
    flight = Trajectory(pieces, 10.0, 2.0)
    assert [flight.at(10 + t).pos[0] for t in (2.0, 4.0, 5.0, 10.0, 20.0)] == [0.5, 1.0, 1.5, 4.0, 4.0]
    assert [flight.finished(10 + t) for t in (9.9, 10.0)] == [False, True]
