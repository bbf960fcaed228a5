"""Forests, rooms, gate tracks and the obstacles of gym-pybullet-drones (2021).

Random scenes have the same array shapes for every key, so one compiled program serves any number of worlds.
"""

from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jaxdrones import rotation
from jaxdrones.arguments import Key, NonNegativeInt, checked, number, shape
from jaxdrones.checks import check_number, check_shape, is_concrete
from jaxdrones.errors import UserError
from jaxdrones.sensing.scene import Scene
from jaxdrones.sensing.shapes import Box, Cylinder, Obstacle, Sphere
from jaxdrones.vector import sin_cos

_WALL = (0.8, 0.8, 0.75, 0.2)  # red, green, blue, opacity, so that the viewer shows what is inside
_WOOD = (0.4, 0.28, 0.18, 1.0)
_GREEN, _STONE = (0.2, 0.5, 0.2, 1.0), (0.5, 0.5, 0.55, 1.0)
_SPHERE_RADIUS = (0.2, 0.5)  # m
_BOX_EDGE = (0.3, 1.0)  # m
BEAMS = 4
"""Boxes of a gate."""
_MAX_TREES = 10_000
_HEIGHT_OF_FLIGHT = 1.5  # m; default height of the points to keep free
_MOST_TILTED = 90.0  # degrees, excluded


def _check_range(name: str, value: Any) -> None:
    """Raise unless this is a range of numbers that are not negative, or traced."""
    check_shape(name, value, (2,), "the smallest and the largest")
    low, high = value
    check_number(f"smallest {name}", low, at_least=0)
    check_number(f"largest {name}", high, at_least=float(low) if is_concrete(low) else None)


def _check_density(name: str, density: Any) -> None:
    _check_range(f"{name} of a forest", density if np.ndim(density) else (density, density))


def _check_size(name: str, size: Any) -> None:
    check_shape(f"{name} of a room", size, (3,), "length, width and height, m")
    for edge in size:
        check_number(f"{name} of a room", edge, "m", above=0)


_LENGTH = Annotated[float, number("m", "{argument} of a {function}", above=0)]
_DISTANCE = Annotated[float, number("m", "{argument} of a {function}", at_least=0)]
_RADII = Annotated[tuple[float, float], _check_range]


@checked
def forest(
    key: Key,
    *,
    density: Annotated[float | tuple[float, float], _check_density] = 0.15,
    length: _LENGTH = 20.0,
    width: _LENGTH = 10.0,
    radius: _RADII = (0.1, 0.3),
    height: _LENGTH = 5.0,
    tilt: Annotated[float, number("degrees", "{argument} of a forest", at_least=0, below=_MOST_TILTED)] = 0.0,
    spheres: NonNegativeInt = 0,
    boxes: NonNegativeInt = 0,
    keep_free: ArrayLike | None = None,
    clearance: _DISTANCE = 1.5,
) -> Scene:
    """Random forest on a strip from x = 0 to `length` and from y = -`width`/2 to `width`/2.

    Places are uniform and independent, as in the forests of Karaman and Frazzoli (2012); trees may overlap. Trees
    within `clearance` of a point of `keep_free` are left out.

    Args:
        key: random key; the same key gives the same forest.
        density: trees per m^2, before some are left out; a pair of numbers is the range of a uniform distribution.
        length: of the strip, m.
        width: of the strip, m.
        radius: of the trunks, U(first, second), m.
        height: of the trunks, m.
        tilt: largest tilt of a trunk, U(0, tilt) about a random level axis, degrees; below 90.
        spheres: number of balls, of radius U(0.2, 0.5) m, anywhere up to `height`.
        boxes: number of boxes, with edges of U(0.3, 1) m and any heading, anywhere up to `height`.
        keep_free: (k, 3) points to keep free of obstacles, m; by default the two ends of the strip's center line, at
            a height of 1.5 m.
        clearance: smallest distance of an obstacle from those points, m.

    Raises:
        ValueError: no random key, a number out of range, or more than 10,000 trees.
    """
    low, high = np.broadcast_to(np.asarray(density), (2,)).tolist()
    trees = round(high * length * width)
    check_number("density x length x width of a forest", high * length * width, "trees", at_most=_MAX_TREES)
    count_key, tree_key, sphere_key, box_key = jax.random.split(key, 4)
    free = _points([(0, 0, _HEIGHT_OF_FLIGHT), (length, 0, _HEIGHT_OF_FLIGHT)] if keep_free is None else keep_free)
    corners = jnp.array([[0, -width / 2, 0], [length, width / 2, height]])

    count = jnp.round(jax.random.uniform(count_key, minval=low, maxval=high) * length * width)
    trunks = _trunks(tree_key, trees, corners, radius, tilt)
    alive = jnp.arange(trees) < count
    others = _spheres(sphere_key, spheres, corners), _boxes(box_key, boxes, corners)
    return Scene.of(
        trunks.replace(active=alive & _is_free(trunks, free, clearance)),
        *(solids.replace(active=_is_free(solids, free, clearance)) for solids in others),
    )


@checked
def room(
    size: Annotated[tuple[float, float, float], _check_size] = (8.0, 8.0, 3.0),
    *,
    key: Key | None = None,
    pillars: NonNegativeInt = 0,
    spheres: NonNegativeInt = 0,
    boxes: NonNegativeInt = 0,
    radius: _RADII = (0.15, 0.3),
    keep_free: ArrayLike = (),
    clearance: _DISTANCE = 0.5,
    wall: _LENGTH = 0.2,
) -> Scene:
    """Room centered at the origin: four walls, a ceiling, random pillars and clutter.

    `size` is the inner length, width and height, `wall` the thickness of walls and ceiling, m. Pillars reach from floor
    to ceiling; they and the clutter need a random key. Other arguments are those of `forest`.
    """
    x, y, z = size
    shell = Box(
        pos=jnp.array(
            [[s * (x + wall) / 2, 0, z / 2] for s in (1, -1)]
            + [[0, s * (y + wall) / 2, z / 2] for s in (1, -1)]
            + [[0, 0, z + wall / 2]]
        ),
        size=jnp.array([[wall, y + 2 * wall, z]] * 2 + [[x, wall, z]] * 2 + [[x + 2 * wall, y + 2 * wall, wall]]),
        color=_WALL,
    )
    if not pillars + spheres + boxes:
        return Scene.of(shell)
    if key is None:
        raise UserError("a room with pillars or clutter is drawn from a key; give key=jax.random.key(0)")
    pillar_key, sphere_key, box_key = jax.random.split(key, 3)
    free, corners = _points(keep_free), jnp.array([[-x / 2, -y / 2, 0], [x / 2, y / 2, z]])
    inside = (
        _trunks(pillar_key, pillars, corners, radius),
        _spheres(sphere_key, spheres, corners),
        _boxes(box_key, boxes, corners),
    )
    return Scene.of(shell, *(solids.replace(active=_is_free(solids, free, clearance)) for solids in inside))


_POSES = shape("k", 4, meaning="x, y, z (m) and heading (rad) of every gate", name="gates of a track")
_CENTER = shape(3, meaning="one gate; for many use jax.vmap", name="pos of a gate")


@checked
def track(gates: Annotated[ArrayLike, _POSES], opening: float = 0.4, frame: float = 0.16, depth: float = 0.05) -> Scene:
    """Gates at given poses, four boxes each, in the order of the poses.

    A pose is x, y, z of the center of the opening (m) and the heading in which it is crossed (rad); other arguments are
    those of `gate`.
    """
    gates = jnp.asarray(gates, float)
    return Scene.of(jax.vmap(lambda pose: gate(pose[:3], pose[3], opening, frame, depth))(gates))


@checked
def gate(
    pos: Annotated[ArrayLike, _CENTER],
    yaw: ArrayLike = 0.0,
    opening: _LENGTH = 0.4,
    frame: _LENGTH = 0.16,
    depth: _LENGTH = 0.05,
) -> Box:
    """The four beams of a gate: a square opening in a square frame.

    The default size is that of the gates of lsy_drone_racing: 0.4 m inside, 0.72 m outside. For many gates use
    `jax.vmap`.

    Args:
        pos: (3,) center of the opening, m, world.
        yaw: () heading in which the gate is crossed, rad.
        opening: edge of the opening, m.
        frame: width of the beams, m.
        depth: of the beams along the heading, m.
    """
    pos, yaw = jnp.asarray(pos, float), jnp.asarray(yaw, float)
    outer, offset = opening + 2 * frame, (opening + frame) / 2
    sin, cos = sin_cos(yaw)
    left = jnp.array([0.0, 0.0, offset, -offset], pos.dtype)
    up = jnp.array([offset, -offset, 0.0, 0.0], pos.dtype)
    lying, standing = (depth, outer, frame), (depth, frame, opening)
    return Box(
        pos=pos[None] + jnp.stack([-sin * left, cos * left, up], axis=-1),
        quat=jnp.tile(_level(yaw)[None], (BEAMS, 1)),
        size=jnp.array([lying, lying, standing, standing], pos.dtype),
        color=jnp.tile(jnp.array([[0.9, 0.35, 0.1, 1.0]], pos.dtype), (BEAMS, 1)),
    )


def obstacles_2021() -> Scene:
    """Default obstacles of gym-pybullet-drones (2021), made of boxes and spheres.

    They are the walls of a courtyard around the origin, a duck at (-0.5, -0.5), a cube of 1 m at (-0.5, -2.5) and a
    ball of 1 m at (0, 2).
    """
    wall = (0.55, 0.3, 0.25, 1.0)
    return Scene.of(
        Box(pos=(6.0, 0.0, 1.0), size=(0.3, 12.0, 2.0), color=wall),
        Box(pos=(-6.0, 0.0, 1.0), size=(0.3, 12.0, 2.0), color=wall),
        Sphere(pos=(-0.5, -0.5, 0.05), radius=0.05, color=(1.0, 0.85, 0.0, 1.0)),
        Box(pos=(-0.5, -2.5, 0.5), size=(1.0, 1.0, 1.0), color=(0.4, 0.6, 0.9, 1.0)),
        Sphere(pos=(0.0, 2.0, 0.5), radius=0.5, color=(0.95, 0.95, 0.95, 1.0)),
    )


def _points(points: ArrayLike) -> Float[Array, "k 3"]:
    array = jnp.asarray(points, float)
    array = array.reshape(0, 3) if array.size == 0 else array
    if array.ndim != 2 or array.shape[1] != 3:
        raise UserError(f"keep_free has shape {array.shape}; give points (k, 3), m")
    return array


def _trunks(
    key: jax.Array, count: int, corners: Float[Array, "2 3"], radius: tuple[float, float], tilt: float = 0.0
) -> Cylinder:
    """Vertical cylinders at random places between two corners, from the ground to the height of the second corner."""
    place_key, radius_key, tilt_key, axis_key = jax.random.split(key, 4)
    height = corners[1, 2]
    foot = _random_places(place_key, count, corners) * jnp.array([[1, 1, 0]])
    sin, cos = sin_cos(jax.random.uniform(axis_key, (count,), maxval=2 * jnp.pi))
    angle = jnp.radians(jax.random.uniform(tilt_key, (count, 1), maxval=tilt))
    quat = jax.vmap(rotation.exp)(angle * jnp.stack([cos, sin, 0 * sin], axis=-1))
    return Cylinder(
        pos=foot + height / 2 * jax.vmap(rotation.z_axis)(quat),
        quat=quat,
        radius=jax.random.uniform(radius_key, (count,), minval=radius[0], maxval=radius[1]),
        height=jnp.full(count, height),
        color=jnp.tile(jnp.array([_WOOD]), (count, 1)),
    )


def _spheres(key: jax.Array, count: int, corners: Float[Array, "2 3"]) -> Sphere:
    place_key, radius_key = jax.random.split(key)
    low, high = _SPHERE_RADIUS
    return Sphere(
        pos=_random_places(place_key, count, corners),
        quat=_level(jnp.zeros(count)),
        radius=jax.random.uniform(radius_key, (count,), minval=low, maxval=high),
        color=jnp.tile(jnp.array([_GREEN]), (count, 1)),
    )


def _boxes(key: jax.Array, count: int, corners: Float[Array, "2 3"]) -> Box:
    place_key, size_key, yaw_key = jax.random.split(key, 3)
    low, high = _BOX_EDGE
    return Box(
        pos=_random_places(place_key, count, corners),
        quat=_level(jax.random.uniform(yaw_key, (count,), maxval=2 * jnp.pi)),
        size=jax.random.uniform(size_key, (count, 3), minval=low, maxval=high),
        color=jnp.tile(jnp.array([_STONE]), (count, 1)),
    )


def _random_places(key: jax.Array, count: int, corners: Float[Array, "2 3"]) -> Float[Array, "k 3"]:
    return jax.random.uniform(key, (count, 3), minval=corners[:1], maxval=corners[1:])


def _level(yaw: Float[Array, "*k"]) -> Float[Array, "*k 4"]:
    """Quaternions of headings, rad."""
    sin, cos = sin_cos(yaw / 2)
    return jnp.stack([0 * sin, 0 * sin, sin, cos], axis=-1)


def _is_free(solids: Obstacle, points: Float[Array, "k 3"], clearance: float) -> Bool[Array, " n"]:
    def gap(solid: Obstacle, point: Array) -> Array:
        return solid.distance(solid.to_local(point))

    gaps = jax.vmap(jax.vmap(gap, (None, 0)), (0, None))(solids, points)
    return jnp.all(gaps >= clearance, axis=1)
