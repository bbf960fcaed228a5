"""Scenes from the collision elements of a URDF."""

import os
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxdrones import rotation
from jaxdrones.arguments import checked, quaternion, shape
from jaxdrones.errors import UserError
from jaxdrones.sensing.files import Mesh
from jaxdrones.sensing.scene import Scene
from jaxdrones.sensing.shapes import GREY, Box, Capsule, Cylinder, Sphere

Pose = tuple[Any, Any]
"""Position (3,), m, and unit quaternion (4,) of a frame in another one."""
_ORIGIN: Pose = (np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))


_NAME = "{argument} of the root link"
_POS, _QUAT = (shape(length, meaning="of one link", name=_NAME, finite=True) for length in (3, 4))


@checked
def from_urdf(
    path: str | os.PathLike,
    pos: Annotated[ArrayLike, _POS] = (0.0, 0.0, 0.0),
    quat: Annotated[ArrayLike, _QUAT, quaternion(_NAME)] = (0.0, 0.0, 0.0, 1.0),
    ground: bool = True,
) -> Scene:
    """Load the boxes, spheres, cylinders and capsules of a URDF as static obstacles.

    They are its `collision` elements, in the color of the link's first `visual`. Joints are at zero, and the root link
    is at `pos` (3,), m, with the attitude `quat` (4,), a unit quaternion (x, y, z, w), world. A mesh becomes a `Mesh`,
    for Bullet alone; `Mesh.bounding_box` makes a box of it. `ground` adds a plane at z = 0.

    Raises:
        ValueError: a missing file, a file that is not a URDF, or an unsupported shape or number.
    """
    file = Path(path)
    if not file.is_file():
        raise UserError(f"{file}: there is no such file; give the path of a URDF that exists")
    try:
        robot = ET.parse(file).getroot()
    except ET.ParseError as error:
        raise UserError(f"{file}: it is not XML ({error}); give a URDF") from None
    links = {link.get("name", ""): link for link in robot.findall("link")}
    if not links:
        raise UserError(f"{file}: it has no <link>; give a URDF")
    paints = [(material.get("name"), material.find("color")) for material in robot.iter("material")]
    palette = {name: paint for name, paint in paints if paint is not None}
    places = _places(file, robot, links, (jnp.asarray(pos, float), jnp.asarray(quat, float)))
    obstacles = []
    for name, link in links.items():
        material = link.find("visual/material")
        own = None if material is None else material.find("color")
        paint = palette.get(material.get("name")) if own is None and material is not None else own
        color = GREY if paint is None else _numbers(file, paint, "rgba", 4, "")
        for collision in link.findall("collision"):
            placed = _in_parent(places[name], _pose(file, collision))
            obstacles.append(_obstacle(file, collision, placed, tuple(color)))
    return Scene.of(*obstacles, ground=ground)


def _places(file: Path, robot: ET.Element, links: dict[str, ET.Element], root: Pose) -> dict[str, Pose]:
    joints: dict[str, tuple[str, Pose]] = {}
    for joint in robot.findall("joint"):
        ends = [end.get("link", "") for tag in ("parent", "child") if (end := joint.find(tag)) is not None]
        if len(ends) != 2 or any(end not in links for end in ends):
            raise UserError(f"{file}: joint {joint.get('name')!r} connects {ends}; give links of the file as its ends")
        if ends[1] in joints:
            raise UserError(f"{file}: link {ends[1]!r} is the child of two joints; give a tree")
        joints[ends[1]] = (ends[0], _pose(file, joint))
    roots = links.keys() - joints.keys()
    if len(roots) != 1:
        raise UserError(f"{file}: {len(roots)} links are not the child of a joint; give a tree with one root")
    places = dict.fromkeys(roots, root)
    while joints:
        ready = [child for child, (parent, _) in joints.items() if parent in places]
        if not ready:
            raise UserError(f"{file}: joints form a circle of {', '.join(sorted(joints))}; give a tree")
        for child in ready:
            parent, pose = joints.pop(child)
            places[child] = _in_parent(places[parent], pose)
    return places


def _obstacle(file: Path, collision: ET.Element, pose: Pose, color: tuple[float, ...]) -> Any:
    shape = next(iter(geometry), None) if (geometry := collision.find("geometry")) is not None else None
    common: dict[str, Any] = dict(pos=pose[0], quat=pose[1], color=color)

    def length(name: str) -> float:
        return _numbers(file, shape, name, 1, None)[0]

    match None if shape is None else shape.tag:
        case "box":
            return Box(size=_numbers(file, shape, "size", 3, None), **common)
        case "sphere":
            return Sphere(radius=length("radius"), **common)
        case "cylinder":
            return Cylinder(radius=length("radius"), height=length("length"), **common)
        case "capsule":
            return Capsule(radius=length("radius"), height=length("length"), **common)
        case "mesh":
            scale = _numbers(file, shape, "scale", 3, "1 1 1")
            if len(set(scale)) > 1:
                raise UserError(f"{file}: a mesh has the scale {scale}; give the same number along each axis")
            mesh = shape.get("filename", "") if shape is not None else ""
            return Mesh(path=file.parent / mesh.removeprefix("file://"), scale=scale[0], **common)
    found = "nothing" if shape is None else f"<{shape.tag}>"
    raise UserError(f"{file}: a collision has the shape {found}; give box, sphere, cylinder, capsule or mesh")


def _pose(file: Path, element: ET.Element) -> Pose:
    """Pose in the `origin` element of a joint or a collision."""
    origin = element.find("origin")
    if origin is None:
        return _ORIGIN
    rpy = jnp.asarray(_numbers(file, origin, "rpy", 3, "0 0 0"), float)
    return np.asarray(_numbers(file, origin, "xyz", 3, "0 0 0")), rotation.from_rpy(rpy)


def _in_parent(parent: Pose, pose: Pose) -> Pose:
    """Transform a pose from a frame to its parent."""
    pos, quat = (jnp.asarray(x, float) for x in pose)
    return parent[0] + rotation.rotate(parent[1], pos), rotation.multiply(parent[1], quat)


def _numbers(file: Path, element: ET.Element | None, name: str, count: int, default: str | None) -> list[float]:
    text = default if element is None else element.get(name, default)
    try:
        numbers = [float(word) for word in (text or "").split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        where = "?" if element is None else element.tag
        raise UserError(f"{file}: {name} of <{where}> is {text!r}; give {count} numbers")
    return numbers
