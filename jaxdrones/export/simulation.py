"""Simulation of drones in a web page: physics, controllers and a policy as JavaScript, without a server."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.arguments import checked, whole
from jaxdrones.control import CONTROLLERS, Setpoint
from jaxdrones.dynamics.aero import drag
from jaxdrones.dynamics.contact import ground_contact
from jaxdrones.dynamics.rotors import instant_rotors
from jaxdrones.engine.explicit import make_step
from jaxdrones.engine.step import HostStep
from jaxdrones.envs import Env, episode
from jaxdrones.envs.observations import observe
from jaxdrones.errors import UserError
from jaxdrones.export.equations import javascript
from jaxdrones.flights.log import FlightLog
from jaxdrones.learning.networks import Policy, initial_hidden_state
from jaxdrones.params import Params, repeat
from jaxdrones.rotation import rotate_inverse
from jaxdrones.state import State
from jaxdrones.visualization.viewer.page import Page
from jaxdrones.visualization.viewer.payload import encode
from jaxdrones.wrench import Wrench

_CONTROLLERS = {"cf2": ("pid", "geometric", "mellinger"), "": ("geometric",)}
"""Beginning of a vehicle's name -> controllers whose gains fit."""
_HZ = 240  # rate of the controllers
_START = 1.0  # m, height
_SPACING = 0.6  # m, between goals
_SPAN = 20.0  # s of flight until the plots start anew
_ROWS = 1100  # somewhat more than the page adds until then


@dataclasses.dataclass(frozen=True)
class Pilot:
    """Policy or controller in a page."""

    name: str
    """Name of its JavaScript function."""
    period: int
    """Physics steps from one command to the next."""
    gains: list[float]
    memory: list[float]
    """Memory at the start of a flight."""


@dataclasses.dataclass(frozen=True)
class Simulation:
    """JavaScript of a simulation, and the numbers that it starts from.

    The functions write into the array `out`: `physics(out, state, rpm, wind, mass, push)` the state after a step, and a
    pilot, for example `pid(out, gains, memory, state, goal)`, its new memory and rotor speeds. States are position,
    attitude, velocity, body rates and rotor speeds, in the units of `State`.
    """

    script: str
    pilots: tuple[Pilot, ...]
    """The policy first."""
    state: list[float]
    """First state of a drone whose goal is the first."""
    goals: list[list[float]]
    """Places to hover at, a drone each, m, world."""
    mass: float
    """kg"""
    dt: float
    """Physics step, s."""


@checked
def simulation(policy: Policy, env: Env, drones: Annotated[int, whole("number of drones")] = 1) -> Simulation:
    """Simulation of the nominal vehicle of an environment, which a policy or controllers fly to a target.

    The physics are a rigid body with instant rotors, drag and the ground, in a wind (m/s), with any mass (kg), and an
    external force (N, world), without the noise and the disturbances of the environment. The drones do not interact;
    each flies to its own goal.

    Raises:
        ValueError: a team, images, sensors, a load or another model, a delay, other rotors, a target that moves, or a
            policy with memory.
        ImportError: without casadi (extra `casadi`).
    """
    _check(policy, env)
    params = jax.tree.map(lambda x: x[0], env.params)
    dt, zero = env.physics.dt, jnp.zeros(3)
    goals = _grid(drones)
    start = State.at_rest(jnp.asarray(goals[:1]))
    state = jax.tree.map(lambda x: x[0], start).replace(rpm=jnp.full(4, params.hover_rpm))
    inputs: dict[str, Any] = {"state": state, "rpm": state.rpm, "wind": zero, "mass": params.mass, "push": zero}
    parts, pilots = [javascript("physics", _physics(params, dt), **inputs)], []

    def add(name: str, fly: Callable, period: int, gains: Any, memory: Any) -> None:
        parts.append(javascript(name, fly, gains=gains, memory=memory, state=state, goal=zero))
        pilots.append(Pilot(name, period, _numbers(gains), _numbers(memory)))

    add("policy", *_policy(policy, env))
    period = max(1, round(1 / (_HZ * dt)))
    for name in next(names for beginning, names in _CONTROLLERS.items() if env.vehicle.startswith(beginning)):
        controller = CONTROLLERS[name]
        add(name, _controller(name, params, period * dt), period, controller.gains(), controller.init())
    return Simulation("\n\n".join(parts), tuple(pilots), _numbers(state), goals.tolist(), float(params.mass), float(dt))


def page(policy: Policy, env: Env, title: str, drones: int = 1) -> Page:
    """Page with an interactive simulation of drones under a policy; arguments and errors as for `simulation`."""
    made = simulation(policy, env, drones)
    one = jax.tree.map(lambda x: x[0], env.params)
    params = jax.tree.map(np.asarray, jax.device_get(repeat(one, drones)))
    state = np.tile(made.state, (1, drones, 1))
    goals = np.array([made.goals])
    _, quat, vel, omega, rpm = np.split(state, (3, 7, 10, 13), axis=2)
    labels = (env.vehicle,) if drones == 1 else tuple(f"drone {i}" for i in range(drones))
    record = FlightLog(np.zeros(1), goals, quat, vel, omega, rpm, target_pos=goals, params=params, labels=labels)
    live = {"running": True, "rows": _ROWS, "end": _SPAN}
    about = dataclasses.asdict(made) | {"span": _SPAN}
    return Page(title, encode([record], [title], title, layout="alone", live=live, simulation=about))


def _grid(drones: int) -> np.ndarray:
    """(drones, 3) places of a square grid about the origin, m, world."""
    side = math.ceil(math.sqrt(drones))
    x, y = np.divmod(np.arange(drones), side)
    places = np.stack([_SPACING * x, _SPACING * y, np.full(drones, _START)], axis=-1)
    return places - [places[:, 0].mean(), places[:, 1].mean(), 0.0]


def _check(policy: Policy, env: Env) -> None:
    reasons = {
        "it flies a team": env.drones > 1,
        "it observes images or sensors": bool(env.vision or env.sensors),
        "its commands are delayed": env.delay_steps[1] > 0,
        "it has a memory": bool(jax.tree.leaves(initial_hidden_state(policy, 1))),
        "the backend is Bullet": isinstance(env.physics, HostStep),
        "its rotors are not instant": env.physics.physics.rotors is not instant_rotors,
        "it has a load or another model with a state": bool(env.physics.physics.models),
    }
    if not any(reasons.values()):
        reasons["its target moves"] = bool(jax.jit(functools.partial(_target_moves, env))(jax.random.key(0)))
    if found := [reason for reason, holds in reasons.items() if holds]:
        raise UserError(f"the page cannot fly this policy: {', '.join(found)}; give the policy of hover, for example")


def _target_moves(env: Env, key: jax.Array) -> Array:
    """Whether the target of a task depends on time, or is another one after a drone has flown to it or through it."""
    _, world = env.reset(key)
    first = env.task.target_now(world).pos

    def at(steps: Array) -> Array:
        return env.task.target_now(world.replace(step=world.step + steps)).pos

    places = [jax.vmap(at)(jnp.arange(1, env.steps + 1))]
    for sign, axis in [(0, 0), *itertools.product((1, -1), range(3))]:
        direction, flown = jnp.zeros_like(first).at[:, axis].set(sign), world
        for pos in (first - direction, first + direction):
            flown = flown.replace(drones=flown.drones.replace(pos=pos))
            flown = flown.replace(variables=env.task.advance(env.task, flown))
            places.append(env.task.target_now(flown).pos[None])
    return jnp.any(jnp.concatenate(places) != first[None])


def _numbers(tree: Any) -> list[float]:
    return [float(x) for leaf in jax.tree.leaves(tree) for x in np.ravel(leaf)]


def _physics(params: Params, dt: float) -> Callable[..., State]:
    def step(state: State, rpm: Array, wind: Array, mass: Array, push: Array) -> State:
        loaded = params.replace(wind=wind, mass=mass, inertia=params.inertia * (mass / params.mass))

        def pushed(params: Params, state: State) -> Wrench:
            return Wrench.of_force(rotate_inverse(state.quat, push))

        one = make_step((drag, ground_contact, pushed), dt=dt)
        team, drones = jax.tree.map(lambda x: x[None], (loaded, state))
        return jax.tree.map(lambda x: x[0], one(team, drones, rpm[None]))

    return step


def _controller(name: str, params: Params, dt: float) -> Callable[..., tuple[Any, Array]]:
    def fly(gains: Any, memory: Any, state: State, goal: Float[Array, "3"]) -> tuple[Any, Array]:
        return CONTROLLERS[name].control(gains, params, memory, state, Setpoint.at(goal), dt=dt)

    return fly


def _policy(policy: Policy, env: Env) -> tuple[Callable, int, Any, Any]:
    """Arguments of a pilot: a policy in the world of an episode, whose target takes the place of the goal.

    Its memory are the latest actions, which it may observe, and the memory of the action type.
    """
    _, world = env.reset(jax.random.key(0))
    target, calm = env.task.target_now(world).pos[0], dataclasses.replace(env, disturbance=None)

    def fly(gains: Any, memory: Any, state: State, goal: Float[Array, "3"]) -> tuple[Any, Array]:
        actions, of_action_type = memory
        drones = jax.tree.map(lambda x: x[None], state)
        drones = drones.replace(pos=(state.pos - goal + target)[None])
        seen = world.replace(drones=drones, actions=actions, memory=of_action_type)
        after, rpm = episode.command(calm, None, seen, policy(observe(env.terms, env.task, seen)))
        return (after.actions, after.memory), rpm[0]

    return fly, env.physics.substeps, (), (world.actions, world.memory)
