"""Scenes, collision queries and sensors."""

from jaxdrones.sensing import kalman
from jaxdrones.sensing.builders import BEAMS, forest, gate, obstacles_2021, room, track
from jaxdrones.sensing.camera import Camera, DepthNoise, camera_2021
from jaxdrones.sensing.collisions import Collisions, collisions
from jaxdrones.sensing.distances import Surface
from jaxdrones.sensing.environment import BMP388, EUROPE, LIS3MDL, barometer, magnetometer
from jaxdrones.sensing.estimator import state_estimate
from jaxdrones.sensing.files import Mesh, Urdf
from jaxdrones.sensing.images import Images, photograph, render
from jaxdrones.sensing.inertial import BMI088, MPU9250, PERFECT, ImuPart, imu
from jaxdrones.sensing.mocap import VICON, MotionCaptureSystem, motion_capture
from jaxdrones.sensing.noise import Noise, allan_deviation
from jaxdrones.sensing.range_finders import (
    downward_range,
    lidar,
    multi_ranger,
    optical_flow,
    range_finder,
    ray,
    time_of_flight,
)
from jaxdrones.sensing.scene import Scene
from jaxdrones.sensing.sensor import Sensor
from jaxdrones.sensing.shapes import Box, Capsule, Cylinder, Sphere
from jaxdrones.sensing.urdf_scene import from_urdf

__all__ = ["Box", "Capsule", "Cylinder", "Mesh", "Scene", "Sphere", "Surface", "Urdf"]
__all__ += ["BEAMS", "forest", "from_urdf", "gate", "obstacles_2021", "room", "track"]
__all__ += ["Camera", "Collisions", "DepthNoise", "Images", "camera_2021", "collisions", "photograph", "render"]
__all__ += ["downward_range", "lidar", "multi_ranger", "optical_flow", "range_finder", "ray", "time_of_flight"]
__all__ += ["BMI088", "BMP388", "EUROPE", "LIS3MDL", "MPU9250", "PERFECT", "VICON"]
__all__ += ["ImuPart", "Noise", "Sensor", "allan_deviation", "barometer", "imu", "magnetometer"]
__all__ += ["MotionCaptureSystem", "kalman", "motion_capture", "state_estimate"]
