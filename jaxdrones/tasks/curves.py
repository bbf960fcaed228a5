"""Reference curves: periodic shapes, and positions of a team over time."""

from collections.abc import Callable
from typing import Annotated

import flax.struct
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from jaxdrones.arguments import Range, Seconds, checked, whole
from jaxdrones.checks import check_finite
from jaxdrones.control.setpoint import Setpoint
from jaxdrones.pytree import PyTreeNode

WAYPOINTS = 8
RANDOM_NUMBERS = 3 * WAYPOINTS + 3
"""Number of random numbers of a shape."""
Shape = Callable[[Float[Array, " k"], Float[Array, ""]], Float[Array, "3"]]
"""(random numbers (27,) in [-1, 1], time in periods) -> position relative to the center, m; periodic."""
Point = Callable[[Int[Array, ""], Float[Array, ""]], Float[Array, "3"]]
"""(drone, time in s) -> position, m, world."""
Finite = Annotated[float, Range(check_finite, "{function}['{argument}']")]
Drones = Annotated[int, whole("number of drones")]


def setpoint_on(point: Callable[[Float[Array, ""]], Float[Array, "3"]], t: Float[Array, ""]) -> Setpoint:
    """Position, velocity and acceleration at time t (s) of a moving point, by differentiation of its position."""

    def velocity(t):
        return jax.jvp(point, (t,), (jnp.ones_like(t),))[1]

    acc = jax.jvp(velocity, (t,), (jnp.ones_like(t),))[1]
    return Setpoint.at(point(t), vel=velocity(t), acc=acc)


def draw(
    shape_key: jax.Array, phase_key: jax.Array, count: int, spacing: float, height: float, dtype: DTypeLike
) -> dict[str, Array]:
    """Centers of curves (m, in a row along y), their random numbers, and the phases of their points at time zero."""
    y = spacing * (jnp.arange(count, dtype=dtype) - (count - 1) / 2)
    return {
        "center": jnp.stack([jnp.zeros_like(y), y, jnp.full_like(y, height)], axis=-1),
        "random": jax.random.uniform(shape_key, (count, RANDOM_NUMBERS), dtype, -1, 1),
        "phase": jax.random.uniform(phase_key, (count,), dtype),
    }


def along(shape: Shape, period: float, curves: dict[str, Array], t: Float[Array, ""]) -> Setpoint:
    """Moving points on curves from `draw`, with this period, s."""

    def one(center: Array, u: Array, phase: Array) -> Setpoint:
        return setpoint_on(lambda t: center + shape(u, phase + t / period), t)

    return jax.vmap(one)(curves["center"], curves["random"], curves["phase"])


def unit_circle(u: Array, s: Array) -> Array:
    """Level circle of 1 m radius, counterclockwise from x = 1 m."""
    return jnp.stack([jnp.cos(_angle(s)), jnp.sin(_angle(s)), jnp.zeros_like(s)])


def figure_eight(u: Array, s: Array) -> Array:
    """Upright figure eight of crazyflow's benchmark: x is the sine, z half the sine of the double angle, m."""
    return jnp.stack([jnp.sin(_angle(s)), jnp.zeros_like(s), jnp.sin(2 * _angle(s)) / 2])


def lissajous(u: Array, s: Array) -> Array:
    """Sines of one, two and three periods in x, y and z: amplitudes U(0.5, 1) m, half of that in z, and any phases."""
    amplitude, phase = 0.75 + 0.25 * u[:3], u[3:6] / 2
    return amplitude * jnp.sin(_angle(jnp.array([1, 2, 3], s.dtype) * s + phase)) * jnp.array([1, 1, 0.5], s.dtype)


def polynomial(u: Array, s: Array) -> Array:
    """Eight random waypoints within 1 m, from rest to rest along polynomials of fifth degree."""
    waypoints = jnp.reshape(u[: 3 * WAYPOINTS], (WAYPOINTS, 3)) * jnp.array([[1, 1, 0.5]], s.dtype)
    k = jnp.floor(s * WAYPOINTS).astype(jnp.int32)
    x = s * WAYPOINTS - k
    here, there = waypoints[k % WAYPOINTS], waypoints[(k + 1) % WAYPOINTS]
    return here + (there - here) * x**3 * (10 - 15 * x + 6 * x**2)


SHAPES: dict[str, Shape] = {
    "circle": unit_circle,
    "figure-eight": figure_eight,
    "lissajous": lissajous,
    "polynomial": polynomial,
}


class Curve(PyTreeNode):
    """Position of every drone at every time."""

    point: Point = flax.struct.field(pytree_node=False)

    @checked
    def positions(self, n: Drones, t: float | Array = 0.0) -> Float[Array, "n 3"]:
        """Positions of the n drones of a team at time t (s)."""
        return jax.vmap(self.point, (0, None))(jnp.arange(n), jnp.asarray(t, float))

    @checked
    def setpoints(self, n: Drones, t: float | Array = 0.0) -> Setpoint:
        """Position, velocity and acceleration of the n drones at time t (s)."""
        t = jnp.asarray(t, float)
        return jax.vmap(lambda i: setpoint_on(lambda t: self.point(i, t), t))(jnp.arange(n))


@checked
def circle(radius: Finite = 0.3, period: Seconds = 10.0, height: Finite = 0.1, spacing: Finite = 0.05) -> Curve:
    """Circle about (0, -radius): drones 60 degrees apart, each `spacing` above the one before, m and s."""

    def point(i, t):
        center = jnp.stack([0 * t, 0 * t - radius, height + i * spacing])
        return center + radius * unit_circle(jnp.zeros(0), t / period + i / 6 + 1 / 4)

    return Curve(point)


@checked
def crossing(n: int, amplitude: Finite = 0.5, period: Seconds = 5.0, spacing: Finite = 0.5) -> Curve:
    """Drones above each other oscillate along x, those of neighboring heights in opposition; the last one is lowest."""

    def point(i, t):
        x = amplitude * jnp.cos(_angle(t / period + i / 2))
        return jnp.stack([x, jnp.zeros_like(x), (n - i) * spacing])

    return Curve(point)


@checked
def hop(height: Finite = 0.014, amplitude: Finite = 0.15, period: Seconds = 4.0, spacing: Finite = 1.0) -> Curve:
    """Step to `height + amplitude`, with an oscillation of z about it; drones `spacing` (m) apart in x."""

    def point(i, t):
        z = height + amplitude * (jnp.sin(_angle(t / period)) + 1)
        return jnp.stack([i * spacing, jnp.zeros_like(z), z])

    return Curve(point)


def _angle(s: Array) -> Array:
    """Angle after some periods, rad."""
    return 2 * jnp.pi * s
