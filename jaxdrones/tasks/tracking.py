"""Task: track a curve."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones.checks import check_choice, check_number, check_positive, check_switch, check_whole
from jaxdrones.control import Setpoint
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.tasks import shaping
from jaxdrones.tasks.curves import RANDOM_NUMBERS, SHAPES, setpoint_on
from jaxdrones.tasks.starts import thrown
from jaxdrones.tasks.task import Task, out_of_control

HEIGHT = 2.0  # m
SPACING = 4.0  # m between the centers of neighboring curves
_CAUGHT_UP = 1.0  # s: start of the error's evaluation
_MIN_PERIOD = 0.1  # s; 63 m/s on a circle of 1 m radius


def tracking(
    drones: int = 1,
    curve: str = "figure-eight",
    period: float = 10.0,
    duration: float = 10.0,
    random_start: bool = True,
) -> Task:
    """Track a periodic curve.

    Args:
        drones: number of drones; the centers of their curves are 4 m apart in y.
        curve: a name of `jaxdrones.tasks.curves.SHAPES`.
        period: period of the curve, s, at least 0.1.
        duration: duration of an episode, s; of 1 s or less there is no criterion of success.
        random_start: drones start at a random point of the curve, 0.1 m and 0.1 m/s off; else at its start, at rest.
    """
    check_whole("number of drones of tracking", drones)
    check_choice("curve", curve, SHAPES)
    check_positive("duration", duration, "s")
    check_number("period", period, "s", at_least=_MIN_PERIOD)
    check_switch("random_start", random_start)
    shape = SHAPES[curve]

    def target(variables: dict[str, Array], t: Array) -> Setpoint:
        """Moving point on the curve."""

        def one(center, u, phase):
            return setpoint_on(lambda t: center + shape(u, phase + t / period), t)

        return jax.vmap(one)(variables["center"], variables["random"], variables["phase"])

    def start(key: jax.Array, params: Params) -> tuple[State, dict[str, Array]]:
        """On the curve: near a random point in motion, or at its start at rest."""
        shape_key, phase_key, start_key = jax.random.split(key, 3)
        n, dtype = len(params.mass), params.mass.dtype
        y = SPACING * (jnp.arange(n, dtype=dtype) - (n - 1) / 2)
        variables = {
            "center": jnp.stack([jnp.zeros_like(y), y, jnp.full_like(y, HEIGHT)], axis=-1),
            "random": jax.random.uniform(shape_key, (n, RANDOM_NUMBERS), dtype, -1, 1),
            "phase": random_start * jax.random.uniform(phase_key, (n,), dtype),
        }
        here = target(variables, jnp.zeros((), dtype))
        if not random_start:
            return thrown(start_key, params, here.pos, reach=0, speed=0, omega=0, tilt=0), variables
        state = thrown(start_key, params, here.pos, reach=0.1, speed=0.1, omega=0.1, tilt=0.1)
        return state.replace(vel=state.vel + here.vel), variables

    return Task(
        name="tracking",
        summary="follow a curve: " + ", ".join(SHAPES),
        drones=drones,
        duration=duration,
        start=start,
        target=target,
        rewards=shaping.REACH_AND_STAY,
        terminations=out_of_control(4.0 + SPACING * drones),
        success=_close_throughout if duration > _CAUGHT_UP else None,
        observation=("position_error", "rotation_matrix", "velocity_error", "omega", "last_action", "preview"),
    )


def _close_throughout(metrics: Mapping[str, Array], dt: float) -> Array:
    """Whether the root mean square of the error after the first second was below 5 cm."""
    error = metrics["error"][round(_CAUGHT_UP / dt) :]
    return jnp.sqrt(jnp.mean(error**2, axis=0)) < 0.05
