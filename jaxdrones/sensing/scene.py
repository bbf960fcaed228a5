"""Scene of a ground plane and static obstacles, for every backend, sensor and camera."""

import dataclasses
import functools
import math
from typing import Annotated, Any, Self

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jaxdrones.arguments import Switch, checked, whole
from jaxdrones.checks import check_finite, check_quaternion, check_shape, is_concrete, look_up, short_repr
from jaxdrones.errors import UserError
from jaxdrones.pytree import PyTreeNode
from jaxdrones.sensing.distances import Surface, as_floats, distance_of, merged, nearest_few_of, nearest_of, touched_of
from jaxdrones.sensing.files import File, Mesh, Urdf
from jaxdrones.sensing.geometry import Number
from jaxdrones.sensing.shapes import LENGTHS, Box, Capsule, Cylinder, Obstacle, Sphere, single

__all__ = ["Box", "Capsule", "Cylinder", "Mesh", "Scene", "Sphere", "Urdf"]

KINDS: dict[str, type[Obstacle]] = {"boxes": Box, "spheres": Sphere, "cylinders": Cylinder, "capsules": Capsule}
"""The fields of a scene that hold arrays."""


class Scene(PyTreeNode, kw_only=True):
    """Static obstacles, and by default a ground plane at z = 0. `Scene.of` builds one.

    Obstacles are numbered kind by kind: boxes, spheres, cylinders, capsules, meshes, URDF files; within a kind in the
    order of the arguments. Queries of distances and surfaces take one point (3,), m, world; use `jax.vmap` for many.
    They are differentiable in point and scene, and raise `ValueError` for meshes and URDF files.
    """

    boxes: Box | None = None
    """All k boxes, with a leading axis on every array; `None` where there are none."""
    spheres: Sphere | None = None
    """All k spheres, with a leading axis on every array; `None` where there are none."""
    cylinders: Cylinder | None = None
    """All k cylinders, with a leading axis on every array; `None` where there are none."""
    capsules: Capsule | None = None
    """All k capsules, with a leading axis on every array; `None` where there are none."""
    meshes: tuple[Mesh, ...] = flax.struct.field(pytree_node=False, default=())
    """Meshes, for Bullet alone."""
    urdfs: tuple[Urdf, ...] = flax.struct.field(pytree_node=False, default=())
    """Bodies from URDF files, for Bullet alone."""
    ground: bool = flax.struct.field(pytree_node=False, default=True)
    """Whether there is a ground plane."""

    @classmethod
    @checked
    def of(cls, *obstacles: Obstacle | File, ground: Switch = True) -> Self:
        """Build a scene of obstacles of any kind.

        Args:
            obstacles: `Box`, `Sphere`, `Cylinder` and `Capsule`, each a single obstacle or many of them with leading
                axes; an array without leading axes is shared by all. Arrays may be traced. `Mesh` and `Urdf` are for
                Bullet alone.
            ground: whether there is a ground plane at z = 0.

        Raises:
            ValueError: an argument that is not an obstacle, one of a wrong shape or size, or several classes of a kind.
        """
        for obstacle in obstacles:
            if not isinstance(obstacle, (*KINDS.values(), File)):
                known = ", ".join(kind.__name__ for kind in (*KINDS.values(), Mesh, Urdf))
                raise UserError(
                    f"{short_repr(obstacle)} is not an obstacle of a known kind; give each as its own argument: {known}"
                )
        arrays: dict[str, Any] = {}
        for name, kind in KINDS.items():
            rows = [_rows(obstacle) for obstacle in obstacles if isinstance(obstacle, kind)]
            if len(classes := dict.fromkeys(map(type, rows))) > 1:
                given = " and ".join(own.__name__ for own in classes)
                raise UserError(f"the {name} are of the classes {given}; give {kind.__name__} for all of them")
            if sum(len(row.pos) for row in rows):  # an empty array is ignored
                arrays[name] = _joined(rows)
        meshes = tuple(obstacle for obstacle in obstacles if isinstance(obstacle, Mesh))
        urdfs = tuple(obstacle for obstacle in obstacles if isinstance(obstacle, Urdf))
        return cls(**arrays, meshes=meshes, urdfs=urdfs, ground=ground)

    @property
    def has_obstacles(self) -> bool:
        """Whether there are obstacles; static."""
        return bool(self._stacks or self.meshes or self.urdfs)

    @property
    def count(self) -> int:
        """Number of obstacles; static."""
        return sum(len(stack.pos) for stack in self._stacks) + len(self.meshes) + len(self.urdfs)

    @property
    def obstacles(self) -> tuple[Any, ...]:
        """Single obstacles, in the order of their numbers."""
        return (*(single(stack, i) for stack in self._stacks for i in range(len(stack.pos))), *self.meshes, *self.urdfs)

    @property
    def numbered(self) -> dict[int, Any]:
        """Active obstacles by their numbers; the scene must be concrete."""
        return {i: solid for i, solid in enumerate(self.obstacles) if isinstance(solid, File) or solid.active}

    def shapes(self, dtype: DTypeLike) -> list[Obstacle]:
        """Obstacles of each kind, with a leading axis, as arrays of this type."""
        return [_as_arrays(stack, dtype) for stack in self._stacks]

    def distance(self, point: ArrayLike) -> Array:
        """Signed distance of a point from the nearest surface, m; negative inside an obstacle or underground.

        Where obstacles overlap, the deepest one counts. It is infinity in an empty scene.
        """
        shapes, point = self._at(point)
        return distance_of(shapes, self.ground, point)

    def nearest(self, point: ArrayLike) -> Surface:
        """Nearest surface: signed distance, nearest point and outward normal, also from inside.

        Ties are broken arbitrarily.
        """
        shapes, point = self._at(point)
        return nearest_of(shapes, self.ground, point)

    def nearest_few(self, point: ArrayLike, count: int) -> Surface:
        """Nearest surfaces of each of the `count` nearest obstacles, the ground among them; the nearest first.

        They have a leading axis of length `count`; see `Surface` for those beyond the number of obstacles.
        """
        shapes, point = self._at(point)
        return nearest_few_of(shapes, self.ground, point, count)

    def touched(self, points: Float[Array, "m 3"], within: Number) -> Surface:
        """Nearest obstacle surface for each of several points of one body, near each other.

        Faster than `nearest`: only obstacles within reach of the body are considered. Where no obstacle is nearer than
        `within` (m) to a point, the surface is that of an arbitrary obstacle.
        """
        shapes = self._analytic(points.dtype)
        if not shapes:
            raise UserError("the scene has no obstacles; check scene.has_obstacles first")
        (obstacles,) = merged(shapes)
        return touched_of(obstacles, points, within)

    def contains(self, point: ArrayLike) -> Bool[Array, ""]:
        """Whether a point (3,) (m, world) is inside an obstacle or underground."""
        return self.distance(point) < 0

    @checked
    def padded(self, **capacity: Annotated[int, whole("capacity of {argument}")]) -> Self:
        """Pad the arrays of a scene with inactive obstacles to lengths by name, for example `boxes=8, cylinders=30`.

        Worlds with different numbers of obstacles then have one structure, and can be stacked and mapped.

        Raises:
            ValueError: an unknown kind, or more obstacles than the array holds.
        """
        arrays: dict[str, Any] = {}
        for name, length in capacity.items():
            kind = look_up("kind of obstacles", name, KINDS)
            stack = getattr(self, name)
            count = 0 if stack is None else len(stack.pos)
            if count > length:
                raise UserError(
                    f"the scene has {count} {name} and the array holds {length}; give {name}={count} or more"
                )
            rest = _inactive(kind, length - count)
            arrays[name] = _joined([rest] if stack is None else [stack, rest])
        return self.replace(**arrays)

    @property
    def _stacks(self) -> list[Any]:
        return [stack for name in KINDS if (stack := getattr(self, name)) is not None]

    def _analytic(self, dtype: DTypeLike) -> list[Obstacle]:
        check_scene("scene", self)
        return self.shapes(dtype)

    def _at(self, point: ArrayLike) -> tuple[list[Obstacle], Array]:
        point = as_floats(point)
        check_shape("point", point, (3,), "x, y, z of one point; for many use jax.vmap")
        return self._analytic(point.dtype), point


def check_scene(name: str, scene: Any, files: bool = False) -> None:
    """Raise unless `scene` is the scene of one world; meshes and URDF files need `files`."""
    if not isinstance(scene, Scene):
        given = f"{name} is {short_repr(scene)}"
        raise UserError(f"{given}; give a jaxdrones.sensing.Scene, for example jaxdrones.sensing.Scene.of(box)")
    for name in KINDS:
        stack = getattr(scene, name)
        if stack is not None:
            check_shape(f"scene.{name}.pos", stack.pos, ("k", 3), "of one world; for many worlds use jax.vmap")
    if not files and (scene.meshes or scene.urdfs):
        file = (*scene.meshes, *scene.urdfs)[0]
        builder = "mesh.bounding_box()" if isinstance(file, Mesh) else "jaxdrones.sensing.from_urdf(path)"
        known = ", ".join(kind.__name__ for kind in KINDS.values())
        raise UserError(
            f"the scene has a {type(file).__name__}, supported by Bullet only; give {known}, for example "
            f"{builder} in its place, or use the Bullet backend, for example step.contacts(params, state)"
        )


AnyScene = Annotated[Scene, functools.partial(check_scene, files=True)]
"""Scene of one world."""
AnalyticScene = Annotated[Scene, check_scene]
"""Scene of one world without meshes and URDF files."""


def _as_arrays(obstacles: Obstacle, dtype: DTypeLike) -> Obstacle:
    active = jnp.asarray(_mask(obstacles), bool)
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), obstacles.replace(active=None)).replace(active=active)


def _mask(obstacles: Obstacle) -> Any:
    return jnp.ones(len(obstacles.pos), bool) if obstacles.active is None else obstacles.active


def _inactive(kind: type[Obstacle], count: int) -> Obstacle:
    """Inactive obstacles of a kind, with a leading axis."""
    own = {field.name for field in dataclasses.fields(kind)} - {field.name for field in dataclasses.fields(Obstacle)}
    sizes: dict[str, Any] = {name: jnp.ones(LENGTHS.get(name, ())) for name in own}
    return _rows(kind(pos=jnp.zeros((count, 3)), active=False, **sizes))


def _joined(rows: list[Any]) -> Any:
    """Concatenated obstacles; with a mask if any has one."""
    if any(row.active is not None for row in rows):
        rows = [row.replace(active=_mask(row)) for row in rows]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *rows)


def _rows(obstacle: Obstacle) -> Obstacle:
    """One obstacle or many as arrays with one leading axis; concrete values are validated."""
    kind = type(obstacle).__name__
    arrays: dict[str, Array] = {}
    for name, value in vars(obstacle).items():
        if name == "active" and value is None:
            continue
        arrays[name] = array = jnp.asarray(value, bool if name == "active" else float)
        if name == "active" and jnp.asarray(value).dtype.kind != "b":
            raise UserError(f"active of {kind} is {short_repr(value)}; give True or False")
        length = LENGTHS.get(name)
        if length and array.shape[-1:] != (length,):
            raise UserError(f"{name} of {kind} is {short_repr(value)}; give {length} numbers")
        check_finite(f"{name} of {kind}", value)
        if name not in ("pos", "quat", "color", "active") and is_concrete(value) and not (np.asarray(value) > 0).all():
            raise UserError(f"{name} of {kind} is {short_repr(value)}; give positive numbers (m)")
    check_quaternion(f"quat of {kind}", obstacle.quat)
    arrays["quat"] = arrays["quat"] / jnp.linalg.norm(arrays["quat"], axis=-1, keepdims=True)
    axes = {name: array.shape[: array.ndim - (name in LENGTHS)] for name, array in arrays.items()}
    try:
        leading = np.broadcast_shapes(*axes.values())
    except ValueError:
        given = ", ".join(f"{name} {arrays[name].shape}" for name in arrays)
        raise UserError(f"the arrays of {kind} do not fit together: {given}; give as many of each, or one") from None

    def rows(name: str, array: Array) -> Array:
        one = array.shape[array.ndim - (name in LENGTHS) :]
        return jnp.broadcast_to(array, leading + one).reshape(math.prod(leading), *one)

    return obstacle.replace(**{name: rows(name, array) for name, array in arrays.items()})


def scene_to_dict(scene: Scene) -> dict[str, Any]:
    """Convert the concrete scene of one world to a JSON object; inactive obstacles are left out.

    It has `ground`, whether there is a ground plane, and `obstacles`, a list of objects with the `kind` (such as `Box`)
    and the fields of each obstacle.
    """
    obstacles = []
    for solid in scene.numbered.values():
        fields = {name: x for name, x in vars(solid).items() if name not in ("active", "path")}
        entry = {"kind": type(solid).__name__} | {name: np.asarray(x, float).tolist() for name, x in fields.items()}
        obstacles.append(entry | {"path": str(solid.path)} if isinstance(solid, File) else entry)
    return {"ground": scene.ground, "obstacles": obstacles}


def scene_from_dict(entries: dict[str, Any]) -> Scene:
    """Inverse of `scene_to_dict`; obstacles are in the order of their numbers."""
    classes: dict[str, Any] = {kind.__name__: kind for kind in (*KINDS.values(), Mesh, Urdf)}
    obstacles = []
    for entry in entries["obstacles"]:
        fields = {name: tuple(x) if isinstance(x, list) else x for name, x in entry.items() if name != "kind"}
        obstacles.append(classes[entry["kind"]](**fields))
    return Scene.of(*obstacles, ground=entries["ground"])
