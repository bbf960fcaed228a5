"""The tasks of gym-pybullet-drones (2021), and those of version 2.x (`hover_2x`, `multi_hover`).

Rewards, terminations, truncations and starts are those of gym-pybullet-drones. It reads its clock before the step:
rewards that follow a moving target lag one control step behind, and an episode of T seconds has two steps more than
T / dt.
"""

import dataclasses
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.checks import check_keywords, check_whole
from jaxdrones.control import Setpoint
from jaxdrones.params import Params
from jaxdrones.quantity import described
from jaxdrones.state import State
from jaxdrones.tasks.starts import hovering, on_diagonal
from jaxdrones.tasks.task import Task, World, distance, square

_DURATION_2021, _DURATION_2X = 5.0, 8.0  # s
_SOLVED = 0.05  # m, at the end of an episode
_TUNE_RATE = 0.288  # rad/s: 0.006 rad per control step at 48 Hz
_TILT = 0.4  # rad of roll or pitch, at which (2.x) truncates the episode

Starts = Float[Array, "n 3"]
"""Where the drones started, m: the variables of all tasks here."""
Target = Callable[[Starts, Array], Setpoint]
Cost = Callable[[Float[Array, "n 3"], World], Float[Array, " n"]]
"""(target positions, world after a step) -> the negative reward of every drone."""


@check_keywords
def hover(drones: int = 1) -> Task:
    """Equation 12: the negative squared distance from (0, 0, 1)."""
    return _task_2021("hover-2021", "hover at z = 1 m (equation 12)", drones, _at(0.0, 0.0, 1.0), _squared_distance)


@check_keywords
def takeoff(drones: int = 1) -> Task:
    """Get off the ground: -5 below 2 cm, else -1 / (10 z)."""

    def cost(target, world):
        """5 below 2 cm of height, else 1 / (10 z)."""
        z = world.drones.pos[:, 2]
        low = z < 0.02
        return jnp.where(low, 5, 1 / (10 * jnp.where(low, 1, z)))

    return _task_2021("takeoff", "climb from the ground", drones, _at(0.0, 0.0, 1.0), cost)


@check_keywords
def fly_through_gate(drones: int = 1) -> Task:
    """Follow a point that moves through the gate at (0, -1, 0.75) in the five seconds of an episode."""

    def target(starts, t):
        """A point that moves through the gate."""
        zero = jnp.zeros_like(t)
        speed = -2 / _DURATION_2021
        return _everywhere(starts, [zero, speed * t, zero + 0.75], vel=[zero, zero + speed, zero])

    def cost(target, world):
        """Ten times the squared distance from the target, m^2."""
        return 10 * _squared_distance(target, world)

    return _task_2021("fly-through-gate", "fly through the gate at y = -1 m", drones, target, cost)


@check_keywords
def tune(drones: int = 1) -> Task:
    """Find the six gain vectors of the PID that follow y = 4 cos(0.288 t), z = 1 m.

    As in gym-pybullet-drones (2021), the target velocity is a difference over the last 1/48 s.
    """

    def y(t):
        return 4 * jnp.cos(_TUNE_RATE * t)

    def target(starts, t):
        """A point that swings along y at a height of 1 m."""
        zero = jnp.zeros_like(t)
        return _everywhere(starts, [zero, y(t), zero + 1], vel=[zero, 48 * (y(t) - y(t - 1 / 48)), zero])

    summary = "tune the gains of the PID in flight"
    return _task_2021("tune", summary, drones, target, _squared_distance, action="pid_gains")


@check_keywords
def leader_follower(drones: int = 2) -> Task:
    """Equation 13: the leader, drone 0, hovers at (0, 0, 0.5); the others are to be as high as the leader."""

    def cost(target, world):
        """Leader: squared distance from its target, m^2; others: squared height over the leader over n, m^2."""
        pos = world.drones.pos
        follower = (pos[:, 2] - pos[0, 2]) ** 2 / len(pos)
        return _first_then(_squared_distance(target, world), follower)

    summary = "follow the leader's height (equation 13)"
    return _task_2021("leader-follower", summary, drones, _at_height(0.5), cost, minimum=2)


@check_keywords
def flock(drones: int = 2) -> Task:
    """The first drone hovers at (0, 0, 1); every other one is to be as high as the one before it."""

    def cost(target, world):
        """First drone: squared distance from its target, m^2; others: squared height over the drone before, m^2."""
        pos = world.drones.pos
        return _first_then(_squared_distance(target, world), (jnp.roll(pos, 1, 0) - pos)[:, 2] ** 2)

    return _task_2021("flock", "fly at the height of the drone before", drones, _at_height(1.0), cost, minimum=2)


@check_keywords
def meetup(drones: int = 2) -> Task:
    """Drone i and drone n - 1 - i meet; the reward is the negative squared distance between them."""

    def target(starts, t):
        """Half-way between the starts of the drone and its partner."""
        return Setpoint.at((starts + starts[::-1]) / 2)

    def cost(target, world):
        """Squared distance from the partner, m^2."""
        return square(world.drones.pos - world.drones.pos[::-1])

    task = _task_2021("meetup", "meet the partner half-way", drones, target, cost, action="velocity", minimum=2)
    return dataclasses.replace(task, contact=("ground", "drones"))


@check_keywords
def hover_2x(drones: int = 1) -> Task:
    """Hover at (0, 0, 1), rewarded by max(0, 2 - d^4)."""
    return _task_2x("hover-2x", "hover at z = 1 m, bounded reward", drones, _at(0.0, 0.0, 1.0), box=1.5)


@check_keywords
def multi_hover(drones: int = 2) -> Task:
    """Drone i hovers 1 / (i + 1) m above its start; the reward of (2.x) is the sum over the team."""

    def target(starts, t):
        """Above the start of the drone, the first one highest."""
        return Setpoint.at(starts.at[:, 2].add(1 / (1 + jnp.arange(len(starts), dtype=starts.dtype))))

    return _task_2x("multi-hover", "every drone hovers at a height of its own", drones, target, box=2.0)


def _task_2021(
    name: str, summary: str, drones: int, target: Target, cost: Cost, action: str = "one_d_rpm", minimum: int = 1
) -> Task:
    check_whole(f"number of drones of {name}", drones, minimum)

    def late_cost(task: Task, world: World) -> Float[Array, " n"]:
        """The cost after the step from the target before it."""
        return cost(task.target(world.variables, world.time - world.dt).pos, world)

    return Task(
        name=name,
        summary=summary,
        drones=drones,
        duration=_DURATION_2021,
        start=_start,
        target=target,
        rewards={"cost": (-1.0, described(cost.__doc__ or "", late_cost))},
        success=_close_at_the_end,
        contact=("ground",),
        action=action,
        observation=("normalized_kinematics",),
        control_hz=48.0,
        extra_steps=2,
    )


def _task_2x(name: str, summary: str, drones: int, target: Target, box: float) -> Task:
    check_whole(f"number of drones of {name}", drones)

    def closeness(task: Task, world: World) -> Float[Array, " n"]:
        """The larger of 0 and 2 - d^4, with d the distance from the target, m."""
        return jnp.maximum(0, 2 - distance(task, world) ** 4)

    def arrived(task: Task, world: World):
        """The distances of all drones from their targets are 0.1 mm in sum or less."""
        return jnp.broadcast_to(jnp.sum(distance(task, world)) < 1e-4, len(world.drones.pos))

    def out_of_box(task: Task, world: World):
        """A drone is outside the box about the origin, or above 2 m."""
        x, y, z = world.drones.pos.T
        return (jnp.abs(x) > box) | (jnp.abs(y) > box) | (z > 2.0)

    def tilted(task: Task, world: World):
        """A drone rolls or pitches by more than 0.4 rad."""
        roll, pitch, _ = jax.vmap(rotation.to_rpy)(world.drones.quat).T
        return (jnp.abs(roll) > _TILT) | (jnp.abs(pitch) > _TILT)

    return Task(
        name=name,
        summary=summary,
        drones=drones,
        duration=_DURATION_2X,
        start=_start,
        target=target,
        rewards={"closeness": (1.0, closeness)},
        terminations={"arrived": arrived},
        truncations={"out_of_box": out_of_box, "tilted": tilted},
        success=_close_at_the_end,
        contact=("ground",),
        action="one_d_rpm",
        observation=("kinematics_2x", "last_actions_2x"),
        control_hz=30.0,
        substeps=8,
        extra_steps=2,
    )


def _start(key: jax.Array, params: Params) -> tuple[State, Starts]:
    """On a diagonal, 0.1 m above the ground, with the rotors standing still."""
    pos = on_diagonal(params)
    return hovering(params, pos).replace(rpm=jnp.zeros((len(pos), 4), pos.dtype)), pos


def _at(x: float, y: float, z: float) -> Target:
    return described(
        f"The point ({x:g}, {y:g}, {z:g}) m.",
        lambda starts, t: Setpoint.at(jnp.broadcast_to(jnp.array([x, y, z], starts.dtype), starts.shape)),
    )


def _at_height(z: float) -> Target:
    """The target of every drone is above its start, that of the first one above the origin."""
    return described(
        f"At a height of {z:g} m: the first drone over the origin, the others over their starts.",
        lambda starts, t: Setpoint.at(starts.at[:, 2].set(z).at[0, :2].set(0)),
    )


def _everywhere(starts: Starts, pos: list[Array], vel: list[Array]) -> Setpoint:
    """The same target for every drone."""
    at, moving = (jnp.broadcast_to(jnp.stack(v).astype(starts.dtype), starts.shape) for v in (pos, vel))
    return Setpoint.at(at, vel=moving)


def _squared_distance(target: Float[Array, "n 3"], world: World) -> Float[Array, " n"]:
    """Squared distance from the target, m^2."""
    return square(target - world.drones.pos)


def _first_then(first: Float[Array, " n"], rest: Float[Array, " n"]) -> Float[Array, " n"]:
    return jnp.concatenate([first[:1], rest[1:]])


def _close_at_the_end(metrics: Mapping[str, Array], dt: float) -> Array:
    """Whether a drone was within 5 cm of its target in the end."""
    return metrics["error"][-1] < _SOLVED
