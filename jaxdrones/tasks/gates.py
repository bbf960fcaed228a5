"""Task: race through gates on the track of lsy_drone_racing, nominal, randomized or random."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxdrones.arguments import NonNegativeInt, Switch, checked, number
from jaxdrones.checks import short_repr
from jaxdrones.control import Setpoint
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.quantity import described, quantities
from jaxdrones.sensing import BEAMS, Cylinder, Scene, gate, track
from jaxdrones.state import State
from jaxdrones.tasks import shaping
from jaxdrones.tasks.conditions import out_of_control
from jaxdrones.tasks.starts import hovering, standing_height
from jaxdrones.tasks.task import Drones, ObservationTerm, Task, World, norm
from jaxdrones.tasks.touching import touches
from jaxdrones.vector import atan2

# x, y, z (m) and crossing heading (rad) of each gate, in this order
GATES = np.array([(0.5, 0.25, 0.7, -0.78), (1.05, 0.75, 1.2, 2.35), (-1.0, -0.25, 0.7, 3.14), (0.0, -0.75, 1.2, 0.0)])
POLES = np.array([(0.0, 0.75), (1.0, 0.25), (-1.5, -0.25), (-0.5, -0.75)])  # x, y, m
START = np.array([-1.5, 0.75])
OPENING, FRAME = 0.40, 0.16  # m, edge of the square hole and width of the beams around it
POLE_RADIUS, POLE_HEIGHT = 0.015, 1.52  # m
LEVELS = (0, 1, 2, 3)
_START_SPACING = 0.5  # m in y between drones at the start
_MAX_SPREAD = 0.15  # m, so that drones stay apart at the start
_ARENA = 3.0  # m from the middle of the track along every axis: bounds of the arena
_MAX_DRONES = 5  # so that all drones start inside the arena

_GATE_RANGE = np.array([0.15, 0.15, 0.1, 0.2])  # m, m, m, rad: level 2 moves gates by U(-range, range)
_POLE_RANGE = 0.15  # m
_NOWHERE = 100.0  # m: outside the arena
_SIGHT = 3.0  # m, at which the observed positions of poles are clipped
_INERTIA_RANGE = 0.2  # share: level 1 on


_GATE_ENTRIES = tuple(
    entry
    for gate in ("next gate", "gate after it")
    for entry in (
        *quantities(f"center of the {gate}, from the drone", "m", "world"),
        *quantities(f"direction through the {gate}", "-", "world"),
    )
)
_POLE_ENTRIES = tuple(
    entry for i in range(len(POLES)) for entry in quantities(f"pole {i}, from the drone", "m", "world", "xy")
)


@checked
def gates(
    drones: Annotated[Drones, number(name="number of drones of {function}", at_most=_MAX_DRONES)] = 1,
    level: NonNegativeInt = 0,
    duration: float = 12.0,
    random_start: Switch = False,
    start_spread: Annotated[float, number("m", at_least=0, at_most=_MAX_SPREAD)] = 0.0,
) -> Task:
    """One lap through four gates.

    Gates and poles are obstacles of the scene: solid in Bullet, visible to cameras, with collisions by
    `sensing.collisions`. A scene of your own has to begin with four gates, as from `sensing.track`.

    Args:
        drones: number of drones, at most 5; they start 0.5 m apart in y and do not observe each other.
        level: 0 nominal; 1 random inertia; 2 gates and poles displaced too; 3 random tracks without poles.
        duration: duration of an episode, s.
        random_start: for training: start in the air in front of a random gate with probability 0.8, else on the ground
            at the start of the track.
        start_spread: on the ground, drones start within +-start_spread of the start along x and y, m; at most 0.15.
    """
    if level not in LEVELS:
        raise UserError(f"level is {short_repr(level)}; give one of {', '.join(map(str, LEVELS))}")

    def start(key: jax.Array, params: Params, scene: Scene) -> tuple[State, dict[str, Array]]:
        """On the ground at the start of the track, or in the air in front of a random gate."""
        gate_key, place_key, spread_key = jax.random.split(key, 3)
        n, dtype = len(params.mass), params.mass.dtype
        variables = {"gates": _gates_of(scene, dtype), "poles": _poles_of(scene, dtype)}
        x, y = START
        pos = jnp.stack(
            [jnp.full(n, x, dtype), y + _START_SPACING * jnp.arange(n, dtype=dtype), standing_height(params)], axis=-1
        )
        if start_spread:
            pos = pos.at[:, :2].add(jax.random.uniform(spread_key, (n, 2), dtype, -start_spread, start_spread))
        index = jnp.zeros(n, jnp.int32)
        if random_start:
            place = jax.random.randint(gate_key, (n,), -1, len(GATES))
            index = jnp.maximum(place, 0)
            ahead = variables["gates"][index]
            before = ahead[:, :3] - 0.7 * _normal(ahead) + jax.random.uniform(place_key, (n, 3), dtype, -0.3, 0.3)
            pos = jnp.where(place[:, None] < 0, pos, before)
        lap = {
            "index": index,
            "before": index,
            "hit": jnp.zeros(n, bool),
            "pos": pos,
            "progress": jnp.zeros(n, dtype),
        }
        return hovering(params, pos), variables | lap | {"lap_time": jnp.zeros(n, dtype)}

    def target(variables, t) -> Setpoint:
        """Center of the next gate."""
        return Setpoint.at(_gate(variables)[:, :3])

    def crashed(task: Task, world: World):
        """A drone touches a gate or a pole, or falls below the ground."""
        fell = world.drones.pos[:, 2] < standing_height(world.params) - 0.01
        return world.variables["hit"] | fell

    def finished(task: Task, world: World):
        """All drones have passed all gates."""
        return jnp.broadcast_to(jnp.all(world.variables["index"] >= len(GATES)), (drones,))

    def passed(task: Task, world: World):
        """One in the step in which the drone passes its next gate."""
        return world.variables["index"] - world.variables["before"]

    def as_number(condition):
        number = lambda task, world: condition(task, world).astype(world.drones.pos.dtype)  # noqa: E731
        return described(condition.__doc__, number)

    return Task(
        name="gates",
        summary="race through four gates, level 0 to 3",
        drones=drones,
        duration=duration,
        start=start,
        target=target,
        rewards={
            "progress": (10.0, shaping.variable("progress", "Approach to the next gate in the last step, m.")),
            "passed": (5.0, as_number(passed)),
            "crashed": (-10.0, as_number(crashed)),
            "omega": (-0.002, shaping.body_rates),
            "action_change": (-0.02, shaping.action_change),
        },
        terminations={"finished": finished, "crashed": crashed} | out_of_control(_ARENA, center=(0, 0, 1)),
        advance=_advance,
        metrics={
            "gates": shaping.variable("index", "Number of gates passed so far."),
            "lap_time": shaping.variable("lap_time", "Time until the last gate was passed, or so far, s."),
        },
        success=_finished,
        success_terminations=("finished",),
        randomize=() if level == 0 else (_random_inertia,),
        observations={
            "gates": ObservationTerm(_observe_gates, 20.0, entries=_GATE_ENTRIES),
            "poles": ObservationTerm(_observe_poles, _SIGHT, entries=_POLE_ENTRIES),
        },
        scene=_scene(level) if level < 2 else functools.partial(_scene, level),
        obstacles_terminate=True,
        contact=("ground",),
        observation=("position", "gates", "poles", "rotation_matrix", "velocity", "omega", "last_action"),
    )


def _finished(metrics: Mapping[str, Array], dt: float) -> Array:
    """Whether a drone passed all gates."""
    return metrics["gates"][-1] == len(GATES)


def _advance(task: Task, world: World) -> dict[str, Array]:
    """Update passed gates and collisions on the straight line from the last position to this one."""
    variables, pos = world.variables, world.drones.pos
    ahead = _gate(variables)
    before, after = _in_gate(ahead, variables["pos"]), _in_gate(ahead, pos)
    crosses = (before[:, 0] < 0) & (after[:, 0] >= 0)
    share = -before[:, 0] / jnp.where(crosses, after[:, 0] - before[:, 0], 1)
    _, y, z = jnp.abs(before + share[:, None] * (after - before)).T
    passes = crosses & (y < OPENING / 2) & (z < OPENING / 2)

    index = variables["index"]
    racing = index < len(GATES)
    target = task.target_now(world).pos  # before the gate is passed
    return variables | {
        "index": index + (racing & passes),
        "before": index,
        "hit": touches(world, variables["pos"], world.scene.replace(ground=False)).scene,
        "pos": pos,
        "progress": racing * (norm(variables["pos"] - target) - norm(pos - target)),
        "lap_time": jnp.where(racing, world.time, variables["lap_time"]),
    }


def _scene(level: int, key: jax.Array | None = None) -> Scene:
    """Gates and poles of a level, random in levels 2 and 3."""
    if key is None:
        return _solids(GATES, POLES)
    gate_key, pole_key = jax.random.split(key)
    u = jax.random.uniform(gate_key, GATES.shape, minval=-1, maxval=1)
    if level == 3:
        return _solids(_random_track(u))
    moved = jax.random.uniform(pole_key, POLES.shape, minval=-_POLE_RANGE, maxval=_POLE_RANGE)
    return _solids(jnp.asarray(GATES) + jnp.asarray(_GATE_RANGE)[None] * u, jnp.asarray(POLES) + moved)


def _random_track(u: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
    """Track of four gates from random numbers in [-1, 1]."""
    quarter = jnp.array([(1, 0), (0, 1), (-1, 0), (0, -1)], u.dtype)  # one gate in each, so that they stay apart
    place = quarter * jnp.array([[1.3, 0.9]]) + 0.25 * u[:, :2]
    heading = jnp.arctan2(quarter[:, 0], -quarter[:, 1]) + 0.6 * u[:, 3]  # counterclockwise, 34 degrees off
    return jnp.concatenate([place, 0.95 + 0.25 * u[:, 2:3], heading[:, None]], axis=-1)


def _solids(gates: ArrayLike, poles: ArrayLike | None = None) -> Scene:
    """Scene of gates (4, 4) and poles (k, 2)."""
    if poles is None:
        return track(gates, OPENING, FRAME)
    gates, poles = jnp.asarray(gates, float), jnp.asarray(poles, float)
    pos = jnp.concatenate([poles, jnp.full((len(poles), 1), POLE_HEIGHT / 2)], axis=-1)
    beams = jax.vmap(lambda pose: gate(pose[:3], pose[3], OPENING, FRAME))(gates)
    return Scene.of(beams, Cylinder(pos=pos, radius=POLE_RADIUS, height=POLE_HEIGHT))


def _gates_of(scene: Scene, dtype) -> Float[Array, "4 4"]:
    """Gates of a scene: x, y, z of the centers (m) and headings (rad)."""
    beams = BEAMS * len(GATES)
    if scene.boxes is None or len(scene.boxes.pos) < beams:
        found = 0 if scene.boxes is None else len(scene.boxes.pos)
        raise UserError(
            f"the task gates needs a scene whose first {beams} boxes are the beams of its {len(GATES)} gates; this one "
            f"has {found} boxes; give one of jaxdrones.sensing.track"
        )
    pos, quat = (
        jnp.asarray(x[:beams], dtype).reshape(len(GATES), BEAMS, -1) for x in (scene.boxes.pos, scene.boxes.quat)
    )
    heading = 2 * atan2(quat[:, 0, 2], quat[:, 0, 3])
    return jnp.concatenate([jnp.mean(pos, axis=1), heading[:, None]], axis=-1)


def _poles_of(scene: Scene, dtype) -> Float[Array, "4 2"]:
    """X and y of the first four cylinders of a scene, m; missing ones are far away."""
    pos = jnp.zeros((0, 2)) if scene.cylinders is None else scene.cylinders.pos[: len(POLES), :2]
    missing = len(POLES) - len(pos)
    return jnp.pad(jnp.asarray(pos, dtype), ((0, missing), (0, 0)), constant_values=_NOWHERE)


def _random_inertia(key: jax.Array, params: Params) -> Params:
    """Every moment of inertia times a random factor near one."""
    factor = jax.random.uniform(key, params.inertia.shape, params.inertia.dtype, 1 - _INERTIA_RANGE, 1 + _INERTIA_RANGE)
    return params.replace(inertia=params.inertia * factor)


def _gate(variables: dict[str, Array], later: int = 0) -> Float[Array, "n 4"]:
    """Next gate of every drone, or the one `later` gates ahead, at most the last one."""
    return variables["gates"][jnp.minimum(variables["index"] + later, len(GATES) - 1)]


def _normal(gate: Float[Array, "n 4"]) -> Float[Array, "n 3"]:
    """Crossing direction of a gate."""
    yaw = gate[:, 3]
    return jnp.stack([jnp.cos(yaw), jnp.sin(yaw), jnp.zeros_like(yaw)], axis=-1)


def _in_gate(gate: Float[Array, "n 4"], pos: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Positions in the axes of a gate: through it, to its left, up; m."""
    dx, dy, dz = (pos - gate[:, :3]).T
    cos, sin = jnp.cos(gate[:, 3]), jnp.sin(gate[:, 3])
    return jnp.stack([cos * dx + sin * dy, cos * dy - sin * dx, dz], axis=-1)


def _observe_gates(task: Task, world: World) -> Float[Array, "n 12"]:
    """Center relative to the drone (m) and direction of the next gate and of the one after it, world axes."""
    ahead = [_gate(world.variables, later) for later in (0, 1)]
    return jnp.concatenate([x for gate in ahead for x in (gate[:, :3] - world.drones.pos, _normal(gate))], axis=-1)


def _observe_poles(task: Task, world: World) -> Float[Array, "n 8"]:
    """Positions of all poles relative to the drone, x and y in world axes, m; clipped at 3 m."""
    away = world.variables["poles"][None] - world.drones.pos[:, None, :2]
    return jnp.clip(away, -_SIGHT, _SIGHT).reshape(len(away), -1)
