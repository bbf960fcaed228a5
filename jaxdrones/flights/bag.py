"""Reading of ROS 2 bags of flights."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxdrones.errors import UserError, needs
from jaxdrones.flights.log import OPTIONAL


def read_bag(path: Path) -> dict[str, np.ndarray]:
    """Arrays of a bag: poses and twists of /drone_0/odom, ... and rotor speeds of /drone_0/motors, ..."""
    with needs("rosbags", "ros2"):
        from rosbags.rosbag2 import Reader
        from rosbags.typesys import Stores, get_typestore
    store = get_typestore(Stores.ROS2_JAZZY)
    found: dict[str, dict[int, Any]] = {}
    kinds = {"nav_msgs/msg/Odometry": "odom", "std_msgs/msg/Float64MultiArray": "motors"}
    try:
        with Reader(path) as reader:
            wanted = [c for c in reader.connections if c.topic.endswith(f"/{kinds.get(c.msgtype, '?')}")]
            for connection, ns, data in reader.messages(wanted):
                message = store.deserialize_cdr(data, connection.msgtype)
                found.setdefault(connection.topic.strip("/"), {})[ns] = message
    except Exception as error:  # the reader raises errors of any type on damaged bytes
        raise UserError(f"{path} is not a ROS 2 bag, or is damaged: {error}; give the folder of a bag") from None
    n = 0
    while {f"drone_{n}/odom", f"drone_{n}/motors"} <= found.keys():
        n += 1
    if not n:
        raise UserError(f"{path} has no flight: /drone_0/odom or /drone_0/motors is missing; record both")
    times = sorted(set.intersection(*(set(found[f"drone_{i}/{kind}"]) for i in range(n) for kind in kinds.values())))
    if not times:
        raise UserError(f"{path}: /odom and /motors of its {n} drones have no time in common; record equal times")
    motors = [[found[f"drone_{i}/motors"][ns].data for i in range(n)] for ns in times]
    if any(len(speeds) != OPTIONAL["rpm"] for team in motors for speeds in team):
        raise UserError(f"{path}: a message of /motors does not have 4 numbers; record the rotor speeds, RPM")
    odometry = [[found[f"drone_{i}/odom"][ns] for i in range(n)] for ns in times]

    def stacked(part: str, kind: str, axes: str) -> np.ndarray:
        values = [[getattr(getattr(getattr(m, part), part), kind) for m in team] for team in odometry]
        return np.array([[[getattr(v, axis) for axis in axes] for v in team] for team in values])

    quat, body_vel = stacked("pose", "orientation", "xyzw"), stacked("twist", "linear", "xyz")
    turned = 2 * np.cross(quat[..., :3], body_vel)  # R v = v + w t + u x t with t = 2 u x v and q = (u, w)
    return {
        "t": np.array(times) / 1e9,
        "pos": stacked("pose", "position", "xyz"),
        "quat": quat,
        "vel": body_vel + quat[..., 3:] * turned + np.cross(quat[..., :3], turned),
        "omega": stacked("twist", "angular", "xyz"),
        "rpm": np.array(motors),
    }
