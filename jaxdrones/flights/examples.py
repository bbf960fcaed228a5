"""Four control examples of gym-pybullet-drones (2021), figures 6 to 9 of its paper."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.control import Setpoint
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.tasks import curves

_DIRECTIONS = np.array([[-0.5, 1.0, 0.0], [0.0, 1.0, 0.0], [0.2, 1.0, 0.2], [0.0, 1.0, 0.5]])
_HEADINGS = np.array([0, np.pi / 3, np.pi / 4, np.pi / 2])  # rad


@dataclasses.dataclass(frozen=True)
class Flight:
    """Example flight and its defaults."""

    summary: str
    start: Callable[[int], State]
    """Number of drones -> initial state."""
    target: Callable[[int, jax.Array, float], Setpoint | jax.Array]
    """(number of drones, time, duration), s -> setpoints, or actions of the velocity input."""
    drones: int
    duration: float  # s
    control_hz: int
    effects: tuple[str, ...] = ()
    settling_time: float = 2.0  # s; start of the evaluation
    panels: tuple[str, ...] = ()  # panels of the figure; empty for all
    labels: tuple[str, ...] = ()  # names of the drones, for a team of fixed size
    change_params: Callable[[Params], Params] = lambda team: team


_CIRCLE, _HOP = curves.circle(), curves.hop()


def _headings(n: int) -> jax.Array:
    return jnp.arange(n) * (jnp.pi / 2) / n


def _start_of_velocity(n: int) -> State:
    i = jnp.arange(n)
    pos = jnp.stack([0.3 * i, jnp.zeros(n), jnp.full(n, 0.1)], axis=-1)
    return State.at_rest(pos, jnp.asarray(_HEADINGS)[i % 4])


def _velocity_action(n: int, t: jax.Array, duration: float) -> jax.Array:
    i = jnp.arange(n) % 4
    reverse = t >= duration * (1 / 8 + i / 6)
    direction = jnp.asarray(_DIRECTIONS)[i] * jnp.where(reverse, -1, 1)[:, None]
    return jnp.concatenate([direction, jnp.full((n, 1), 0.99)], axis=-1)


FLIGHTS = {
    "circle": Flight(
        summary="a circle at staggered heights, with a different heading for each drone (PID)",
        start=lambda n: State.at_rest(_CIRCLE.positions(n), _headings(n)),
        target=lambda n, t, duration: Setpoint.at(_CIRCLE.positions(n, t), yaw=_headings(n)),
        drones=4,
        duration=12.0,
        control_hz=120,
    ),
    "velocity": Flight(
        summary="steps of the velocity input, reversed one drone after the other",
        start=_start_of_velocity,
        target=_velocity_action,
        drones=4,
        duration=12.0,
        control_hz=120,
        settling_time=10.0,
    ),
    "ground-effect": Flight(
        summary="a take-off with and without ground effect (equation 5)",
        start=lambda n: State.at_rest(_HOP.positions(n, -1.0).at[:, 2].set(0.014)),
        target=lambda n, t, duration: Setpoint.at(_HOP.positions(n, t)),
        drones=2,
        duration=0.5,
        control_hz=240,
        effects=("ground_effect_2021",),
        settling_time=0.0,
        panels=("z", "vz", "rpm0"),
        labels=("with ground effect", "without"),
        change_params=lambda team: team.replace(ground_effect_coeff=team.ground_effect_coeff.at[1].set(0)),
    ),
    "downwash": Flight(
        summary="drones crossing above each other, with downwash (equation 6)",
        start=lambda n: State.at_rest(curves.crossing(n).positions(n)),
        target=lambda n, t, duration: Setpoint.at(curves.crossing(n).positions(n, t)),
        drones=2,
        duration=12.0,
        control_hz=120,
        effects=("downwash_2021",),
        settling_time=3.0,
        panels=("x", "vx", "z", "vz", "pitch", "omega_y", "rpm0", "rpm1"),
    ),
}
"""The examples by name."""
