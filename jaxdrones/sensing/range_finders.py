"""Ray casts, range finders and optical flow; other drones are invisible to them.

The defaults are the rates and ranges of the named devices, without noise, which data sheets give only for one surface
and one illumination.
"""

import math
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxdrones import rotation
from jaxdrones.arguments import checked, number, quaternion, shape, whole
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.quantity import Quantity
from jaxdrones.sensing.distances import as_floats
from jaxdrones.sensing.geometry import Number
from jaxdrones.sensing.scene import AnalyticScene, Scene
from jaxdrones.sensing.sensor import Sensor
from jaxdrones.sensing.shapes import Obstacle
from jaxdrones.state import State
from jaxdrones.vector import components, total

_MULTI_RANGER = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1)])
_DOWN = np.array([(0, 0, -1)])
_IDENTITY = (0.0, 0.0, 0.0, 1.0)
_NEAREST_FLOW = 0.08  # m: the PMW3901 is out of focus below


_VECTOR = shape(3, meaning="x, y, z of one ray; for many use jax.vmap")


@checked
def ray(
    scene: AnalyticScene, origin: Annotated[ArrayLike, _VECTOR], direction: Annotated[ArrayLike, _VECTOR]
) -> Float[Array, ""]:
    """Distance along a ray to the first surface of a scene, m; zero where it starts inside.

    It is differentiable in the ray and in the scene.

    Args:
        scene: of one world.
        origin: (3,) m, world; for many rays use `jax.vmap`.
        direction: (3,) unit vector, world. For another length, the distance is in multiples of that length.

    Returns:
        () m; infinity, with a zero gradient, for a miss; NaN for an origin or a direction that is not finite.

    Raises:
        ValueError: a wrong shape, or a mesh or URDF file in the scene.
    """
    origin, direction = as_floats(origin), as_floats(direction)
    hits = [jnp.full((), jnp.inf, origin.dtype)]
    if scene.ground:
        hits.append(_to_ground(origin, direction))
    for shapes in scene.shapes(origin.dtype):
        hits.append(jnp.min(jax.vmap(_to_shape, (0, None, None))(shapes, origin, direction)))
    return jnp.min(jnp.stack(hits)) + 0 * total(origin + direction)  # comparisons with NaN are false, as for a miss


def _to_shape(shape: Obstacle, origin: Float[Array, "3"], direction: Float[Array, "3"]) -> Float[Array, ""]:
    local_origin, local_direction = shape.to_local(origin), rotation.rotate_inverse(shape.quat, direction)
    first, last = shape.interval(components(local_origin), components(local_direction))
    return jnp.where((first <= last) & (last >= 0) & shape.active, jnp.where(first > 0, first, 0), jnp.inf)


def _to_ground(origin: Float[Array, "3"], direction: Float[Array, "3"]) -> Float[Array, ""]:
    height, climb = origin[2], direction[2]
    descends = climb < -jnp.finfo(climb.dtype).eps
    far = jnp.where(descends, -height / jnp.where(descends, climb, -1), jnp.inf)
    return jnp.where(height > 0, far, 0)


_OFFSET = shape(3, meaning="x, y, z, m, body", name="{argument} of a range finder", finite=True)


@checked
def range_finder(
    name: str,
    directions: np.ndarray,
    *,
    max_range: Annotated[float, number("m", "{argument} of a range finder", above=0)],
    rate: float | None = None,
    noise: Annotated[float, number("m", "{argument} of a range finder", at_least=0)] = 0.0,
    dropout: Annotated[float, number("a fraction", "{argument} of a range finder", at_least=0, at_most=1)] = 0.0,
    offset: Annotated[tuple[float, float, float], _OFFSET] = (0.0, 0.0, 0.0),
    orientation: Annotated[tuple[float, ...], quaternion("{argument} of a range finder")] = _IDENTITY,
) -> Sensor:
    """Range finder with one or more beams; its reading (...) are the ranges, m, at most `max_range`.

    Args:
        name: name of the reading in observation terms.
        directions: (..., 3) directions of the rays, of any length, in the axes of the device, x forward, y left, z up.
        max_range: m; also the reading for a miss.
        rate: measurements per second; by default one every control step.
        noise: standard deviation of a range, m.
        dropout: fraction of missing ranges, which read `max_range`.
        offset: (3,) origin of the rays relative to the center of mass, m, body axes.
        orientation: (4,) unit quaternion (x, y, z, w), device to body.

    Raises:
        ValueError: a direction of zero length, or a number out of range.
    """
    directions = np.asarray(directions, float)
    if not directions.size or directions.shape[-1:] != (3,):
        raise UserError(f"directions have shape {directions.shape}; give (..., 3), one row for each beam")
    lengths = np.linalg.norm(directions, axis=-1, keepdims=True)
    if not (np.isfinite(lengths) & (lengths > 0)).all():
        raise UserError("a direction of a range finder has no length or is not finite; give vectors along the beams")
    directions = directions / lengths
    quat = np.asarray(orientation, float) / np.linalg.norm(orientation)

    def measure(key: jax.Array, params: Params, state: State, rate: State, scene: Scene, memory: None):
        mounted = jnp.asarray(quat, state.pos.dtype)
        origin = state.pos + rotation.rotate(state.quat, jnp.asarray(offset, state.pos.dtype))

        def along(direction: Float[Array, "3"]) -> Number:
            return ray(scene, origin, rotation.rotate(state.quat, rotation.rotate(mounted, direction)))

        beams = jnp.asarray(directions.reshape(-1, 3), state.pos.dtype)
        ranges = jnp.minimum(jax.vmap(along)(beams), max_range).reshape(directions.shape[:-1])
        noise_key, dropout_key = jax.random.split(key)
        if noise:
            error = noise * jax.random.normal(noise_key, ranges.shape, ranges.dtype)
            ranges = jnp.clip(jnp.where(ranges < max_range, ranges + error, ranges), 0, max_range)
        if dropout:
            ranges = jnp.where(jax.random.bernoulli(dropout_key, dropout, ranges.shape), max_range, ranges)
        return memory, ranges

    frame = "body" if tuple(orientation) == _IDENTITY else "device"
    entries = tuple(
        Quantity(f"range along ({x:.2f}, {y:.2f}, {z:.2f})", "m", frame) for x, y, z in directions.reshape(-1, 3)
    )
    return Sensor(name, measure, bound=max_range, rate=rate, entries=entries)


def multi_ranger(max_range: float = 4.0, rate: float | None = 10.0, **others: Any) -> Sensor:
    """Ranges (5,) to the front, back, left, right and up, m: the Multi-ranger deck of the Crazyflie, five VL53L1x.

    Other arguments are those of `range_finder`; the deck's driver reads at 10 Hz.
    """
    return range_finder("multi_ranger", _MULTI_RANGER, max_range=max_range, rate=rate, **others)


def downward_range(max_range: float = 4.0, rate: float | None = 40.0, **others: Any) -> Sensor:
    """Range (1,) along the body's -z axis, m: the VL53L1x of the Crazyflie's Z-ranger and Flow decks.

    Other arguments are those of `range_finder`.
    """
    return range_finder("downward_range", _DOWN, max_range=max_range, rate=rate, **others)


@checked
def lidar(
    beams: Annotated[int, whole("{argument} of a lidar")] = 360,
    max_range: float = 12.0,
    rate: float | None = 10.0,
    **others: Any,
) -> Sensor:
    """Lidar; its reading (beams,) are ranges in its x-y plane, counterclockwise from its x axis, m.

    A scan is instantaneous. Other arguments are those of `range_finder`.
    """
    angle = 2 * np.pi / beams * np.arange(beams)
    around = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    return range_finder("lidar", around, max_range=max_range, rate=rate, **others)


@checked
def time_of_flight(
    zones: Annotated[int, whole("{argument} along an edge of the grid")] = 8,
    field_of_view: Annotated[float, number("degrees", above=0, below=180)] = 45.0,
    max_range: float = 4.0,
    rate: float | None = 15.0,
    **others: Any,
) -> Sensor:
    """Ranges (zones, zones), rows from top to bottom and columns from left to right, m: the VL53L5CX.

    The zones have equal angles over the field of view (degrees), and each is measured by the ray in its middle. Other
    arguments are those of `range_finder`; the device looks forward.
    """
    slope = np.tan(np.radians(field_of_view) * ((zones - 1) / 2 - np.arange(zones)) / zones)
    up, left = np.meshgrid(slope, slope, indexing="ij")
    rays = np.stack([np.ones_like(left), left, up], axis=-1)
    return range_finder("time_of_flight", rays, max_range=max_range, rate=rate, **others)


@checked
def optical_flow(
    rate: float | None = 100.0,
    noise: Annotated[float, number("rad/s", "{argument} of {function}", at_least=0)] = 0.0,
    dropout: Annotated[float, number("a fraction", "{argument} of {function}", at_least=0, at_most=1)] = 0.0,
) -> Sensor:
    """Optical flow sensor, the PMW3901; its reading (2,) is the flow backward and to the right, rad/s.

    With the velocity v and the body rates w, in body axes, and the range d along the body's -z axis, the flow is (v_x /
    d - w_y, v_y / d + w_x); ranges are clamped to at least 0.08 m. Times 35 pixels / 0.717 rad it is the Crazyflie's
    count per second (its `mm_flow.c`). `noise` is a standard deviation, rad/s, and `dropout` the fraction of missing
    measurements, which read zero.
    """

    def measure(key: jax.Array, params: Params, state: State, rate: State, scene: Scene, memory: None):
        noise_key, dropout_key = jax.random.split(key)
        below = jnp.maximum(ray(scene, state.pos, -rotation.z_axis(state.quat)), _NEAREST_FLOW)
        vel = rotation.rotate_inverse(state.quat, state.vel)
        turn = jnp.stack([-state.omega[1], state.omega[0]])
        flow = vel[:2] / below + turn
        if noise:
            flow += noise * jax.random.normal(noise_key, flow.shape, flow.dtype)
        if dropout:
            flow = jnp.where(jax.random.bernoulli(dropout_key, dropout), 0, flow)
        return memory, flow

    entries = tuple(Quantity(f"flow {way}", "rad/s", "body") for way in ("backward", "to the right"))
    return Sensor("optical_flow", measure, bound=math.inf, rate=rate, entries=entries)
