"""Follow a curve."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.checks import check_choice, check_keywords, check_number, check_switch, check_whole
from jaxdrones.control import Setpoint
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.tasks import shaping
from jaxdrones.tasks.starts import thrown
from jaxdrones.tasks.task import Task, out_of_control

HEIGHT = 2.0  # m
SPACING = 4.0  # m between the centres of neighbours' curves
WAYPOINTS = 8
_SHORTEST = 0.1  # s; a period in which a circle of 1 m radius is flown at 63 m/s
Shape = Callable[[Array, Float[Array, ""]], Float[Array, "3"]]
"""(random numbers (27,) in [-1, 1], turns) -> place about the centre, m; periodic in whole turns."""


def circle(u: Array, s: Array) -> Array:
    """A level circle of 1 m radius."""
    return jnp.stack([jnp.cos(_angle(s)), jnp.sin(_angle(s)), jnp.zeros_like(s)])


def figure_eight(u: Array, s: Array) -> Array:
    """The upright eight that crazyflow is measured on: x = sin, z = sin of the double / 2."""
    return jnp.stack([jnp.sin(_angle(s)), jnp.zeros_like(s), jnp.sin(2 * _angle(s)) / 2])


def lissajous(u: Array, s: Array) -> Array:
    """Amplitudes U(0.5, 1) m and any phases; once, twice and three times around in x, y and z."""
    amplitude, phase = 0.75 + 0.25 * u[:3], u[3:6] / 2
    return amplitude * jnp.sin(_angle(jnp.array([1, 2, 3], s.dtype) * s + phase)) * jnp.array([1, 1, 0.5], s.dtype)


def polynomial(u: Array, s: Array) -> Array:
    """Through eight random places within 1 m, from rest to rest along polynomials of fifth degree."""
    places = jnp.reshape(u[:24], (WAYPOINTS, 3)) * jnp.array([[1, 1, 0.5]], s.dtype)
    k = jnp.floor(s * WAYPOINTS).astype(jnp.int32)
    x = s * WAYPOINTS - k
    here, there = places[k % WAYPOINTS], places[(k + 1) % WAYPOINTS]
    return here + (there - here) * x**3 * (10 - 15 * x + 6 * x**2)


CURVES: dict[str, Shape] = {
    "circle": circle,
    "figure-eight": figure_eight,
    "lissajous": lissajous,
    "polynomial": polynomial,
}


@check_keywords
def tracking(
    drones: int = 1, curve: str = "figure-eight", period: float = 10.0, duration: float = 10.0, anywhere: bool = True
) -> Task:
    """Follow a curve that repeats.

    Args:
        drones: number of drones; the centres of their curves are 4 m apart in y.
        curve: a name of `CURVES`.
        period: s, at least 0.1.
        duration: of an episode, s.
        anywhere: start at any point of the curve, 0.1 m and 0.1 m/s off; else at its start, at rest.
    """
    check_whole("number of drones of tracking", drones)
    check_choice("curve", curve, CURVES)
    check_number("period", period, "s", at_least=_SHORTEST)
    check_switch("anywhere", anywhere)
    shape = CURVES[curve]

    def target(variables: dict[str, Array], t: Array) -> Setpoint:
        def one(center, u, phase):
            def point(t):
                return center + shape(u, phase + t / period)

            def velocity(t):
                return jax.jvp(point, (t,), (jnp.ones_like(t),))[1]

            acc = jax.jvp(velocity, (t,), (jnp.ones_like(t),))[1]
            return Setpoint.at(point(t), vel=velocity(t), acc=acc)

        return jax.vmap(one)(variables["center"], variables["random"], variables["phase"])

    def start(key: jax.Array, params: Params) -> tuple[State, dict[str, Array]]:
        shape_key, phase_key, start_key = jax.random.split(key, 3)
        n, dtype = len(params.mass), params.mass.dtype
        y = SPACING * (jnp.arange(n, dtype=dtype) - (n - 1) / 2)
        variables = {
            "center": jnp.stack([jnp.zeros_like(y), y, jnp.full_like(y, HEIGHT)], axis=-1),
            "random": jax.random.uniform(shape_key, (n, 27), dtype, -1, 1),
            "phase": anywhere * jax.random.uniform(phase_key, (n,), dtype),
        }
        here = target(variables, jnp.zeros((), dtype))
        if not anywhere:
            return thrown(start_key, params, here.pos, reach=0, speed=0, omega=0, tilt=0), variables
        state = thrown(start_key, params, here.pos, reach=0.1, speed=0.1, omega=0.1, tilt=0.1)
        return state.replace(vel=state.vel + here.vel), variables

    return Task(
        name="tracking",
        summary="follow a curve: " + ", ".join(CURVES),
        drones=drones,
        duration=duration,
        start=start,
        target=target,
        rewards=shaping.reach_and_stay(target),
        ends=out_of_control((0, 0, HEIGHT), 4.0 + SPACING * drones),
        success=_close_throughout,
        observation=("position_error", "rotation_matrix", "velocity_error", "omega", "last_action", "preview"),
    )


def _close_throughout(metrics: Mapping[str, Array], dt: float) -> Array:
    """Root mean square of the error within 5 cm, after one second to settle."""
    error = metrics["error"][round(1 / dt) :]
    return jnp.sqrt(jnp.mean(error**2, axis=0)) < 0.05


def _angle(s: Array) -> Array:
    return 2 * jnp.pi * s
