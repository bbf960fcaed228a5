"""Task: race through gates on the track of lsy_drone_racing, nominal, randomized or random."""

from collections.abc import Mapping
from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.arguments import NonNegativeInt, Switch, checked, number
from jaxdrones.params import Params
from jaxdrones.quantity import quantities
from jaxdrones.sensing import Scene
from jaxdrones.state import State
from jaxdrones.tasks import racetrack, shaping
from jaxdrones.tasks.racetrack import ARENA, FRAME, GATES, MIDDLE, OPENING, POLES, START
from jaxdrones.tasks.starts import check_apart, hovering, standing_height
from jaxdrones.tasks.task import Drones, ObservationTerm, Task, World, norm
from jaxdrones.tasks.touching import touches

__all__ = ("FRAME", "GATES", "OPENING", "POLES", "START", "gates")

_START_SPACING = 0.5  # m in y between drones at the start
_MAX_SPREAD = 0.15  # m, so that drones stay apart at the start
_MAX_DRONES = 5  # so that all drones start inside the arena
_CRASH = 60.0  # control steps whose time penalty a crash costs
_SIGHT = 3.0  # m, at which the observed positions of poles are clipped

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
    time_penalty: Annotated[float, number(at_least=0)] = 0.0,
) -> Task:
    """One lap through four gates.

    Gates and poles are obstacles of the scene, visible in camera images; touching one ends the episode. Your own scene
    must begin with four gates, as from `sensing.track`.

    Args:
        drones: number of drones, at most 5; they start 0.5 m apart in y and do not observe each other.
        level: 0 nominal; 1 random inertia; 2 gates and poles displaced too; 3 random tracks without poles.
        duration: duration of an episode, s.
        random_start: for training: start in the air in front of a random gate with probability 0.8, else on the ground
            at the start of the track.
        start_spread: on the ground, drones start within +-start_spread of the start along x and y, m; at most 0.15.
        time_penalty: reward lost in every control step until the last gate, and 60 times as much in a crash, so that it
            never pays to crash early: for faster laps of a policy that already finishes them.
    """
    scene = racetrack.scene_of(level)

    def start(key: jax.Array, params: Params, scene: Scene) -> tuple[State, dict[str, Array]]:
        """On the ground at the start of the track, or in the air in front of a random gate."""
        check_apart(params, _START_SPACING - 2 * start_spread)
        gate_key, place_key, spread_key = jax.random.split(key, 3)
        n, dtype = len(params.mass), params.mass.dtype
        variables = {"gates": racetrack.gates_of(scene, dtype), "poles": racetrack.poles_of(scene, dtype)}
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
            spread = jax.random.uniform(place_key, (n, 3), dtype, -0.3, 0.3)
            before = ahead[:, :3] - 0.7 * racetrack.direction(ahead) + spread
            pos = jnp.where(place[:, None] < 0, pos, before)
        lap = {
            "index": index,
            "before": index,
            "hit": jnp.zeros(n, bool),
            "pos": pos,
            "progress": jnp.zeros(n, dtype),
        }
        return hovering(params, pos), variables | lap | {"lap_time": jnp.zeros(n, dtype)}

    def finished(task: Task, world: World):
        """All drones have passed all gates."""
        return jnp.broadcast_to(jnp.all(world.variables["index"] >= len(GATES)), (drones,))

    return Task(
        name="gates",
        summary="race through four gates, level 0 to 3",
        drones=drones,
        duration=duration,
        start=start,
        target=racetrack.target,
        rewards={
            "progress": (10.0, shaping.variable("progress", "Approach to the next gate in the last step, m.")),
            "passed": (5.0, racetrack.passed),
            "crashed": (-10.0 - _CRASH * time_penalty, racetrack.crash),
            "omega": (-0.002, shaping.body_rates),
            "action_change": (-0.02, shaping.action_change),
        }
        | ({"time": (-time_penalty, _racing)} if time_penalty else {}),
        terminations={"finished": finished, "crashed": racetrack.crashed}
        | shaping.out_of_control(ARENA, center=MIDDLE),
        advance=_advance,
        metrics=racetrack.METRICS,
        success=_finished,
        success_terminations=("finished",),
        randomize=racetrack.randomization_of(level),
        observations={
            "gates": racetrack.OBSERVATION,
            "poles": ObservationTerm(_observe_poles, _SIGHT, entries=_POLE_ENTRIES),
        },
        scene=scene,
        obstacles_terminate=True,
        contact=("ground",),
        observation=("position", "gates", "poles", "rotation_matrix", "velocity", "omega", "last_action"),
    )


def _racing(task: Task, world: World) -> Float[Array, " n"]:
    """One in every step until the drone has passed all gates."""
    return (world.variables["before"] < len(GATES)).astype(world.drones.pos.dtype)


def _finished(metrics: Mapping[str, Array], dt: float) -> Array:
    """Whether a drone passed all gates."""
    return metrics["gates"][-1] == len(GATES)


def _advance(task: Task, world: World) -> dict[str, Array]:
    """Update passed gates and collisions on the straight line from the last position to this one."""
    variables, pos = world.variables, world.drones.pos
    index = variables["index"]
    racing = index < len(GATES)
    target = task.target_now(world).pos  # before the gate is passed
    return variables | {
        "index": index + (racing & racetrack.passes(racetrack.next_gate(variables), variables["pos"], pos)),
        "before": index,
        "hit": touches(world, variables["pos"], world.scene.replace(ground=False)).scene,
        "pos": pos,
        "progress": racing * (norm(variables["pos"] - target) - norm(pos - target)),
        "lap_time": jnp.where(racing, world.time, variables["lap_time"]),
    }


def _observe_poles(task: Task, world: World) -> Float[Array, "n 8"]:
    """Positions of all poles relative to the drone, x and y in world axes, m; clipped at 3 m."""
    away = world.variables["poles"][None] - world.drones.pos[:, None, :2]
    return jnp.clip(away, -_SIGHT, _SIGHT).reshape(len(away), -1)
