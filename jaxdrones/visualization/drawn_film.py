"""Films by the JAX renderer, with shadows, trails, targets, names and a clock."""

import dataclasses
import functools
from collections.abc import Generator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from jaxdrones import rotation
from jaxdrones.flights.log import FlightLog
from jaxdrones.params import Params
from jaxdrones.sensing import Camera
from jaxdrones.sensing.images import Images, view
from jaxdrones.sensing.shading import SUN
from jaxdrones.state import State
from jaxdrones.visualization.overlay import Lens, Overlay
from jaxdrones.visualization.palette import as_rgb, colors
from jaxdrones.visualization.shots import FIELD_OF_VIEW, shoot

_DARKNESS = 0.45  # fraction of light lost in a shadow
_SCALED = ("rotor_pos", "prop_radius", "collision_radius", "collision_height", "collision_offset")
_ROUGH = 24.0  # levels of brightness between neighboring pixels of a smoothed edge


def frames(record: FlightLog, title: str, fps: int, size: tuple[int, int]) -> Generator[np.ndarray]:
    """Frames (height, width, 3) uint8 of a film by the JAX renderer."""
    shot = shoot(record, fps, size[0] / size[1])
    camera = Camera(resolution=size, field_of_view=FIELD_OF_VIEW)
    names = {field.name for field in dataclasses.fields(record.params)}.intersection(_SCALED)
    larger = {name: shot.scale * jnp.asarray(getattr(record.params, name)) for name in names}
    params = record.params.replace(**larger)
    tints = np.stack([as_rgb(color) for color in colors(len(record.labels))]) / 255
    draw = jax.jit(functools.partial(_draw, camera=camera))
    overlay = Overlay(record, title, shot.scale)
    for k, row in enumerate(shot.rows):
        picture, depth = draw(shot.scene, params, record.state(row), shot.eyes[k], shot.targets[k], tints)
        lens = Lens(shot.eyes[k], shot.targets[k], FIELD_OF_VIEW, size)
        yield overlay.draw(np.asarray(picture), np.asarray(depth), lens, int(row), k / fps)


def _draw(scene, params: Params, state: State, eye: Array, target: Array, tints: Array, camera: Camera):
    """Antialiased picture (h, w, 3) uint8 with shadows, and its depth (h, w), m."""
    images = view(scene, params, state, eye, target, camera, tints)
    picture = images.rgb[..., :3].astype(jnp.float32)
    if scene.ground:
        picture = picture * (1 - _DARKNESS * _shadow(images, params, state, eye, target, camera))[..., None]
    return _smooth(picture), images.depth


def _shadow(images: Images, params: Params, state: State, eye: Array, target: Array, camera: Camera) -> Array:
    """(h, w) shadow of hubs and rotors, as discs, on the ground, 0 to 1."""
    height, width = images.depth.shape
    forward, left, up = Lens.axes_of(eye, target, jnp)
    u = camera.slopes[0] * (1 - (2 * jnp.arange(width)[None] + 1) / width)
    v = camera.slopes[1] * (1 - (2 * jnp.arange(height)[:, None] + 1) / height)
    x, y = (eye[i] + images.depth * (forward[i] + u * left[i] + v * up[i]) for i in range(2))
    pixel = 1.5 * camera.slopes[1] / height * images.depth
    rotors = jax.vmap(lambda pos, quat, places: pos[None] + jax.vmap(rotation.rotate, (None, 0))(quat, places))(
        state.pos, state.quat, params.rotor_pos
    )
    centers = jnp.concatenate([state.pos, rotors.reshape(-1, 3)])
    hubs = 0.6 * jnp.max(jnp.abs(params.rotor_pos), axis=(1, 2))
    radii = jnp.concatenate([hubs, jnp.repeat(params.prop_radius, rotors.shape[1])])
    sun = jnp.asarray(SUN)
    spots = centers[:, :2] - centers[:, 2:] * (sun[:2] / sun[2])[None]

    def darker(shadow: Array, disc: tuple[Array, Array]) -> tuple[Array, None]:
        spot, radius = disc
        inside = (radius - jnp.sqrt((x - spot[0]) ** 2 + (y - spot[1]) ** 2)) / pixel
        return jnp.maximum(shadow, jnp.clip(inside + 0.5, 0, 1)), None

    shadow = jax.lax.scan(darker, jnp.zeros_like(x), (spots, radii), unroll=10)[0]
    return jnp.where(images.segmentation == 0, shadow, 0)


def _smooth(picture: Float[Array, "h w 3"]) -> UInt8[Array, "h w 3"]:
    """Antialias a picture by averaging edges over their neighborhood."""
    padded = jnp.pad(picture, ((1, 1), (1, 1), (0, 0)), mode="edge")
    height, width = picture.shape[:2]
    around = [padded[i : i + height, j : j + width] for i, j in ((1, 1), (0, 1), (1, 0), (1, 2), (2, 1))]
    mean = (around[0] + sum(around)) / 6
    gray = [x[..., 1] for x in around]  # green is most of the brightness
    contrast = functools.reduce(jnp.maximum, gray) - functools.reduce(jnp.minimum, gray)
    return jnp.round(jnp.where((contrast > _ROUGH)[..., None], mean, picture)).astype(jnp.uint8)
