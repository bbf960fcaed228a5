"""Tasks: fly loads on cables along a curve."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.arguments import Seconds, checked, choice, number, whole
from jaxdrones.control import Setpoint
from jaxdrones.dynamics.model import PointMass
from jaxdrones.dynamics.payload import cable, payload, with_payload
from jaxdrones.params import Params
from jaxdrones.quantity import quantities
from jaxdrones.state import State
from jaxdrones.tasks import curves, shaping
from jaxdrones.tasks.curves import SHAPES
from jaxdrones.tasks.starts import check_apart, thrown
from jaxdrones.tasks.task import Drones, ObservationTerm, Task, World, norm

HEIGHT = 2.0  # m, of the center of the curve
SPACING = 4.0  # m between the centers of neighboring curves
_PREVIEW = (0.1, 0.2, 0.4, 0.6)  # s
_CAUGHT_UP = 1.0  # s: start of the evaluation of error and swing
_CLOSE, _UPRIGHT = 0.1, 15.0  # m, degrees: limits of the rms error and of the largest swing
_NEAR, _SLOW = 0.02, 0.1  # m, m/s; the reward terms are parabolas below
_FAR, _FAST = 20.0, 30.0  # m, m/s: bounds of the observations
_TILT = math.radians(35)  # of the cables of a shared load
_SWING = 0.2  # largest slope of a cable at the start, in x and in y

Length = Annotated[float, number("m", "length of the cable", at_least=0.1, at_most=5)]
Share = Annotated[float, number("of the mass of the drones", "load", above=0, at_most=0.6)]
Period = Annotated[float, number("s", at_least=1)]
CurveName = Annotated[str, choice("curve", SHAPES)]


@checked
def sling(
    drones: Drones = 1,
    load: Share = 0.3,
    length: Length = 0.5,
    curve: CurveName = "figure-eight",
    period: Period = 6.0,
    duration: Seconds = 10.0,
) -> Task:
    """Fly a load on a cable along a curve; the target is that of the load.

    Args:
        drones: number of drones, each with a load and a curve of its own; the centers of the curves are 4 m apart in y.
        load: mass of a load over that of the nominal drone; the random mass of an episode does not change it.
        length: length of the cable, m.
        curve: a name of `jaxdrones.tasks.curves.SHAPES`.
        period: period of the curve, s.
        duration: duration of an episode, s; of 1 s or less there is no criterion of success.
    """
    carrying = _Carrying(drones, load, length, curve, period, shared=False)
    return carrying.task("sling", "fly a load on a cable along a curve", duration)


@checked
def transport(
    drones: Annotated[int, whole("number of drones of {function}", 2, 8)] = 3,
    load: Share = 0.3,
    length: Length = 0.5,
    curve: CurveName = "figure-eight",
    period: Period = 6.0,
    duration: Seconds = 10.0,
) -> Task:
    """A team flies one load on cables along a curve; the target is that of the load.

    The drones keep places on a ring above the load, on cables 35 degrees from the vertical.

    Args:
        drones: number of drones, 2 to 8.
        load: mass of the load over that of all nominal drones; random masses of an episode do not change it.
        length: length of the cables, m.
        curve: a name of `jaxdrones.tasks.curves.SHAPES`.
        period: period of the curve, s.
        duration: duration of an episode, s; of 1 s or less there is no criterion of success.
    """
    carrying = _Carrying(drones, load, length, curve, period, shared=True)
    return carrying.task("transport", "carry a load together along a curve", duration)


@dataclasses.dataclass(frozen=True)
class _Carrying:
    """Drones that carry a load each along a curve, or together one `shared` load."""

    drones: int
    load: float
    """Mass of the load over that of its nominal drones."""
    length: float
    """m, of the cables."""
    curve: str
    period: float
    """s."""
    shared: bool

    def task(self, name: str, summary: str, duration: float) -> Task:
        """Task of this duration, s."""
        place = ObservationTerm(self.way_to_place, _FAR, entries=_PLACE_ENTRIES)
        return Task(
            name=name,
            summary=summary,
            drones=self.drones,
            duration=duration,
            start=self.start,
            target=self.target,
            rewards={
                "alive": (2.0, shaping.alive),
                "position": (-1.0, _position),
                "velocity": (-0.1, _velocity),
                "place": (-0.5, self.out_of_place),
                "omega": (-0.02, shaping.body_rates),
                "action_change": (-0.02, shaping.action_change),
            },
            terminations=shaping.out_of_control(4.0 + SPACING * self.drones),
            metrics={"error": _error, "swing": self.swing},
            success=_close_and_upright if duration > _CAUGHT_UP else None,
            observations=_OBSERVATIONS | {"place": place},
            control_hz=50.0,
            action="thrust_and_rates",
            observation=(
                *("load_error", "load_velocity_error", "load", *["place"] * self.shared),
                *("rotation_matrix", "velocity", "omega", "last_action", "load_preview"),
            ),
            effects=(cable,),
            models=(payload(self.shared),),
            equip=self.equip,
        )

    def equip(self, params: Params) -> Params:
        """Team with the loads on cables."""
        mass = self.load * (jnp.sum(params.mass) if self.shared else params.mass[0])
        return with_payload(params, mass, self.length, cables=self.drones if self.shared else 1)

    def target(self, variables: dict[str, Array], t: Array) -> Setpoint:
        """Moving point on the curve, of the load."""
        return curves.along(SHAPES[self.curve], self.period, variables, t)

    def start(self, key: jax.Array, params: Params) -> tuple[State, dict[str, Array]]:
        """Near a random point of the curve, in motion; a load of a single drone swings."""
        shape_key, phase_key, start_key, load_key = jax.random.split(key, 4)
        n, dtype = self.drones, params.mass.dtype
        loads = 1 if self.shared else n
        variables = curves.draw(shape_key, phase_key, loads, SPACING, HEIGHT, dtype)
        variables = jax.tree.map(lambda x: jnp.broadcast_to(x, (n, *x.shape[1:])), variables)
        here, places = self.target(variables, jnp.zeros((), dtype)), self.places(dtype)
        offset = jax.random.uniform(load_key, (loads, 3), dtype, -1, 1)
        if self.shared:
            apart = 2 * self.length * math.sin(_TILT) * math.sin(math.pi / n)
            check_apart(params, apart, "longer cables (length), or a smaller vehicle")
            beside = here.pos + 0.1 * offset
            state = thrown(start_key, params, beside + places, reach=0.0, speed=0.1, omega=0.1, tilt=0.1)
            carried = PointMass(beside, here.vel)
        else:
            state = thrown(start_key, params, here.pos + places, reach=0.1, speed=0.1, omega=0.1, tilt=0.1)
            down = offset * jnp.array([[_SWING, _SWING, 0]], dtype) - jnp.array([[0, 0, 1]], dtype)
            carried = PointMass(state.pos + self.length * down / norm(down)[:, None], here.vel)
        return state.replace(vel=state.vel + here.vel, aux={"payload": carried}), variables

    def places(self, dtype: jnp.dtype) -> Float[Array, "n 3"]:
        """Places of the drones relative to the load, m, world axes: above it, or on a ring above a shared one."""
        tilt = _TILT if self.shared else 0.0
        angle = 2 * jnp.pi * jnp.arange(self.drones, dtype=dtype) / self.drones
        beside, above = self.length * math.sin(tilt), self.length * math.cos(tilt)
        return jnp.stack([beside * jnp.cos(angle), beside * jnp.sin(angle), jnp.full_like(angle, above)], axis=-1)

    def out_of_place(self, task: Task, world: World) -> Float[Array, " n"]:
        """Distance of the drone from its place above the load, m."""
        return shaping.length(self.way_to_place(task, world), _NEAR)

    def way_to_place(self, task: Task, world: World) -> Float[Array, "n 3"]:
        """Vector to the place of the drone above the load, m, world axes."""
        return world.drones.aux["payload"].pos + self.places(world.drones.pos.dtype) - world.drones.pos

    def swing(self, task: Task, world: World) -> Float[Array, " n"]:
        """Angle between the vertical and the line from the load to its drone, or to the middle of the team, degrees."""
        pos = world.drones.pos
        middle = jnp.broadcast_to(jnp.mean(pos, axis=0), pos.shape) if self.shared else pos
        x, y, z = (middle - world.drones.aux["payload"].pos).T
        return jnp.degrees(jnp.arctan2(jnp.sqrt(x**2 + y**2 + 1e-12), z))


def _load_error(task: Task, world: World) -> Float[Array, "n 3"]:
    """Vector from the load to its target, m, world axes."""
    return task.target_now(world).pos - world.drones.aux["payload"].pos


def _load_velocity_error(task: Task, world: World) -> Float[Array, "n 3"]:
    """Velocity of the target relative to the load, m/s, world axes."""
    return task.target_now(world).vel - world.drones.aux["payload"].vel


def _load(task: Task, world: World) -> Float[Array, "n 6"]:
    """Position and velocity of the load relative to the drone, m and m/s, world axes."""
    load = world.drones.aux["payload"]
    return jnp.concatenate([load.pos - world.drones.pos, load.vel - world.drones.vel], axis=-1)


def _load_preview(task: Task, world: World) -> Float[Array, "n d"]:
    """Future positions of the target, relative to the load, m, world axes."""
    load = world.drones.aux["payload"].pos
    return jnp.concatenate([task.target(world.variables, world.time + t).pos - load for t in _PREVIEW], axis=-1)


def _error(task: Task, world: World) -> Float[Array, " n"]:
    """Distance of the load from its target, m."""
    return norm(_load_error(task, world))


def _position(task: Task, world: World) -> Float[Array, " n"]:
    """Distance of the load from its target, m; a parabola below 2 cm."""
    return shaping.length(_load_error(task, world), _NEAR)


def _velocity(task: Task, world: World) -> Float[Array, " n"]:
    """Speed of the load relative to its target, m/s."""
    return shaping.length(_load_velocity_error(task, world), _SLOW)


def _close_and_upright(metrics: Mapping[str, Array], dt: float) -> Array:
    """Whether after the first second the rms error was below 10 cm and the largest swing below 15 degrees."""
    error, swing = (shaping.caught_up(metrics[name], _CAUGHT_UP, dt) for name in ("error", "swing"))
    return (jnp.sqrt(jnp.mean(error**2, axis=0)) < _CLOSE) & (jnp.max(swing, axis=0) < _UPRIGHT)


_LOAD_ENTRIES = (
    *quantities("load, from the drone", "m", "world"),
    *quantities("velocity of the load, relative", "m/s", "world"),
)
_PREVIEW_ENTRIES = tuple(
    entry for t in _PREVIEW for entry in quantities(f"target in {t:g} s, from the load", "m", "world")
)
_PLACE_ENTRIES = quantities("place above the load, from the drone", "m", "world")
_OBSERVATIONS = {
    "load_error": ObservationTerm(_load_error, _FAR, entries=quantities("target, from the load", "m", "world")),
    "load_velocity_error": ObservationTerm(
        _load_velocity_error,
        _FAST,
        entries=quantities("velocity of the target, relative to the load", "m/s", "world"),
    ),
    "load": ObservationTerm(_load, (_FAR,) * 3 + (_FAST,) * 3, entries=_LOAD_ENTRIES),
    "load_preview": ObservationTerm(_load_preview, _FAR, entries=_PREVIEW_ENTRIES),
}
