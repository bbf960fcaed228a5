"""Teams that a controller flies."""

from functools import lru_cache, partial
from types import ModuleType
from typing import Any

import golden_data
import jax
import jax.numpy as jnp
import numpy as np
from helpers import hover_rpm, jit_unoptimized

import jaxdrones
from jaxdrones import Params, State
from jaxdrones.control import Setpoint, for_team

make_step = lru_cache(jaxdrones.make_step)


def one(team: Any, i: int = 0) -> Any:
    """One drone of a team; by NumPy where nothing is traced, as JAX compiles a program for each shape."""
    return jax.tree.map(lambda x: x[i] if isinstance(x, jax.core.Tracer) else jnp.asarray(np.asarray(x)[i]), team)


def team_of(*vehicles: str) -> Params:
    return _loaded_team(vehicles, bool(jax.config.jax_enable_x64))


@lru_cache
def _loaded_team(vehicles: tuple[str, ...], wide: bool) -> Params:
    """A team in the precision at hand, loaded once."""
    return jaxdrones.stack([jaxdrones.load_params(vehicle) for vehicle in vehicles])


def mirrored(params: Params) -> Params:
    """One drone with left and right exchanged: the paper's cf2x."""
    return params.replace(rotor_pos=params.rotor_pos * jnp.array([[1.0, -1.0, 1.0]]))


def recorded_vehicle(case: golden_data.Case) -> Params:
    """The drone that a recorded controller thought it had."""
    params = jaxdrones.load_params(case.about["vehicle"])
    return mirrored(params) if (case.about["variant"], case.about["vehicle"]) == ("paper", "cf2x") else params


def hovering(team: Params, pos=(0.0, 0.0, 1.0)) -> State:
    """Level and at rest, with the rotors at hover speed."""
    n = len(team.mass)
    state = State.at_rest(np.tile(pos, (n, 1)))
    return state.replace(rpm=jnp.asarray(np.broadcast_to(hover_rpm(team), (n, 4))))


def at(n: int, pos, **rest) -> Setpoint:
    """The same setpoint for n drones."""
    zero = np.zeros(3)
    fields = {"pos": pos, "vel": zero, "acc": zero, "yaw": 0.0, "omega": zero} | rest
    fields = {name: np.asarray(value, float) for name, value in fields.items()}
    return Setpoint(**{name: np.broadcast_to(value, (n, *value.shape)) for name, value in fields.items()})


def always(target: Any, length: int) -> Any:
    """The same target at every control step."""
    return jax.tree.map(lambda x: np.broadcast_to(x, (length, *np.shape(x))), target)


def control_team(control, gains, team: Params, memory: Any, state: State, target: Any, *, dt: float):
    """One call of a controller for each drone."""
    return jax.vmap(partial(control, dt=dt), (None, 0, 0, 0, 0))(gains, team, memory, state, target)


@partial(jit_unoptimized, static_argnames=("control", "control_hz"))
def fly(control, gains, team: Params, state: State, memory: Any, targets: Any, *, control_hz: int) -> State:
    """The states after every control step at 240 physics steps per second.

    The rotors are instant, so their speeds are what was commanded.

    Args:
        control: of one drone.
        gains: of the controller.
        team: n drones.
        state: of the team, at the start.
        memory: of the controller, with a leading drone axis.
        targets: what the controller is given, arrays (length, n, ...).
        control_hz: calls per second, a divisor of 240.
    """
    step = make_step(dt=1 / 240, substeps=240 // control_hz)

    def of_team(team, memory, state, k):
        target = jax.tree.map(lambda x: x[k], targets)
        return control_team(control, gains, team, memory, state, target, dt=1 / control_hz)

    return jaxdrones.rollout(step, of_team, team, state, memory, len(jax.tree.leaves(targets)[0]))[1]


def distance(flown: State, pos) -> np.ndarray:
    """From a place (or one per control step), m: (length, n)."""
    return np.linalg.norm(np.asarray(flown.pos) - np.asarray(pos), axis=-1)


def reaches(
    controller: ModuleType, vehicles, target, seconds: int, hz: int, start=None, memory=None, **constants
) -> np.ndarray:
    """Distance from a fixed target, m, after each control step of a flight that starts in hover: (length, n).

    `constants` are parameters that replace those of every vehicle.
    """
    n = len(vehicles)
    team = team_of(*vehicles)
    team = team.replace(**{name: jnp.full_like(getattr(team, name), value) for name, value in constants.items()})
    start = hovering(team) if start is None else start
    memory = for_team(controller.init(), n) if memory is None else memory
    targets = always(at(n, target), seconds * hz)
    flown = fly(controller.control, controller.gains(), team, start, memory, targets, control_hz=hz)
    return distance(flown, target)
