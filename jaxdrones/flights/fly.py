"""Flying the paper's control examples on either backend."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxdrones import rotation
from jaxdrones.control import CONTROLLERS, Setpoint, for_team, pid, velocity
from jaxdrones.dynamics import EFFECTS, INTEGRATORS, PAIRS, ROTORS
from jaxdrones.engine.explicit import make_step
from jaxdrones.engine.rollout import rollout
from jaxdrones.flights.conditions import Conditions
from jaxdrones.flights.examples import FLIGHTS, Flight
from jaxdrones.flights.record import Record
from jaxdrones.params import Params, repeat
from jaxdrones.sensing.scene import Scene, paper_obstacles
from jaxdrones.state import State
from jaxdrones.urdf import load_params

_START_SPREAD = 0.01  # m; standard deviation of the start when a seed is given


def fly(flight: str, gui: bool = False, progress: Callable[[float], None] | None = None, **options: Any) -> Record:
    """Fly one of the examples.

    Args:
        flight: `circle`, `velocity`, `ground-effect` or `downwash`.
        gui: watch it in Bullet's window, in real time.
        progress: is told now and then which share of the flight is flown.
        options: the other fields of `Conditions`.

    Raises:
        ValueError: an unknown name or a number out of range; says what, what was given, what to do.
    """
    conditions = Conditions(flight, **options)
    example, n, dt, steps = FLIGHTS[flight], conditions.drones, conditions.dt, conditions.steps
    pilot, memory = _pilot(conditions)

    def control(params, memory, state, k):
        if progress is not None:
            _report(k, steps, progress)
        return jax.vmap(pilot)(params, memory, state, example.target(n, k * dt, conditions.duration))

    @jax.jit
    def prepare(params: Params) -> tuple[Params, State]:
        return example.adapt(repeat(params, n)), _start(example, n, conditions.seed)

    @jax.jit
    def finish(params: Params, trajectory: State) -> dict[str, jax.Array]:
        t = dt * jnp.arange(1, steps + 1)
        target = jax.vmap(lambda t: example.target(n, t, conditions.duration))(t)
        target_pos, target_vel = _targets(target, params)
        rpy = jax.vmap(jax.vmap(rotation.to_rpy))(trajectory.quat)
        return dict(vars(trajectory), t=t, rpy=rpy, target_pos=target_pos, target_vel=target_vel)

    params, start = prepare(load_params(conditions.vehicle))
    trajectory = _rollout(conditions, gui, control, params, start, memory)
    log = jax.device_get(finish(params, trajectory))
    jax.effects_barrier()
    return Record(**log, labels=example.labels or tuple(f"drone {i}" for i in range(n)), conditions=conditions)


def scene_of(conditions: Conditions) -> Scene:
    """What stands around the drones of a flight."""
    return paper_obstacles() if conditions.obstacles else Scene()


def _rollout(conditions: Conditions, gui: bool, control, params: Params, start: State, memory) -> State:
    """The trajectory, on the backend that was chosen."""
    common: dict[str, Any] = dict(
        effects=[EFFECTS[effect] for effect in conditions.effects if effect in EFFECTS],
        pairs=[PAIRS[effect] for effect in conditions.effects if effect in PAIRS],
        rotors=ROTORS[conditions.rotors],
        dt=conditions.dt / conditions.substeps,
        substeps=conditions.substeps,
    )
    if conditions.backend == "explicit":
        if gui:
            raise ValueError("a window is asked for; only the bullet backend has one")
        step = make_step(**common, integrator=INTEGRATORS[conditions.integrator])
        fly = jax.jit(lambda params, start, memory: rollout(step, control, params, start, memory, conditions.steps)[1])
        return fly(params, start, memory)

    from jaxdrones.engine import bullet  # optional

    with bullet.make_step(**common, scene=scene_of(conditions), gui=gui) as step:
        step = bullet.Window(step, params, conditions.dt) if gui else step
        return rollout(step, control, params, start, memory, conditions.steps)[1]


def _pilot(conditions: Conditions) -> tuple[Callable, object]:
    """The controller of one drone, and fresh memory for all."""
    if conditions.flight == "velocity":
        control = functools.partial(velocity.control, pid.gains(conditions.vehicle), dt=conditions.dt)
        return control, for_team(pid.init(), conditions.drones)
    module = CONTROLLERS[conditions.controller]
    gains = pid.gains(conditions.vehicle) if module is pid else module.gains()
    return functools.partial(module.control, gains, dt=conditions.dt), for_team(module.init(), conditions.drones)


def _start(flight: Flight, n: int, seed: int | None) -> State:
    state = flight.start(n)
    if seed is None:
        return state
    return state.replace(pos=state.pos + _START_SPREAD * jax.random.normal(jax.random.key(seed), state.pos.shape))


def _report(k: jax.Array, steps: int, progress: Callable[[float], None]) -> None:
    """Tell the host, at every hundredth of the flight, which share of it is flown."""
    every = max(1, steps // 100)

    def tell():
        jax.debug.callback(lambda k: progress(float(k + 1) / steps), k)

    jax.lax.cond((k + 1) % every == 0, tell, lambda: None)


def _targets(target: Setpoint | jax.Array, params: Params) -> tuple[jax.Array, jax.Array]:
    """Commanded positions and velocities over time; NaN for the one that is not commanded."""
    if isinstance(target, Setpoint):
        return target.pos, jnp.full_like(target.pos, jnp.nan)
    vel = jax.vmap(jax.vmap(velocity.commanded), (None, 0))(params, target)
    return jnp.full_like(vel, jnp.nan), vel
