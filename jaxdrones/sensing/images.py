"""Images of cameras: metric depth, segmentation and color, by analytic rays."""

import functools
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, UInt8

from jaxdrones import rotation
from jaxdrones.arguments import checked, shape
from jaxdrones.checks import check_shape
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.sensing.camera import Camera, OneCamera
from jaxdrones.sensing.frustum import Ground, View
from jaxdrones.sensing.scene import AnalyticScene, Scene
from jaxdrones.sensing.shading import shade
from jaxdrones.sensing.shapes import Box, Cylinder, Obstacle
from jaxdrones.sensing.visibility import depth, visible
from jaxdrones.state import State, TeamState
from jaxdrones.vector import along_z, cross, unit

HUB, FRONT, BACK = (0.15, 0.15, 0.2, 1.0), (0.8, 0.15, 0.1, 1.0), (0.35, 0.35, 0.4, 1.0)
"""Red, green, blue and opacity of a drone's hub and of the discs of its front and back rotors, on both backends."""
ROTORS = 4
_PHOTO_NEAR = 0.02  # m, smallest visible depth in a photograph
_NARROW = 32  # pixels: narrower images are computed as one long row, as short rows leave vectors half empty


class Images(PyTreeNode):
    """Images of the cameras of n drones; arrays have leading axes over drones, rows and columns."""

    rgb: Array
    """(n, h, w, 4) uint8: red, green, blue, opacity."""
    depth: Array
    """(n, h, w) depth along the viewing axis, m; `far` for empty pixels."""
    segmentation: Array
    """(n, h, w) int32: -1 background, 0 ground, 1 + i drone i, 1 + n + j obstacle j."""


_DEFAULT = Camera()
_POINT = shape(3, meaning="m, world")


@checked
def render(scene: AnalyticScene, params: Params, state: TeamState, camera: OneCamera = _DEFAULT) -> Images:
    """Render the camera of every drone of a team, of which only the poses matter; all drones have the same camera.

    One ray per pixel is intersected with boxes, spheres, cylinders, capsules, the ground and the drones (a hub and four
    rotor discs each), so the cost grows with pixels times solids. The depth is differentiable in the poses and in the
    scene: its gradient is that of the visible surface, without the contribution of moving silhouettes. Surfaces nearer
    than `near` are seen at `near`, also from inside. Under `jax.jit` unused images cost nothing.

    Raises:
        ValueError: a wrong shape, an argument that is not a camera, or a mesh or URDF file in the scene.
    """
    _check_team(params, state)
    return _render(scene, params, state, camera)


def _check_team(params: Params, state: State) -> None:
    check_shape("params.mass", params.mass, (len(state.pos),), f"state.pos has {len(state.pos)} drones")


def photograph(
    scene: Scene,
    params: Params,
    state: State,
    eye: ArrayLike,
    target: ArrayLike,
    camera: Camera = _DEFAULT,
) -> UInt8[Array, "h w 3"]:
    """Color image of `view`, with the same arguments."""
    return view(scene, params, state, eye, target, camera).rgb[..., :3]


@checked
def view(
    scene: AnalyticScene,
    params: Params,
    state: TeamState,
    eye: Annotated[ArrayLike, _POINT],
    target: Annotated[ArrayLike, _POINT],
    camera: OneCamera = _DEFAULT,
    colors: Float[ArrayLike, "n 3"] | None = None,
) -> Images:
    """Upright images of a team from a fixed point in the world, without an axis over drones.

    The camera is at `eye` (3,), not right above or below `target` (3,), the center of the picture, m, world; its
    mounting is ignored. The colors are red, green and blue of every drone, 0 to 1; rear rotors are lighter. By default
    all drones look alike. Other arguments and errors are those of `render`.
    """
    _check_team(params, state)
    eye, target = (jnp.asarray(x, state.pos.dtype) for x in (eye, target))
    forward = unit(target - eye)
    left = unit(cross(along_z(jnp.ones_like(eye[0])), forward))
    rays = _view(camera, eye, jnp.stack([forward, left, cross(forward, left)]), _PHOTO_NEAR)
    around = _surroundings(scene, params, state, with_drones=True, tints=colors)
    return _picture(camera, rays, around, around.active)


class _Surroundings(NamedTuple):
    """Solids visible to cameras, with their colors and labels."""

    kinds: list[Any]
    """Solids, kind by kind."""
    active: Array
    """(k,) bool, active solids."""
    owner: Array
    """(k,) drone of each solid; -1 for others."""
    colors: Array
    """(k, 3) red, green, blue."""
    labels: Array
    """(k + 1,) int32: labels of the segmentation; the last one is for empty pixels."""
    ground: int | None
    """Index of the ground, if there is one."""


def _surroundings(
    scene: Scene, params: Params, state: State, with_drones: bool, tints: ArrayLike | None = None
) -> _Surroundings:
    n, dtype = len(state.pos), state.pos.dtype
    drones = jnp.arange(n)
    obstacles = scene.shapes(dtype)
    there = [kind.active for kind in obstacles]
    kinds: list[Any] = [kind.replace(active=None) for kind in obstacles]  # what is left has derivatives
    count = sum(len(kind.pos) for kind in kinds)
    labels = [1 + n + jnp.arange(count)]
    owner = [jnp.full(count, -1)]
    if with_drones:
        kinds += drone_solids(params, state, tints)
        parts = [drones, jnp.repeat(drones, ROTORS)]
        there += [jnp.ones(len(part), bool) for part in parts]
        labels += [1 + part for part in parts]
        owner += parts
    colors = [kind.color[:, :3] for kind in kinds]
    ground = None
    if scene.ground:
        ground = sum(map(len, labels))
        kinds.append(Ground.of(dtype))
        there.append(jnp.ones(1, bool))
        labels.append(jnp.zeros(1, int))
        owner.append(jnp.full(1, -1))
        colors.append(jnp.zeros((1, 3), dtype))
    return _Surroundings(
        kinds=kinds,
        active=jnp.concatenate([*there, jnp.ones(0, bool)]),
        owner=jnp.concatenate(owner),
        colors=jnp.concatenate([*colors, jnp.zeros((0, 3), dtype)]),
        labels=jnp.concatenate([*labels, jnp.full(1, -1)]).astype(jnp.int32),
        ground=ground,
    )


def _picture(camera: Camera, view: View, around: _Surroundings, seen: Bool[Array, " k"]) -> Images:
    """Images of one camera, without an axis over drones."""
    seen_kinds = jnp.split(seen, np.cumsum([len(kind.pos) for kind in around.kinds])[:-1])
    depths = depth(view, around.kinds, seen_kinds)
    still, solids = jax.lax.stop_gradient((view, around.kinds))
    index, about = visible(still, solids, seen_kinds)
    rgb = shade(still, solids, around.colors, around.ground, index, about)
    width, height = camera.resolution
    shape = height, width
    return Images(
        rgb=rgb.reshape(*shape, 4), depth=depths.reshape(shape), segmentation=around.labels[index].reshape(shape)
    )


@functools.partial(jax.jit, static_argnames="camera", inline=True)
def _render(scene: Scene, params: Params, state: State, camera: Camera) -> Images:
    around = _surroundings(scene, params, state, with_drones=len(state.pos) > 1 or camera.sees_self)

    def one(params: Params, state: State, drone: Array) -> Images:
        seen = around.active if camera.sees_self else around.active & (around.owner != drone)
        return _picture(camera, view_of(camera, params, state), around, seen)

    return jax.vmap(one)(params, state, jnp.arange(len(state.pos)))


def view_of(camera: Camera, params: Params, state: State) -> View:
    """Rays of the camera of one drone."""
    return _view(camera, *camera.pose(params, state), camera.near_of(params))


def _view(camera: Camera, eye: Float[Array, "3"], axes: Float[Array, "3 3"], near: float | Array) -> View:
    def centers(axis: int) -> Array:
        pixels = camera.resolution[axis]
        middle = pixels / 2 + camera.principal_point[axis]
        return jnp.asarray(camera.slopes[axis] * (middle - np.arange(pixels) - 0.5) / (pixels / 2), eye.dtype)

    u, v = centers(0)[None], centers(1)[:, None]
    if u.size < _NARROW:
        u, v = (x.reshape(1, -1) for x in jnp.broadcast_arrays(u, v))
    return View(
        eye=eye,
        axes=axes,
        u=u,
        v=v,
        pixel=jnp.asarray(2 * camera.slopes[1] / camera.resolution[1], eye.dtype),
        near=jnp.asarray(near, eye.dtype),
        far=jnp.asarray(camera.far, eye.dtype),
    )


def drone_solids(params: Params, state: State, tints: ArrayLike | None = None) -> list[Obstacle]:
    """Visible parts of n drones: n hubs, and 4 n rotor discs, red in front, or in the tints (n, 3) of drones."""
    if tints is None:
        paints = jnp.asarray([HUB, FRONT, BACK])[:, None]
    else:
        paint = jnp.append(jnp.asarray(tints), jnp.ones((len(state.pos), 1)), axis=1)
        paints = jnp.stack([paint, paint, (paint + 1) / 2])
    paints = jnp.broadcast_to(paints, (3, len(state.pos), 4))

    def parts(params: Params, state: State, hub_color: Array, front_color: Array, back_color: Array):
        def at(place: Array) -> Array:
            return state.pos + rotation.rotate(state.quat, place)

        half = jnp.max(jnp.abs(params.rotor_pos[:, :2])) / 2
        up = along_z(params.collision_offset)
        above = up + along_z(params.collision_height / 3)
        hub = Box(
            pos=at(up),
            quat=state.quat,
            size=jnp.stack([2 * half, 2 * half, params.collision_height / 2]),
            color=hub_color.astype(half.dtype),
        )
        front = params.rotor_pos[:, :1] > 1e-6  # m
        colors = jnp.where(front, front_color[None], back_color[None]).astype(half.dtype)
        disc = Cylinder(
            pos=jax.vmap(at)(params.rotor_pos + above[None]),
            quat=jnp.broadcast_to(state.quat, (ROTORS, 4)),
            radius=jnp.broadcast_to(params.prop_radius, (ROTORS,)),
            height=jnp.broadcast_to(params.collision_height / 5, (ROTORS,)),
            color=colors,
        )
        return hub, disc

    hubs, discs = jax.vmap(parts)(params, state, *paints)
    return [hubs, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), discs)]
