"""Task: cross below other drones and keep the altitude."""

from collections.abc import Mapping
from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.arguments import Seconds, checked, number
from jaxdrones.control import Setpoint
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.tasks import shaping
from jaxdrones.tasks.curves import setpoint_on
from jaxdrones.tasks.starts import thrown
from jaxdrones.tasks.task import Task, Team, World

HEIGHT = 1.0  # m, of the lowest drone
_CAUGHT_UP = 1.0  # s: start of the altitude's evaluation
_TOLERANCE = 0.05  # m
_MAX_LENGTH = 1000.0  # m
_LENGTH = number("m", above=0, at_most=_MAX_LENGTH)


@checked
def wake(
    drones: Team = 2,
    spacing: Annotated[float, _LENGTH] = 0.5,
    amplitude: Annotated[float, _LENGTH] = 0.5,
    period: Annotated[float, number("s", at_least=1)] = 5.0,
    duration: Annotated[Seconds, number("s", above=_CAUGHT_UP)] = 10.0,
) -> Task:
    """Drones at different altitudes swing along crossing lines and pass below each other, in each other's downwash.

    All pass the common vertical axis at the same time, twice a period.

    Args:
        drones: number of drones, at least two.
        spacing: difference of altitude of consecutive drones, m; at most 1,000.
        amplitude: of the swing, m; at most 1,000.
        period: of the swing, s.
        duration: duration of an episode, s.
    """

    def target(variables: dict[str, Array], t: Array) -> Setpoint:
        """Moving point on a line through the common axis, at the altitude of the drone."""

        def one(altitude: Array, angle: Array) -> Setpoint:
            def place(t: Array) -> Float[Array, "3"]:
                away = amplitude * jnp.sin(2 * jnp.pi * (variables["phase"] + t / period))
                return jnp.stack([away * jnp.cos(angle), away * jnp.sin(angle), altitude])

            return setpoint_on(place, t)

        return jax.vmap(one)(variables["altitude"], variables["angle"])

    def start(key: jax.Array, params: Params) -> tuple[State, dict[str, Array]]:
        """Near a random point of the swing, in motion."""
        phase_key, start_key = jax.random.split(key)
        order, dtype = jnp.arange(drones, dtype=params.mass.dtype), params.mass.dtype
        variables = {
            "altitude": HEIGHT + spacing * order,
            "angle": jnp.pi * order / drones,
            "phase": jax.random.uniform(phase_key, (), dtype),
            "squares": jnp.zeros(drones, dtype),
        }
        here = target(variables, jnp.zeros((), dtype))
        state = thrown(start_key, params, here.pos, reach=0.05, speed=0.05, omega=0.1, tilt=0.1)
        return state.replace(vel=state.vel + here.vel), variables

    return Task(
        name="wake",
        summary="cross below other drones and keep the altitude",
        drones=drones,
        duration=duration,
        start=start,
        target=target,
        rewards=shaping.REACH_AND_STAY,
        terminations=shaping.out_of_control(2.0 + amplitude),
        advance=_advance,
        metrics={"altitude_error": _altitude_error, "altitude_deviation": _altitude_deviation},
        success=_kept_altitude,
        control_hz=50.0,
        pairs=("downwash",),
        action="thrust_and_rates",
        observation=("position_error", "rotation_matrix", "velocity_error", "omega", "encounters"),
    )


def _altitude_error(task: Task, world: World) -> Float[Array, " n"]:
    """Distance from the altitude of the target, m."""
    return jnp.abs(world.drones.pos[:, 2] - world.variables["altitude"])


def _advance(task: Task, world: World) -> dict[str, Array]:
    square = jnp.where(_steps_that_count(world) > 0, _altitude_error(task, world) ** 2, 0)
    return world.variables | {"squares": world.variables["squares"] + square}


def _altitude_deviation(task: Task, world: World) -> Float[Array, " n"]:
    """Root mean square of the altitude's error after the first second, m."""
    return jnp.sqrt(world.variables["squares"] / jnp.maximum(_steps_that_count(world), 1))


def _steps_that_count(world: World) -> Array:
    """Number of control steps after the first second, negative before; as in `shaping.caught_up`."""
    return world.step - round(_CAUGHT_UP / world.dt)


def _kept_altitude(metrics: Mapping[str, Array], dt: float) -> Array:
    """Whether a drone was within 5 cm of its altitude after the first second."""
    return jnp.all(shaping.caught_up(metrics["altitude_error"], _CAUGHT_UP, dt) < _TOLERANCE, axis=0)
