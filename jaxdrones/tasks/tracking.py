"""Task: track a curve."""

from collections.abc import Mapping
from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones.arguments import Seconds, Switch, checked, choice, number
from jaxdrones.control import Setpoint
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.tasks import curves, shaping
from jaxdrones.tasks.curves import SHAPES
from jaxdrones.tasks.starts import thrown
from jaxdrones.tasks.task import Drones, Task

HEIGHT = 2.0  # m
SPACING = 4.0  # m between the centers of neighboring curves
_CAUGHT_UP = 1.0  # s: start of the error's evaluation
_MIN_PERIOD = 0.1  # s; 63 m/s on a circle of 1 m radius


@checked
def tracking(
    drones: Drones = 1,
    curve: Annotated[str, choice("curve", SHAPES)] = "figure-eight",
    period: Annotated[float, number("s", at_least=_MIN_PERIOD)] = 10.0,
    duration: Seconds = 10.0,
    random_start: Switch = True,
) -> Task:
    """Track a periodic curve.

    Args:
        drones: number of drones; the centers of their curves are 4 m apart in y.
        curve: a name of `jaxdrones.tasks.curves.SHAPES`.
        period: period of the curve, s, at least 0.1.
        duration: duration of an episode, s; of 1 s or less there is no criterion of success.
        random_start: drones start at a random point of the curve, 0.1 m and 0.1 m/s off; else at its start, at rest.
    """

    def target(variables: dict[str, Array], t: Array) -> Setpoint:
        """Moving point on the curve."""
        return curves.along(SHAPES[curve], period, variables, t)

    def start(key: jax.Array, params: Params) -> tuple[State, dict[str, Array]]:
        """On the curve: near a random point in motion, or at its start at rest."""
        shape_key, phase_key, start_key = jax.random.split(key, 3)
        dtype = params.mass.dtype
        variables = curves.draw(shape_key, phase_key, drones, SPACING, HEIGHT, dtype)
        variables["phase"] = random_start * variables["phase"]
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
        terminations=shaping.out_of_control(4.0 + SPACING * drones),
        success=_close_throughout if duration > _CAUGHT_UP else None,
        observation=("position_error", "rotation_matrix", "velocity_error", "omega", "last_action", "preview"),
    )


def _close_throughout(metrics: Mapping[str, Array], dt: float) -> Array:
    """Whether the root mean square of the error after the first second was below 5 cm."""
    error = shaping.caught_up(metrics["error"], _CAUGHT_UP, dt)
    return jnp.sqrt(jnp.mean(error**2, axis=0)) < 0.05
