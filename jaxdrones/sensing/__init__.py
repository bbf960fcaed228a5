"""What stands around, who touches it, and what the drones measure."""

from jaxdrones.sensing.builders import BEAMS, forest, gate, obstacles_2021, room, track
from jaxdrones.sensing.camera import Camera, camera_2021
from jaxdrones.sensing.collisions import Collisions, collisions
from jaxdrones.sensing.depth_noise import DepthNoise
from jaxdrones.sensing.distances import Surface
from jaxdrones.sensing.files import Mesh, Urdf
from jaxdrones.sensing.images import Images, photograph, render
from jaxdrones.sensing.range_finders import (
    downward_range,
    lidar,
    multi_ranger,
    optical_flow,
    range_finder,
    time_of_flight,
)
from jaxdrones.sensing.rays import ray
from jaxdrones.sensing.scene import Scene
from jaxdrones.sensing.sensor import Sensor
from jaxdrones.sensing.shapes import Box, Capsule, Cylinder, Sphere
from jaxdrones.sensing.urdf_scene import from_urdf

__all__ = [
    "BEAMS",
    "Box",
    "Camera",
    "Capsule",
    "Collisions",
    "Cylinder",
    "DepthNoise",
    "Images",
    "Mesh",
    "Scene",
    "Sensor",
    "Sphere",
    "Surface",
    "Urdf",
    "camera_2021",
    "collisions",
    "downward_range",
    "forest",
    "from_urdf",
    "gate",
    "lidar",
    "multi_ranger",
    "obstacles_2021",
    "optical_flow",
    "photograph",
    "range_finder",
    "ray",
    "render",
    "room",
    "time_of_flight",
    "track",
]
