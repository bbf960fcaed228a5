"""Images of cameras: metric depth, segmentation and color, by analytic rays."""

from __future__ import annotations

import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdrones import rotation
from jaxdrones.checks import check_shape
from jaxdrones.params import Params
from jaxdrones.sensing.camera import Camera, check_camera
from jaxdrones.sensing.scene import Scene, check_scene
from jaxdrones.sensing.shading import shade
from jaxdrones.sensing.shapes import Box, Cylinder, Obstacle
from jaxdrones.sensing.visibility import Ground, View, depth, visible
from jaxdrones.state import State
from jaxdrones.vector import along_z

HUB, FRONT, BACK = (0.15, 0.15, 0.2, 1.0), (0.8, 0.15, 0.1, 1.0), (0.35, 0.35, 0.4, 1.0)
"""Red, green, blue and opacity of a drone's hub and of the discs of its front and back rotors, on both backends."""
ROTORS = 4


class Images(flax.struct.PyTreeNode):
    """What the cameras of n drones see; arrays have leading axes over drones, rows and columns."""

    rgb: Array
    """(n, h, w, 4) uint8: red, green, blue, opacity."""
    depth: Array
    """(n, h, w) depth along the viewing axis, m; `far` where nothing is visible."""
    segmentation: Array
    """(n, h, w) int32: -1 nothing, 0 ground, 1 + i drone i, 1 + n + j obstacle j."""


_DEFAULT = Camera()


def render(scene: Scene, params: Params, state: State, camera: Camera = _DEFAULT) -> Images:
    """Render what the camera on every drone of a team sees.

    Boxes, spheres, cylinders, capsules, the ground and the drones (a hub and four rotor discs each) are met by a ray
    for each pixel, so that the cost grows with pixels times solids. The depth is differentiable in the poses and in the
    scene: its gradient is that of the surface that is visible, and knows nothing of a silhouette that moves over a
    pixel. What is nearer than `near` is seen at `near`, also from inside. What is not needed of the images costs
    nothing under `jax.jit`.

    Args:
        scene: of one world.
        params: of a team of n drones.
        state: of the team; only its poses matter.
        camera: the same for every drone.

    Raises:
        ValueError: a wrong shape, something else than a camera, or a mesh or URDF file in the scene.
    """
    check_camera(camera)
    check_scene(scene)
    check_shape("state.pos", state.pos, ("n", 3), "one row per drone; for many worlds use jax.vmap")
    check_shape("params.mass", params.mass, (len(state.pos),), f"state.pos has {len(state.pos)} drones")
    return _render(scene, params, state, camera)


@functools.partial(jax.jit, static_argnames="camera", inline=True)
def _render(scene: Scene, params: Params, state: State, camera: Camera) -> Images:
    n, dtype = len(state.pos), state.pos.dtype
    drones = jnp.arange(n)
    obstacles = scene.shapes(dtype)
    there = [kind.active for kind in obstacles]
    kinds: list[Any] = [kind.replace(active=None) for kind in obstacles]  # what is left has derivatives
    count = sum(len(kind.pos) for kind in kinds)
    numbers = [1 + n + jnp.arange(count)]  # labels of the segmentation, solid by solid
    own = [jnp.full(count, -1)]  # the drone of which a solid is a part
    if n > 1 or camera.sees_self:
        kinds += drone_solids(params, state)
        parts = [drones, jnp.repeat(drones, ROTORS)]
        there += [jnp.ones(len(part), bool) for part in parts]
        numbers += [1 + part for part in parts]
        own += parts
    colors = [kind.color[:, :3] for kind in kinds]
    ground = None
    if scene.ground:
        ground = sum(map(len, numbers))
        kinds.append(Ground.of(dtype))
        there.append(jnp.ones(1, bool))
        numbers.append(jnp.zeros(1, int))
        own.append(jnp.full(1, -1))
        colors.append(jnp.zeros((1, 3), dtype))
    labels = jnp.concatenate([*numbers, jnp.full(1, -1)]).astype(jnp.int32)
    of_drone = jnp.concatenate(own)
    active = jnp.concatenate([*there, jnp.ones(0, bool)])
    lengths = np.cumsum([len(kind.pos) for kind in kinds])[:-1]

    def one(params: Params, state: State, drone: Array) -> Images:
        view = view_of(camera, params, state)
        seen = active if camera.sees_self else active & (of_drone != drone)
        seen_kinds = jnp.split(seen, lengths)
        depths = depth(view, kinds, seen_kinds)
        still, solids, still_depths = jax.lax.stop_gradient((view, kinds, depths))
        index = visible(still, solids, seen_kinds)
        rgb = shade(still, solids, jnp.concatenate(colors), ground, index, still_depths)
        return Images(rgb=rgb, depth=depths, segmentation=labels[index])

    return jax.vmap(one)(params, state, drones)


def view_of(camera: Camera, params: Params, state: State) -> View:
    """The rays of the camera on one drone."""
    eye, axes = camera.pose(params, state)

    def centers(axis: int) -> Array:
        pixels = camera.resolution[axis]
        middle = pixels / 2 + camera.principal_point[axis]
        return jnp.asarray(camera.slopes[axis] * (middle - np.arange(pixels) - 0.5) / (pixels / 2), eye.dtype)

    return View(
        eye=eye,
        axes=axes,
        u=centers(0)[None],
        v=centers(1)[:, None],
        near=camera.near_of(params),
        far=jnp.asarray(camera.far, eye.dtype),
    )


def drone_solids(params: Params, state: State) -> list[Obstacle]:
    """The visible parts of n drones: n hubs, and 4 n rotor discs, red in front."""

    def parts(params: Params, state: State) -> tuple[Box, Cylinder]:
        def at(place: Array) -> Array:
            return state.pos + rotation.rotate(state.quat, place)

        half = jnp.max(jnp.abs(params.rotor_pos[:, :2])) / 2
        up = along_z(params.collision_offset)
        above = up + along_z(params.collision_height / 3)
        hub = Box(
            pos=at(up),
            quat=state.quat,
            size=jnp.stack([2 * half, 2 * half, params.collision_height / 2]),
            color=jnp.asarray(HUB, half.dtype),
        )
        front = params.rotor_pos[:, :1] > 1e-6  # m
        colors = jnp.where(front, jnp.asarray(FRONT)[None], jnp.asarray(BACK)[None]).astype(half.dtype)
        disc = Cylinder(
            pos=jax.vmap(at)(params.rotor_pos + above[None]),
            quat=jnp.broadcast_to(state.quat, (ROTORS, 4)),
            radius=jnp.broadcast_to(params.prop_radius, (ROTORS,)),
            height=jnp.broadcast_to(params.collision_height / 5, (ROTORS,)),
            color=colors,
        )
        return hub, disc

    hubs, discs = jax.vmap(parts)(params, state)
    return [hubs, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), discs)]
