"""Bullet collision shapes of the kinds of obstacles."""

from types import ModuleType
from typing import Any

from jaxdrones.errors import UserError
from jaxdrones.sensing.files import Mesh
from jaxdrones.sensing.shapes import Box, Capsule, Cylinder, Sphere


def shape_of(p: ModuleType, obstacle: Any) -> dict[str, Any]:
    """Arguments of `createCollisionShape` for a single concrete obstacle."""
    match obstacle:
        case Box(size=size):
            return dict(shapeType=p.GEOM_BOX, halfExtents=[edge / 2 for edge in size])
        case Sphere(radius=radius):
            return dict(shapeType=p.GEOM_SPHERE, radius=radius)
        case Cylinder(radius=radius, height=height):
            return dict(shapeType=p.GEOM_CYLINDER, radius=radius, height=height)
        case Capsule(radius=radius, height=height):
            return dict(shapeType=p.GEOM_CAPSULE, radius=radius, height=height)
        case Mesh(path=path, scale=scale):
            return dict(shapeType=p.GEOM_MESH, fileName=str(path), meshScale=[scale] * 3)
    raise UserError(f"Bullet has no shape for a {type(obstacle).__name__}; leave it out of the scene")
