"""`fly`: the control examples on either backend."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.control import Setpoint, velocity
from jaxdrones.dynamics import INTEGRATORS, PAIRS
from jaxdrones.engine.explicit import make_step
from jaxdrones.engine.rollout import Control, leg_length, legs
from jaxdrones.errors import UserError
from jaxdrones.flights.conditions import Conditions
from jaxdrones.flights.controllers import controller_of, physics_of
from jaxdrones.flights.examples import FLIGHTS
from jaxdrones.flights.log import FlightLog, logged
from jaxdrones.params import Params, repeat
from jaxdrones.sensing import Scene, obstacles_2021
from jaxdrones.state import State
from jaxdrones.urdf import load_params

_START_SPREAD = 0.01  # m; standard deviation of the start with a seed


def fly(
    flight: str,
    gui: bool = False,
    progress: Callable[[float], None] | None = None,
    watch: Callable[[FlightLog, float], None] | None = None,
    **options: Any,
) -> FlightLog:
    """Fly one of the examples.

    Args:
        flight: `circle`, `velocity`, `ground-effect` or `downwash`.
        gui: show the flight in Bullet's window, in real time.
        progress: function of the completed fraction of the flight, called at most a hundred times.
        watch: function `(leg, end)`, called with each 1/30 s of the flight and the end time of the flight, s.
        options: other fields of `Conditions`.
    """
    conditions = Conditions(flight, **options)
    example, n, dt, steps = FLIGHTS[flight], conditions.drones, conditions.dt, conditions.steps
    controller = controller_of(conditions)

    def control(params, memory, state, k):
        if progress is not None:
            _report(k, steps, progress)
        return controller.control(params, memory, state, k * dt)

    @jax.jit
    def prepare(params: Params) -> tuple[Params, State, Any]:
        team, start = example.change_params(repeat(params, n)), example.start(n)
        if conditions.seed is not None:
            moved = jax.random.normal(jax.random.key(conditions.seed), start.pos.shape)
            start = start.replace(pos=start.pos + _START_SPREAD * moved)
        return team, start, controller.init(team, start)

    @jax.jit
    def plan(params: Params) -> dict[str, jax.Array]:
        t = dt * jnp.arange(1, steps + 1)
        target = jax.vmap(lambda t: example.target(n, t, conditions.duration))(t)
        if isinstance(target, Setpoint):
            return {"t": t, "target_pos": target.pos}
        return {"t": t, "target_vel": jax.vmap(jax.vmap(velocity.commanded), (None, 0))(params, target)}

    params, start, memory = prepare(load_params(conditions.vehicle))
    planned, team = jax.device_get((plan(params), params))

    def record(trajectory: State, first: int) -> FlightLog:
        rows = slice(first, first + len(trajectory.pos))
        return FlightLog(
            **jax.tree.map(np.asarray, logged(trajectory)),
            **{name: x[rows] for name, x in planned.items()},
            labels=example.labels,
            conditions=conditions,
            params=team,
            scene=scene_of(conditions),
        )

    parts: list[State] = []
    for part in _flown(conditions, gui, control, params, start, memory, whole=watch is None):
        if watch is not None:
            watch(record(part, sum(len(x.pos) for x in parts)), steps * dt)
        parts.append(part)
    jax.effects_barrier()
    return record(jax.tree.map(lambda *x: np.concatenate(x), *parts), 0)


def scene_of(conditions: Conditions) -> Scene:
    """Obstacles and ground of a flight."""
    return obstacles_2021() if conditions.obstacles else Scene()


def _flown(
    conditions: Conditions, gui: bool, control: Control, params: Params, start: State, memory: Any, whole: bool
) -> Iterator[State]:
    """Trajectory on the chosen backend, whole or in legs."""
    length = conditions.steps if whole else leg_length(conditions.dt)
    pairs = [PAIRS[effect] for effect in conditions.effects if effect in PAIRS]
    common = physics_of(conditions) | {"pairs": pairs}
    if conditions.backend == "explicit":
        if gui:
            raise UserError("a window is requested; only the bullet backend has one")
        step = make_step(**common, integrator=INTEGRATORS[conditions.integrator])
        yield from legs(step, control, params, start, memory, conditions.steps, length)
        return

    from jaxdrones.engine import bullet  # optional

    with bullet.make_step(**common, scene=scene_of(conditions), gui=gui) as simulated:
        watched = bullet.Window(simulated, params, conditions.dt) if gui else simulated
        yield from legs(watched, control, params, start, memory, conditions.steps, length)


def _report(k: jax.Array, steps: int, progress: Callable[[float], None]) -> None:
    """Report the completed fraction of the flight to the host, in steps of 1 %."""
    every = max(1, steps // 100)

    def report():
        jax.debug.callback(lambda k: progress(float(k + 1) / steps), k)

    jax.lax.cond((k + 1) % every == 0, report, lambda: None)
