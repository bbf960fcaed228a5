"""Race tracks of four gates: scenes by level, and passages of gates; shared by `gates` and `race`."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jaxdrones.checks import short_repr
from jaxdrones.control import Setpoint
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.quantity import quantities
from jaxdrones.sensing import BEAMS, Cylinder, Scene, gate, track
from jaxdrones.tasks import shaping
from jaxdrones.tasks.starts import standing_height
from jaxdrones.tasks.task import ObservationTerm, Task, World
from jaxdrones.vector import atan2

# x, y, z (m) and crossing heading (rad) of each gate, in this order
GATES = np.array([(0.5, 0.25, 0.7, -0.78), (1.05, 0.75, 1.2, 2.35), (-1.0, -0.25, 0.7, 3.14), (0.0, -0.75, 1.2, 0.0)])
POLES = np.array([(0.0, 0.75), (1.0, 0.25), (-1.5, -0.25), (-0.5, -0.75)])  # x, y, m
START = np.array([-1.5, 0.75])
OPENING, FRAME = 0.40, 0.16  # m, edge of the square hole and width of the beams around it
POLE_RADIUS, POLE_HEIGHT = 0.015, 1.52  # m
LEVELS = (0, 1, 2, 3)
ARENA = 3.0  # m from the middle of the track along every axis: bounds of the arena
MIDDLE = (0.0, 0.0, 1.0)  # m

_GATE_RANGE = np.array([0.15, 0.15, 0.1, 0.2])  # m, m, m, rad: level 2 moves gates by U(-range, range)
_POLE_RANGE = 0.15  # m
_NOWHERE = 100.0  # m: outside the arena
_INERTIA_RANGE = 0.2  # share: level 1 on

_GATE_ENTRIES = tuple(
    entry
    for gate in ("next gate", "gate after it")
    for entry in (
        *quantities(f"center of the {gate}, from the drone", "m", "world"),
        *quantities(f"direction through the {gate}", "-", "world"),
    )
)


def scene_of(level: int) -> Scene | Callable[[jax.Array], Scene]:
    """Scene of a level, or a function `(key) -> Scene` for levels with random tracks.

    Levels 0 and 1 are nominal, 2 has gates and poles displaced, 3 random tracks without poles.
    """
    if level not in LEVELS:
        raise UserError(f"level is {short_repr(level)}; give one of {', '.join(map(str, LEVELS))}")
    return functools.partial(_random_scene, level) if level > 1 else _nominal_scene(jnp.result_type(float))


def randomization_of(level: int) -> tuple[Callable[[jax.Array, Params], Params], ...]:
    """Randomizations of a level: random inertia from level 1 on."""
    return () if level == 0 else (_random_inertia,)


def gates_of(scene: Scene, dtype: DTypeLike) -> Float[Array, "4 4"]:
    """Gates of a scene: x, y, z of the centers (m) and headings (rad)."""
    beams = BEAMS * len(GATES)
    if scene.boxes is None or len(scene.boxes.pos) < beams:
        found = 0 if scene.boxes is None else len(scene.boxes.pos)
        raise UserError(
            f"the task needs a scene whose first {beams} boxes are the beams of its {len(GATES)} gates; this one "
            f"has {found} boxes; give one of jaxdrones.sensing.track"
        )
    pos, quat = (
        jnp.asarray(x[:beams], dtype).reshape(len(GATES), BEAMS, -1) for x in (scene.boxes.pos, scene.boxes.quat)
    )
    heading = 2 * atan2(quat[:, 0, 2], quat[:, 0, 3])
    return jnp.concatenate([jnp.mean(pos, axis=1), heading[:, None]], axis=-1)


def poles_of(scene: Scene, dtype: DTypeLike) -> Float[Array, "4 2"]:
    """X and y of the first four cylinders of a scene, m; missing ones are far away."""
    pos = jnp.zeros((0, 2)) if scene.cylinders is None else scene.cylinders.pos[: len(POLES), :2]
    missing = len(POLES) - len(pos)
    return jnp.pad(jnp.asarray(pos, dtype), ((0, missing), (0, 0)), constant_values=_NOWHERE)


def direction(gate: Float[Array, "*b 4"]) -> Float[Array, "*b 3"]:
    """Crossing direction of a gate, a unit vector in world axes."""
    yaw = gate[..., 3]
    return jnp.stack([jnp.cos(yaw), jnp.sin(yaw), jnp.zeros_like(yaw)], axis=-1)


def passes(
    gate: Float[Array, "n 4"], before: Float[Array, "n 3"], pos: Float[Array, "n 3"], opening: float = OPENING
) -> Bool[Array, " n"]:
    """Whether the straight way of every drone between two positions (m) passes its gate's opening in its direction."""
    start, end = _in_gate(gate, before), _in_gate(gate, pos)
    crosses = (start[:, 0] < 0) & (end[:, 0] >= 0)
    share = -start[:, 0] / jnp.where(crosses, end[:, 0] - start[:, 0], 1)
    _, y, z = jnp.abs(start + share[:, None] * (end - start)).T
    return crosses & (y < opening / 2) & (z < opening / 2)


def gates_ahead(gates: Float[Array, "g 4"], index: Int[Array, " n"]) -> Float[Array, "n 2 4"]:
    """Gates of the indices and those after them, at most the last one."""
    return jnp.stack([gates[jnp.minimum(index + later, len(gates) - 1)] for later in (0, 1)], axis=1)


def next_gate(variables: dict[str, Any]) -> Float[Array, "n 4"]:
    """Next gate of every drone."""
    return gates_ahead(variables["gates"], variables["index"])[:, 0]


def target(variables: dict[str, Any], t: Array) -> Setpoint:
    """Center of the next gate."""
    return Setpoint.at(next_gate(variables)[:, :3])


def crashed(task: Task, world: World) -> Bool[Array, " n"]:
    """A drone touches a gate or a pole, or falls below the ground."""
    return world.variables["hit"] | (world.drones.pos[:, 2] < standing_height(world.params) - 0.01)


def passed(task: Task, world: World) -> Float[Array, " n"]:
    """One in the step in which the drone passes its next gate."""
    return (world.variables["index"] - world.variables["before"]).astype(world.drones.pos.dtype)


def crash(task: Task, world: World) -> Float[Array, " n"]:
    """One if a drone touches a gate or a pole, or falls below the ground."""
    return crashed(task, world).astype(world.drones.pos.dtype)


def _observe_gates(task: Task, world: World) -> Float[Array, "n 12"]:
    """Center relative to the drone (m) and direction of the next gate and of the one after it, world axes."""
    gates, pos = gates_ahead(world.variables["gates"], world.variables["index"]), world.drones.pos
    return jnp.concatenate([gates[..., :3] - pos[:, None], direction(gates)], axis=-1).reshape(len(pos), -1)


OBSERVATION = ObservationTerm(_observe_gates, 20.0, entries=_GATE_ENTRIES)
METRICS = {
    "gates": shaping.variable("index", "Number of gates passed so far."),
    "lap_time": shaping.variable("lap_time", "Time until the last gate was passed, or so far, s."),
}


@functools.cache
def _nominal_scene(dtype: DTypeLike) -> Scene:
    """Gates and poles of levels 0 and 1, of the default type of numbers."""
    with jax.ensure_compile_time_eval():
        return jax.jit(lambda: _solids(GATES, POLES))()


def _random_scene(level: int, key: jax.Array) -> Scene:
    """Gates and poles of level 2 or 3."""
    gate_key, pole_key = jax.random.split(key)
    u = jax.random.uniform(gate_key, GATES.shape, minval=-1, maxval=1)
    if level == 3:
        return track(_random_track(u), OPENING, FRAME)
    moved = jax.random.uniform(pole_key, POLES.shape, minval=-_POLE_RANGE, maxval=_POLE_RANGE)
    return _solids(jnp.asarray(GATES) + jnp.asarray(_GATE_RANGE)[None] * u, jnp.asarray(POLES) + moved)


def _random_track(u: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
    """Track of four gates from random numbers in [-1, 1]."""
    quarter = jnp.array([(1, 0), (0, 1), (-1, 0), (0, -1)], u.dtype)  # one gate in each, so that they stay apart
    place = quarter * jnp.array([[1.3, 0.9]]) + 0.25 * u[:, :2]
    heading = jnp.arctan2(quarter[:, 0], -quarter[:, 1]) + 0.6 * u[:, 3]  # counterclockwise, 34 degrees off
    return jnp.concatenate([place, 0.95 + 0.25 * u[:, 2:3], heading[:, None]], axis=-1)


def _solids(gates: ArrayLike, poles: ArrayLike) -> Scene:
    gates, poles = jnp.asarray(gates, float), jnp.asarray(poles, float)
    pos = jnp.concatenate([poles, jnp.full((len(poles), 1), POLE_HEIGHT / 2)], axis=-1)
    beams = jax.vmap(lambda pose: gate(pose[:3], pose[3], OPENING, FRAME))(gates)
    return Scene.of(beams, Cylinder(pos=pos, radius=POLE_RADIUS, height=POLE_HEIGHT))


def _random_inertia(key: jax.Array, params: Params) -> Params:
    """Every moment of inertia times a random factor near one."""
    factor = jax.random.uniform(key, params.inertia.shape, params.inertia.dtype, 1 - _INERTIA_RANGE, 1 + _INERTIA_RANGE)
    return params.replace(inertia=params.inertia * factor)


def _in_gate(gate: Float[Array, "n 4"], pos: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Positions in the axes of a gate: through it, to its left, up; m."""
    dx, dy, dz = (pos - gate[:, :3]).T
    cos, sin = jnp.cos(gate[:, 3]), jnp.sin(gate[:, 3])
    return jnp.stack([cos * dx + sin * dy, cos * dy - sin * dx, dz], axis=-1)
