"""A peer of a team that knows rclpy alone: it steps a flight in lockstep and writes what it receives.

python rclpy_peer.py FILE.npz DRONES STEPS
"""

import sys
import time

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

PATIENCE = 60.0  # s


def target(step: int, drone: int) -> tuple[float, float, float]:
    """Commanded position at a step, m."""
    return 0.3 * np.sin(0.01 * step + drone), 0.5 * drone + 0.2 * np.cos(0.013 * step), 1.0 + 0.1 * np.sin(0.02 * step)


def main(path: str, drones: int, steps: int) -> None:
    """Fly, and write times (ns), positions, velocities and answers."""
    rclpy.init()
    node = rclpy.create_node("outsider")
    seen = [[] for _ in range(drones)]
    commands = []
    for i in range(drones):
        node.create_subscription(Odometry, f"/drone_{i}/odom", seen[i].append, QoSProfile(depth=500))
        commands.append(node.create_publisher(PoseStamped, f"/drone_{i}/cmd_pose", QoSProfile(depth=500)))
    client = node.create_client(Trigger, "/step")
    assert client.wait_for_service(timeout_sec=PATIENCE), "there is no service /step"
    while not all(publisher.get_subscription_count() for publisher in commands):
        rclpy.spin_once(node, timeout_sec=0.01)
    answers = []
    for step in range(steps):
        for i, publisher in enumerate(commands):
            message = PoseStamped()
            message.header.frame_id = "world"
            position = message.pose.position
            position.x, position.y, position.z = map(float, target(step, i))
            message.pose.orientation.w = 1.0
            publisher.publish(message)
        future = client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(node, future, timeout_sec=PATIENCE)
        answers.append(future.result().message)
    while any(not messages or stamp(messages[-1]) < float(answers[-1]) * 1e9 - 1 for messages in seen):
        rclpy.spin_once(node, timeout_sec=1.0)
    t = [[stamp(message) for message in messages] for messages in seen]
    pos = [[point(message.pose.pose.position) for message in messages] for messages in seen]
    vel = [[point(message.twist.twist.linear) for message in messages] for messages in seen]
    np.savez(path, t=t, pos=pos, vel=vel, answers=answers)
    node.destroy_node()
    rclpy.shutdown()


def stream(drones: int) -> None:
    """Command positions at 20 Hz, once the team has been seen, until the process is killed."""
    rclpy.init()
    node = rclpy.create_node("outsider")
    commands = [
        node.create_publisher(PoseStamped, f"/drone_{i}/cmd_pose", QoSProfile(depth=500)) for i in range(drones)
    ]
    while not all(publisher.get_subscription_count() for publisher in commands):
        rclpy.spin_once(node, timeout_sec=0.01)
    while True:
        for i, publisher in enumerate(commands):
            message = PoseStamped()
            message.pose.position.y, message.pose.position.z = 0.5 * i - 0.25, 0.6
            publisher.publish(message)
        print("sent", flush=True)
        time.sleep(0.05)


def stamp(message: Odometry) -> int:
    """Time of a message, ns."""
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def point(vector) -> tuple[float, float, float]:
    """Numbers of a vector of ROS."""
    return vector.x, vector.y, vector.z


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
