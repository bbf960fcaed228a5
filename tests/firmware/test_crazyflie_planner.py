"""Trajectories of the high-level commander."""

import numpy as np

from jaxdrones.firmware.crazyflie.planner import Goal, Trajectory, go_to


def test_a_trajectory_backwards_is_that_of_the_reversed_time():
    pieces = go_to(
        Goal(np.array([0.0, 1, 2]), np.ones(3), np.zeros(3), 0.1, 0.2), np.array([3.0, 0, 1]), 0.7, 2.0, begin=0.0
    ).pieces
    there, back = (Trajectory(pieces, 5.0, 1.5, backwards) for backwards in (False, True))
    for t in 0.1, 0.4, 1.9, 2.6:
        a, b = there.at(5 + t), back.at(5 + 3 - t)
        for name, sign in ("pos", 1), ("vel", -1), ("acc", 1), ("yaw", 1), ("yaw_rate", -1):
            np.testing.assert_allclose(getattr(b, name), sign * np.asarray(getattr(a, name)), atol=1e-12)
