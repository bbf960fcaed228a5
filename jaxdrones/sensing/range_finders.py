"""Range finders and optical flow: sensors that measure by a few rays. They see obstacles and ground, not other drones.

The defaults are the rates and ranges of the named devices, without noise: data sheets give it for one surface and one
light only. With `noise` a range has that standard deviation (m), and with `dropout` this share of the ranges is missing
and reads the largest range, as where nothing is near enough.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.checks import check_finite, check_number, check_positive, check_quaternion, check_whole, shown
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.quantity import Quantity
from jaxdrones.sensing.geometry import Number
from jaxdrones.sensing.rays import ray
from jaxdrones.sensing.scene import Scene
from jaxdrones.sensing.sensor import Sensor
from jaxdrones.state import State

_MULTI_RANGER = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1)])
_DOWN = np.array([(0, 0, -1)])
_IDENTITY = (0.0, 0.0, 0.0, 1.0)
_NEAREST_FLOW = 0.08  # m: the PMW3901 sees nothing sharp below


def range_finder(
    name: str,
    directions: np.ndarray,
    *,
    max_range: float,
    rate: float | None = None,
    noise: float = 0.0,
    dropout: float = 0.0,
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
    orientation: tuple[float, float, float, float] = _IDENTITY,
) -> Sensor:
    """A device that measures along some rays; its reading (...) are the ranges, m, at most `max_range`.

    Args:
        name: by which observation terms ask for the reading.
        directions: (..., 3) directions of the rays, of any length, in the axes of the device, x forward, y left, z up.
        max_range: m; also the reading where nothing is nearer.
        rate: measurements per second; one every control step when left out.
        noise: standard deviation of a range, m.
        dropout: share of the ranges that are missing and read `max_range`.
        offset: (3,) where the rays start, relative to the center of mass, m, body axes.
        orientation: (4,) unit quaternion (x, y, z, w), device to body.

    Raises:
        ValueError: a number out of range or a wrong shape.
    """
    directions = np.asarray(directions, float)
    if directions.shape[-1:] != (3,):
        raise UserError(f"directions of {name} have shape {directions.shape}; give vectors (..., 3)")
    check_finite(f"directions of {name}", directions)
    length = np.linalg.norm(directions, axis=-1, keepdims=True)
    if not length.all():
        raise UserError(f"directions of {name} are {shown(directions)}; give vectors that are not zero")
    directions = directions / length
    check_positive(f"max_range of {name}", max_range, "m")
    check_number(f"noise of {name}", noise, "m", at_least=0)
    check_number(f"dropout of {name}", dropout, at_least=0, at_most=1)
    for what, value, length in ("offset", offset, 3), ("orientation", orientation, 4):
        if np.shape(value) != (length,):
            raise UserError(f"{what} of {name} is {shown(value)}; give {length} numbers")
        check_finite(f"{what} of {name}", value)
    check_quaternion(f"orientation of {name}", orientation)
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


def multi_ranger(max_range: float = 4.0, rate: float | None = 10.0, noise: float = 0.0, dropout: float = 0.0) -> Sensor:
    """Ranges (5,) to the front, back, left, right and up, m: the Multi-ranger deck of the Crazyflie, five VL53L1x.

    Arguments are as for `range_finder`; the deck's driver asks ten times per second.
    """
    return range_finder("multi_ranger", _MULTI_RANGER, max_range=max_range, rate=rate, noise=noise, dropout=dropout)


def downward_range(
    max_range: float = 4.0, rate: float | None = 40.0, noise: float = 0.0, dropout: float = 0.0
) -> Sensor:
    """Range (1,) along the body's -z axis, m: the VL53L1x of the Crazyflie's Z-ranger and Flow decks."""
    return range_finder("downward_range", _DOWN, max_range=max_range, rate=rate, noise=noise, dropout=dropout)


def lidar(
    beams: int = 360,
    max_range: float = 12.0,
    rate: float | None = 10.0,
    noise: float = 0.0,
    dropout: float = 0.0,
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
    orientation: tuple[float, float, float, float] = _IDENTITY,
) -> Sensor:
    """Ranges (beams,) all around in the device's x-y plane, counterclockwise from its x axis, m.

    All rays of a scan are taken at once. Arguments are as for `range_finder`.
    """
    check_whole("beams of a lidar", beams)
    angle = 2 * np.pi / beams * np.arange(beams)
    around = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    return range_finder(
        "lidar",
        around,
        max_range=max_range,
        rate=rate,
        noise=noise,
        dropout=dropout,
        offset=offset,
        orientation=orientation,
    )


def time_of_flight(
    zones: int = 8,
    field_of_view: float = 45.0,
    max_range: float = 4.0,
    rate: float | None = 15.0,
    noise: float = 0.0,
    dropout: float = 0.0,
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
    orientation: tuple[float, float, float, float] = _IDENTITY,
) -> Sensor:
    """Ranges (zones, zones), rows from top to bottom and columns from left to right, m: the VL53L5CX.

    The zones have equal angles, and each is measured by the ray in its middle. Arguments are as for `range_finder`;
    the device looks forward.

    Args:
        zones: number of rows and of columns.
        field_of_view: from side to side, degrees.
        max_range: m.
        rate: measurements per second.
        noise: standard deviation of a range, m.
        dropout: share of the ranges that are missing.
        offset: (3,) of the device, m, body axes.
        orientation: (4,) unit quaternion (x, y, z, w), device to body.
    """
    check_whole("zones of a time-of-flight sensor", zones)
    check_number("field_of_view of a time-of-flight sensor", field_of_view, "degrees", above=0, below=180)
    slope = np.tan(np.radians(field_of_view) * ((zones - 1) / 2 - np.arange(zones)) / zones)
    up, left = np.meshgrid(slope, slope, indexing="ij")
    rays = np.stack([np.ones_like(left), left, up], axis=-1)
    return range_finder(
        "time_of_flight",
        rays,
        max_range=max_range,
        rate=rate,
        noise=noise,
        dropout=dropout,
        offset=offset,
        orientation=orientation,
    )


def optical_flow(rate: float | None = 100.0, noise: float = 0.0, dropout: float = 0.0) -> Sensor:
    """Angular velocity (2,) at which what is below moves backward and to the right, rad/s: the PMW3901.

    With the velocity v and the body rates w, in body axes, and the range d along the body's -z axis it is
    (v_x / d - w_y, v_y / d + w_x); a range below 0.08 m counts as that. Times 35 pixels / 0.717 rad it is what the
    Crazyflie counts per second (its `mm_flow.c`).

    Args:
        rate: measurements per second; one every control step when left out.
        noise: standard deviation, rad/s.
        dropout: share of the measurements that are missing and read zero.

    Raises:
        ValueError: a number out of range.
    """
    check_number("noise of optical_flow", noise, "rad/s", at_least=0)
    check_number("dropout of optical_flow", dropout, at_least=0, at_most=1)

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
