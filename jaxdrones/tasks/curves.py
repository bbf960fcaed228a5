"""Curves to follow: where drone i of a team should be at time t."""

from __future__ import annotations

from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxdrones.checks import check_positive, check_whole
from jaxdrones.control.setpoint import Setpoint

Point = Callable[[Int[Array, ""], Float[Array, ""]], Float[Array, "3"]]


class Curve(flax.struct.PyTreeNode):
    """A place for every drone at every time."""

    point: Point = flax.struct.field(pytree_node=False)
    """(drone, time in s) -> (3,) m, world."""

    def positions(self, n: int, t: float | Array = 0.0) -> Float[Array, "n 3"]:
        """Where the n drones of a team should be at time t (s)."""
        check_whole("number of drones", n)
        return jax.vmap(self.point, (0, None))(jnp.arange(n), jnp.asarray(t, float))

    def setpoints(self, n: int, t: float | Array = 0.0) -> Setpoint:
        """Position, velocity and acceleration of the n drones at time t (s), by differentiating the curve."""
        check_whole("number of drones", n)
        t = jnp.asarray(t, float)

        def one(i):
            def velocity(t):
                return jax.jvp(lambda t: self.point(i, t), (t,), (jnp.ones_like(t),))[1]

            acc = jax.jvp(velocity, (t,), (jnp.ones_like(t),))[1]
            return Setpoint.at(self.point(i, t), vel=velocity(t), acc=acc)

        return jax.vmap(one)(jnp.arange(n))


def circle(radius: float = 0.3, period: float = 10.0, height: float = 0.1, spacing: float = 0.05) -> Curve:
    """The paper's circle about (0, -radius): drones 60 degrees apart, each `spacing` above the one before, m and s."""
    check_positive("period", period, "s")

    def point(i, t):
        angle = 2 * jnp.pi * (t / period + i / 6) + jnp.pi / 2
        return jnp.stack([radius * jnp.cos(angle), radius * (jnp.sin(angle) - 1), height + i * spacing])

    return Curve(point)


def crossing(n: int, reach: float = 0.5, period: float = 5.0, spacing: float = 0.5) -> Curve:
    """The paper's downwash flight: drones swing in x, neighbours in height against each other, the last one lowest."""
    check_positive("period", period, "s")

    def point(i, t):
        x = reach * jnp.cos(2 * jnp.pi * t / period + i * jnp.pi)
        return jnp.stack([x, jnp.zeros_like(x), (n - i) * spacing])

    return Curve(point)


def hop(height: float = 0.014, amplitude: float = 0.15, period: float = 4.0, spacing: float = 1.0) -> Curve:
    """The paper's take-off: a step to `height + amplitude`, from where z swings; drones `spacing` (m) apart in x."""
    check_positive("period", period, "s")

    def point(i, t):
        z = height + amplitude * (jnp.sin(2 * jnp.pi * t / period) + 1)
        return jnp.stack([i * spacing, jnp.zeros_like(z), z])

    return Curve(point)
