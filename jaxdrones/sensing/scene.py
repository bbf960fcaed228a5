"""The surroundings as data: a ground plane and obstacles that do not move, for every backend, sensor and camera."""

from __future__ import annotations

import math
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array

from jaxdrones.checks import check_finite, check_quaternion, check_shape, check_switch, is_known, shown
from jaxdrones.sensing.files import File, Mesh, Urdf
from jaxdrones.sensing.shapes import LENGTHS, Box, Capsule, Cylinder, Obstacle, Sphere, single

__all__ = ["Box", "Capsule", "Cylinder", "Mesh", "Scene", "Sphere", "Urdf"]

KINDS: dict[str, type[Obstacle]] = {"boxes": Box, "spheres": Sphere, "cylinders": Cylinder, "capsules": Capsule}
"""The fields of a scene that hold arrays."""


class Scene(flax.struct.PyTreeNode, kw_only=True):
    """Obstacles, and a ground plane at z = 0 unless left out. `Scene.of` builds one.

    Obstacles are numbered kind by kind: boxes, spheres, cylinders, capsules, meshes, URDF files; within a kind as they
    were given.
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
    def of(cls, *obstacles: Obstacle | File, ground: bool = True) -> Scene:
        """A scene of obstacles of any kind.

        Args:
            obstacles: `Box`, `Sphere`, `Cylinder` and `Capsule`, each a single obstacle or many of them. Of many the
                arrays have leading axes, and an array without them is shared by all. They may be traced. `Mesh` and
                `Urdf` are for Bullet alone.
            ground: whether there is a ground plane at z = 0.

        Raises:
            ValueError: something else than an obstacle, or one of a wrong shape or size.
        """
        check_switch("ground", ground)
        for obstacle in obstacles:
            if not isinstance(obstacle, Obstacle | File):
                known = ", ".join(kind.__name__ for kind in (*KINDS.values(), Mesh, Urdf))
                raise ValueError(f"{shown(obstacle)} is not an obstacle; give each as an argument of its own: {known}")
        arrays: dict[str, Any] = {}
        for name, kind in KINDS.items():
            rows = [_rows(obstacle) for obstacle in obstacles if isinstance(obstacle, kind)]
            if sum(len(row.pos) for row in rows):  # an array without entries stands for nothing
                arrays[name] = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *rows)
        meshes = tuple(obstacle for obstacle in obstacles if isinstance(obstacle, Mesh))
        urdfs = tuple(obstacle for obstacle in obstacles if isinstance(obstacle, Urdf))
        return cls(**arrays, meshes=meshes, urdfs=urdfs, ground=ground)

    @property
    def has_obstacles(self) -> bool:
        """Whether there is anything but the ground; known before the program runs."""
        return any(getattr(self, name) is not None for name in KINDS) or bool(self.meshes or self.urdfs)

    @property
    def count(self) -> int:
        """Number of obstacles; known before the program runs."""
        stacks = [stack for name in KINDS if (stack := getattr(self, name)) is not None]
        return sum(len(stack.pos) for stack in stacks) + len(self.meshes) + len(self.urdfs)

    @property
    def obstacles(self) -> tuple[Any, ...]:
        """Single obstacles, in the order of their numbers."""
        stacks = [stack for name in KINDS if (stack := getattr(self, name)) is not None]
        return (*(single(stack, i) for stack in stacks for i in range(len(stack.pos))), *self.meshes, *self.urdfs)

    def shapes(self, dtype: DTypeLike) -> list[Obstacle]:
        """The kinds of obstacles in the scene, each with a leading axis over its obstacles, as arrays of this type."""
        stacks = [stack for name in KINDS if (stack := getattr(self, name)) is not None]
        return [jax.tree.map(lambda x: jnp.asarray(x, dtype), stack) for stack in stacks]


def check_scene(scene: Any, files: bool = False) -> None:
    """Raise unless `scene` is the scene of one world, without meshes and URDF files unless those are allowed.

    Args:
        scene: what was given.
        files: whether meshes and URDF files are allowed.
    """
    if not isinstance(scene, Scene):
        raise ValueError(
            f"scene is {shown(scene)}; give a jaxdrones.sensing.Scene, for example jaxdrones.sensing.Scene.of(box)"
        )
    for name in KINDS:
        stack = getattr(scene, name)
        if stack is not None:
            check_shape(f"scene.{name}.pos", stack.pos, ("k", 3), "of one world; for many worlds use jax.vmap")
    if not files and (scene.meshes or scene.urdfs):
        kind = type((*scene.meshes, *scene.urdfs)[0]).__name__
        known = ", ".join(kind.__name__ for kind in KINDS.values())
        raise ValueError(
            f"the scene has a {kind}, which only Bullet reads; give {known}, or ask the Bullet backend, for example "
            "step.contacts(params, state)"
        )


def _rows(obstacle: Obstacle) -> Obstacle:
    """One obstacle or many as arrays with one leading axis, checked where they have values."""
    kind = type(obstacle).__name__
    arrays: dict[str, Array] = {}
    for name, value in vars(obstacle).items():
        arrays[name] = array = jnp.asarray(value, float)
        length = LENGTHS.get(name)
        if length and array.shape[-1:] != (length,):
            raise ValueError(f"{name} of {kind} is {shown(value)}; give {length} numbers")
        check_finite(f"{name} of {kind}", value)
        if name not in ("pos", "quat", "color") and is_known(value) and not (np.asarray(value) > 0).all():
            raise ValueError(f"{name} of {kind} is {shown(value)}; give positive numbers (m)")
    check_quaternion(f"quat of {kind}", obstacle.quat)
    arrays["quat"] = arrays["quat"] / jnp.linalg.norm(arrays["quat"], axis=-1, keepdims=True)
    axes = {name: array.shape[: array.ndim - (name in LENGTHS)] for name, array in arrays.items()}
    try:
        leading = np.broadcast_shapes(*axes.values())
    except ValueError:
        given = ", ".join(f"{name} {arrays[name].shape}" for name in arrays)
        raise ValueError(f"the arrays of {kind} do not fit together: {given}; give as many of each, or one") from None

    def rows(name: str, array: Array) -> Array:
        one = array.shape[array.ndim - (name in LENGTHS) :]
        return jnp.broadcast_to(array, leading + one).reshape(math.prod(leading), *one)

    return obstacle.replace(**{name: rows(name, array) for name, array in arrays.items()})
