"""Teams for the tests of ROS 2; one compiled step for all of them."""

from helpers import make_step

import jaxdrones as jd
from jaxdrones.ros2 import Simulation

HZ = 100
SUBSTEPS = 3


def make_simulation(n=2, hz=HZ, **options):
    """A team that hovers side by side, 1 m above the ground."""
    params = jd.repeat(jd.load_params("cf2x"), n)
    state = jd.State.at_rest([[0.0, 0.5 * i, 1.0] for i in range(n)])
    return Simulation(team_step(hz), params, state, hz, **options)


def team_step(hz=HZ):
    return make_step((jd.ground_contact,), dt=1 / (hz * SUBSTEPS), substeps=SUBSTEPS)


def nanoseconds(time):
    """Time of a message, ns."""
    return time.sec * 1_000_000_000 + time.nanosec
