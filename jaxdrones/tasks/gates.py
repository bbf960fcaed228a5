"""Race through gates: the track of lsy_drone_racing, nominal, randomised or drawn at random."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.checks import check_keywords, check_number, check_switch, check_whole, shown
from jaxdrones.control import Setpoint
from jaxdrones.params import Params
from jaxdrones.sensing import Cylinder, Scene, gate
from jaxdrones.state import State
from jaxdrones.tasks import shaping
from jaxdrones.tasks.starts import hovering, standing_height
from jaxdrones.tasks.task import ObservationTerm, Task, World, norm, out_of_control, square

# x, y, z (m) and heading (rad) in which each gate is crossed, in this order
GATES = np.array([(0.5, 0.25, 0.7, -0.78), (1.05, 0.75, 1.2, 2.35), (-1.0, -0.25, 0.7, 3.14), (0.0, -0.75, 1.2, 0.0)])
POLES = np.array([(0.0, 0.75), (1.0, 0.25), (-1.5, -0.25), (-0.5, -0.75)])  # x, y, m
START = np.array([-1.5, 0.75])
OPENING, OUTER = 0.40, 0.72  # m, edges of the square hole and of the frame
POLE_RADIUS, POLE_HEIGHT = 0.015, 1.52  # m
LEVELS = (0, 1, 2, 3)
_START_SPACING = 0.5  # m in y between drones at the start
_ARENA = 3.0  # m from the middle of the track along every axis, beyond which a drone is lost
_MAX_DRONES = 5  # so that all start inside the arena

_GATE_RANGE = np.array([0.15, 0.15, 0.1, 0.2])  # m, m, m, rad: level 2 moves gates by U(-range, range)
_POLE_RANGE = 0.15  # m
_SIGHT = 3.0  # m, at which the observed positions of poles are clipped
_INERTIA_RANGE = 0.2  # share: level 1 on


@check_keywords
def gates(drones: int = 1, level: int = 0, duration: float = 12.0, random_start: bool = False) -> Task:
    """One lap through four gates.

    In Bullet gates and poles are solid on levels 0 and 1; on the others hits are found by geometry alone.

    Args:
        drones: number of drones, at most 5; they start 0.5 m apart in y and do not observe each other.
        level: 0 nominal; 1 random inertia; 2 gates and poles displaced too; 3 random tracks without poles.
        duration: duration of an episode, s.
        random_start: for training: drones start in the air in front of a random gate, one time in five on the ground
            at the start of the track; else always there.
    """
    check_whole("number of drones of gates", drones)
    check_number("number of drones of gates", drones, at_most=_MAX_DRONES)
    check_whole("level", level, minimum=0)
    check_switch("random_start", random_start)
    if level not in LEVELS:
        raise ValueError(f"level is {shown(level)}; give one of {', '.join(map(str, LEVELS))}")

    def start(key: jax.Array, params: Params) -> tuple[State, dict[str, Array]]:
        track_key, pole_key, gate_key, place_key = jax.random.split(key, 4)
        n, dtype = len(params.mass), params.mass.dtype
        variables = {"gates": _track(track_key, level, dtype), "poles": _poles(pole_key, level, dtype)}
        x, y = START
        pos = jnp.stack(
            [jnp.full(n, x, dtype), y + _START_SPACING * jnp.arange(n, dtype=dtype), standing_height(params)], axis=-1
        )
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
        return Setpoint.at(_gate(variables)[:, :3])

    def crashed(task: Task, world: World):
        fell = world.drones.pos[:, 2] < standing_height(world.params) - 0.01
        return world.variables["hit"] | fell

    def finished(task: Task, world: World):
        return jnp.broadcast_to(jnp.all(world.variables["index"] >= len(GATES)), (drones,))

    def passed(task: Task, world: World):
        return world.variables["index"] - world.variables["before"]

    def as_number(condition):
        return lambda task, world: condition(task, world).astype(world.drones.pos.dtype)

    return Task(
        name="gates",
        summary="race through four gates, level 0 to 3",
        drones=drones,
        duration=duration,
        start=start,
        target=target,
        rewards={
            "progress": (10.0, lambda task, world: world.variables["progress"]),
            "passed": (5.0, as_number(passed)),
            "crashed": (-10.0, as_number(crashed)),
            "omega": (-0.002, shaping.body_rates),
            "action_change": (-0.02, shaping.action_change),
        },
        terminations={"finished": finished, "crashed": crashed} | out_of_control(_ARENA, center=(0, 0, 1)),
        advance=_advance,
        metrics={
            "gates": as_number(lambda task, world: world.variables["index"]),
            "lap_time": lambda task, world: world.variables["lap_time"],
        },
        success=lambda metrics, dt: metrics["gates"][-1] == len(GATES),
        randomize=() if level == 0 else (_random_inertia,),
        observations={"gates": ObservationTerm(_observe_gates, 20.0), "poles": ObservationTerm(_observe_poles, _SIGHT)},
        scene=_scene() if level < 2 else Scene(),
        obstacles_terminate=True,
        contact=("ground",),
        observation=("position", "gates", "poles", "rotation_matrix", "velocity", "omega", "last_action"),
    )


def _advance(task: Task, world: World) -> dict[str, Array]:
    """Which gates are passed and what is hit on the straight line from the last position to this one."""
    variables, params, pos = world.variables, world.params, world.drones.pos
    gate = _gate(variables)
    before, after = _in_gate(gate, variables["pos"]), _in_gate(gate, pos)
    crosses = (before[:, 0] < 0) & (after[:, 0] >= 0)
    share = -before[:, 0] / jnp.where(crosses, after[:, 0] - before[:, 0], 1)
    _, y, z = jnp.abs(before + share[:, None] * (after - before)).T
    radius, half = params.collision_radius, params.collision_height / 2
    inside = (y < OPENING / 2 - radius) & (z < OPENING / 2 - half)
    frame = (y < OUTER / 2 + radius) & (z < OUTER / 2 + half) & ~inside

    away = square((pos[:, None, :2] - variables["poles"][None]).reshape(-1, 2)).reshape(len(pos), -1)
    pole = jnp.any(away < (POLE_RADIUS + radius[:, None]) ** 2, axis=-1) & (pos[:, 2] < POLE_HEIGHT + half)

    index = variables["index"]
    racing = index < len(GATES)
    target = task.target_now(world).pos  # before the gate is passed
    return variables | {
        "index": index + (racing & crosses & inside),
        "before": index,
        "hit": pole | (racing & crosses & frame),
        "pos": pos,
        "progress": racing * (norm(variables["pos"] - target) - norm(pos - target)),
        "lap_time": jnp.where(racing, world.time, variables["lap_time"]),
    }


def _track(key: jax.Array, level: int, dtype) -> Float[Array, "4 4"]:
    u = jax.random.uniform(key, GATES.shape, dtype, -1, 1)
    if level < 2:
        return jnp.asarray(GATES, dtype)
    if level == 2:
        return jnp.asarray(GATES, dtype) + jnp.asarray(_GATE_RANGE, dtype)[None] * u
    quarter = jnp.asarray([(1, 0), (0, 1), (-1, 0), (0, -1)], dtype)  # one gate in each, so that they stay apart
    place = quarter * jnp.asarray([[1.3, 0.9]], dtype) + 0.25 * u[:, :2]
    heading = jnp.arctan2(quarter[:, 0], -quarter[:, 1]) + 0.6 * u[:, 3]  # counter-clockwise, 34 degrees off
    return jnp.concatenate([place, 0.95 + 0.25 * u[:, 2:3], heading[:, None]], axis=-1)


def _poles(key: jax.Array, level: int, dtype) -> Float[Array, "4 2"]:
    poles = jnp.asarray(POLES, dtype)
    if level == 2:
        return poles + jax.random.uniform(key, POLES.shape, dtype, -_POLE_RANGE, _POLE_RANGE)
    return poles + (100.0 if level == 3 else 0.0)  # m: outside the arena


def _random_inertia(key: jax.Array, params: Params) -> Params:
    factor = jax.random.uniform(key, params.inertia.shape, params.inertia.dtype, 1 - _INERTIA_RANGE, 1 + _INERTIA_RANGE)
    return params.replace(inertia=params.inertia * factor)


def _gate(variables: dict[str, Array], later: int = 0) -> Float[Array, "n 4"]:
    """The gate that every drone is to cross next, or the one that is `later` gates ahead, at most the last one."""
    return variables["gates"][jnp.minimum(variables["index"] + later, len(GATES) - 1)]


def _normal(gate: Float[Array, "n 4"]) -> Float[Array, "n 3"]:
    """The direction in which a gate is crossed."""
    yaw = gate[:, 3]
    return jnp.stack([jnp.cos(yaw), jnp.sin(yaw), jnp.zeros_like(yaw)], axis=-1)


def _in_gate(gate: Float[Array, "n 4"], pos: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Positions in the axes of a gate: through it, to its left, up; m."""
    dx, dy, dz = (pos - gate[:, :3]).T
    cos, sin = jnp.cos(gate[:, 3]), jnp.sin(gate[:, 3])
    return jnp.stack([cos * dx + sin * dy, cos * dy - sin * dx, dz], axis=-1)


def _observe_gates(task: Task, world: World) -> Float[Array, "n 12"]:
    """Centre relative to the drone (m) and direction of the next gate and of the one after it, world axes."""
    ahead = [_gate(world.variables, later) for later in (0, 1)]
    return jnp.concatenate([x for gate in ahead for x in (gate[:, :3] - world.drones.pos, _normal(gate))], axis=-1)


def _observe_poles(task: Task, world: World) -> Float[Array, "n 8"]:
    """Positions of all poles relative to the drone, x and y in world axes, m; clipped at 3 m."""
    away = world.variables["poles"][None] - world.drones.pos[:, None, :2]
    return jnp.clip(away, -_SIGHT, _SIGHT).reshape(len(away), -1)


def _scene() -> Scene:
    poles = np.column_stack([POLES, np.full(len(POLES), POLE_HEIGHT / 2)])
    return Scene.of(
        jax.vmap(gate)(GATES[:, :3], GATES[:, 3]), Cylinder(pos=poles, radius=POLE_RADIUS, height=POLE_HEIGHT)
    )
