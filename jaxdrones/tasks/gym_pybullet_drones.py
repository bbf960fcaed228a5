"""Tasks of gym-pybullet-drones (2021), and those of version 2.x (`hover_2x`, `multi_hover`).

Rewards, terminations, truncations and starts are those of gym-pybullet-drones, which reads the time before a step:
rewards for a moving target lag one control step behind, and an episode of T seconds has two steps more than T / dt.

gym-pybullet-drones has no criteria of success and one fixed start for each task. With `start_spread` (m, at most 0.5)
every drone starts up to that much higher or lower, but above the ground; most of these tasks command one speed for all
rotors, which does not move a drone sideways.
"""

import dataclasses
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.arguments import checked
from jaxdrones.control import Setpoint
from jaxdrones.quantity import described
from jaxdrones.tasks.starts import above_ground
from jaxdrones.tasks.task import Task, Team, Term, World, distance, norm, square

_DURATION_2021, _DURATION_2X = 5.0, 8.0  # s
_SOLVED = 0.05  # m, at the end of an episode
_TUNE_RATE = 0.288  # rad/s: 0.006 rad per control step at 48 Hz
_OFF_GROUND = 1.0  # m
_NEAR_PARTNER = 0.05  # m between the hulls
_TILT = 0.4  # rad of roll or pitch, at which (2.x) truncates the episode

Starts = Float[Array, "n 3"]
"""Initial positions, m: the variables of all tasks here."""
Target = Callable[[Starts, Array], Setpoint]
Cost = Callable[[Float[Array, "n 3"], World], Float[Array, " n"]]
"""(target positions, world after a step) -> negative reward of every drone."""
Criterion = Callable[[Mapping[str, Array], float], Array]


def hover(drones: int = 1, start_spread: float = 0.0) -> Task:
    """Hover at z = 1 m, rewarded by the negative squared distance from (0, 0, 1) (equation 12)."""
    summary, success = "hover at z = 1 m (equation 12)", _of_one(drones)
    return _task_2021("hover-2021", summary, drones, start_spread, _at(0.0, 0.0, 1.0), _squared_distance, success)


def takeoff(drones: int = 1, start_spread: float = 0.0) -> Task:
    """Take off: reward -5 below 2 cm, else -1 / (10 z)."""

    def cost(target, world):
        """5 below 2 cm of height, else 1 / (10 z)."""
        z = world.drones.pos[:, 2]
        low = z < 0.02
        return jnp.where(low, 5, 1 / (10 * jnp.where(low, 1, z)))

    summary, target, metrics = "climb from the ground", _at(0.0, 0.0, 1.0), {"height": _height}
    return _task_2021("takeoff", summary, drones, start_spread, target, cost, _high, metrics=metrics)


def fly_through_gate(drones: int = 1, start_spread: float = 0.0) -> Task:
    """Follow a point that moves through the gate at (0, -1, 0.75) in the five seconds of an episode.

    There is no criterion of success: the default action, one speed for all rotors, does not move a drone sideways.
    """

    def target(starts, t):
        """Moving point through the gate."""
        zero = jnp.zeros_like(t)
        speed = -2 / _DURATION_2021
        return _everywhere(starts, [zero, speed * t, zero + 0.75], vel=[zero, zero + speed, zero])

    def cost(target, world):
        """Ten times the squared distance from the target, m^2."""
        return 10 * _squared_distance(target, world)

    summary = "fly through the gate at y = -1 m"
    return _task_2021("fly-through-gate", summary, drones, start_spread, target, cost, None)


def tune(drones: int = 1, start_spread: float = 0.0) -> Task:
    """Tune the six gain vectors of the PID to track y = 4 cos(0.288 t), z = 1 m.

    As in gym-pybullet-drones (2021), the target velocity is a difference over the last 1/48 s.
    """

    def y(t):
        return 4 * jnp.cos(_TUNE_RATE * t)

    def target(starts, t):
        """Point oscillating along y at a height of 1 m."""
        zero = jnp.zeros_like(t)
        return _everywhere(starts, [zero, y(t), zero + 1], vel=[zero, 48 * (y(t) - y(t - 1 / 48)), zero])

    summary = "tune the gains of the PID in flight"
    task = _task_2021("tune", summary, drones, start_spread, target, _squared_distance, _of_one(drones))
    return dataclasses.replace(task, action="pid_gains")


@checked
def leader_follower(drones: Team = 2, start_spread: float = 0.0) -> Task:
    """Leader, drone 0, hovers at (0, 0, 0.5); the others match its height (equation 13)."""

    def cost(target, world):
        """Leader: squared distance from its target, m^2; others: squared height over the leader over n, m^2."""
        pos = world.drones.pos
        follower = (pos[:, 2] - pos[0, 2]) ** 2 / len(pos)
        return follower.at[0].set(_squared_distance(target, world)[0])

    summary = "follow the leader's height (equation 13)"
    return _task_2021("leader-follower", summary, drones, start_spread, _at_height(0.5), cost)


@checked
def flock(drones: Team = 2, start_spread: float = 0.0) -> Task:
    """First drone hovers at (0, 0, 1); every other one matches the height of the previous one."""

    def cost(target, world):
        """First drone: squared distance from its target, m^2; others: squared height over the previous drone, m^2."""
        pos = world.drones.pos
        follower = (jnp.roll(pos, 1, 0) - pos)[:, 2] ** 2
        return follower.at[0].set(_squared_distance(target, world)[0])

    summary = "fly at the height of the previous drone"
    return _task_2021("flock", summary, drones, start_spread, _at_height(1.0), cost)


@checked
def meetup(drones: Team = 2, start_spread: float = 0.0) -> Task:
    """Drones i and n - 1 - i meet; the reward is the negative squared distance between them."""

    def target(starts, t):
        """Midpoint between the starts of the drone and its partner."""
        return Setpoint.at((starts + starts[::-1]) / 2)

    def cost(target, world):
        """Squared distance from the partner, m^2."""
        return square(world.drones.pos - world.drones.pos[::-1])

    more = {"gap": _gap_to_partner}
    task = _task_2021("meetup", "meet the partner half-way", drones, start_spread, target, cost, _met, more)
    return dataclasses.replace(task, action="velocity", contact=("ground", "drones"))


def hover_2x(drones: int = 1, start_spread: float = 0.0) -> Task:
    """Hover at (0, 0, 1), rewarded by max(0, 2 - d^4)."""
    target, success = _at(0.0, 0.0, 1.0), _of_one(drones)
    return _task_2x("hover-2x", "hover at z = 1 m, bounded reward", drones, start_spread, target, 1.5, success)


def multi_hover(drones: int = 2, start_spread: float = 0.0) -> Task:
    """Drone i hovers 1 / (i + 1) m above its start; the reward of (2.x) is the sum over the team."""

    def target(starts, t):
        """Above the start of the drone, the first one highest."""
        return Setpoint.at(starts.at[:, 2].add(1 / (1 + jnp.arange(len(starts), dtype=starts.dtype))))

    summary = "every drone hovers at a different height"
    return _task_2x("multi-hover", summary, drones, start_spread, target, 2.0, _close_at_the_end)


def _close_at_the_end(metrics: Mapping[str, Array], dt: float) -> Array:
    """Whether a drone was within 5 cm of its target in the end."""
    return metrics["error"][-1] < _SOLVED


def _task_2021(
    name: str,
    summary: str,
    drones: int,
    start_spread: float,
    target: Target,
    cost: Cost,
    success: Criterion | None = _close_at_the_end,
    metrics: Mapping[str, Term] | None = None,
) -> Task:
    def late_cost(task: Task, world: World) -> Float[Array, " n"]:
        """Cost after the step with respect to the target before it."""
        return cost(task.target(world.variables, world.time - world.dt).pos, world)

    return Task(
        name=name,
        summary=summary,
        drones=drones,
        duration=_DURATION_2021,
        start=above_ground(start_spread),
        target=target,
        rewards={"cost": (-1.0, described(cost.__doc__ or "", late_cost))},
        success=success,
        metrics=metrics or {},
        contact=("ground",),
        action="one_d_rpm",
        observation=("normalized_kinematics",),
        control_hz=48.0,
        extra_steps=2,
    )


def _task_2x(
    name: str, summary: str, drones: int, start_spread: float, target: Target, box: float, success: Criterion | None
) -> Task:
    def closeness(task: Task, world: World) -> Float[Array, " n"]:
        """Maximum of 0 and 2 - d^4, with d the distance from the target, m."""
        return jnp.maximum(0, 2 - distance(task, world) ** 4)

    def arrived(task: Task, world: World):
        """The sum of all drones' distances from their targets is at most 0.1 mm."""
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
        start=above_ground(start_spread),
        target=target,
        rewards={"closeness": (1.0, closeness)},
        terminations={"arrived": arrived},
        truncations={"out_of_box": out_of_box, "tilted": tilted},
        success=success,
        success_terminations=("arrived",),
        contact=("ground",),
        action="one_d_rpm",
        observation=("kinematics_2x", "last_actions_2x"),
        control_hz=30.0,
        substeps=8,
        extra_steps=2,
    )


def _at(x: float, y: float, z: float) -> Target:
    return described(
        f"The point ({x:g}, {y:g}, {z:g}) m.",
        lambda starts, t: Setpoint.at(jnp.broadcast_to(jnp.array([x, y, z], starts.dtype), starts.shape)),
    )


def _at_height(z: float) -> Target:
    """Target above the start of each drone, above the origin for the first."""
    return described(
        f"At a height of {z:g} m: the first drone over the origin, the others over their starts.",
        lambda starts, t: Setpoint.at(starts.at[:, 2].set(z).at[0, :2].set(0)),
    )


def _everywhere(starts: Starts, pos: list[Array], vel: list[Array]) -> Setpoint:
    """Common target of all drones."""
    at, moving = (jnp.broadcast_to(jnp.stack(v).astype(starts.dtype), starts.shape) for v in (pos, vel))
    return Setpoint.at(at, vel=moving)


def _squared_distance(target: Float[Array, "n 3"], world: World) -> Float[Array, " n"]:
    """Squared distance from the target, m^2."""
    return square(target - world.drones.pos)


def _of_one(drones: int) -> Criterion | None:
    """Criterion of success of tasks with one common target, for single drones only."""
    return _close_at_the_end if drones == 1 else None


def _height(task: Task, world: World) -> Float[Array, " n"]:
    """Height above the ground, m."""
    return world.drones.pos[:, 2]


def _high(metrics: Mapping[str, Array], dt: float) -> Array:
    """Whether a drone was 1 m or more above the ground in the end."""
    return metrics["height"][-1] >= _OFF_GROUND


def _gap_to_partner(task: Task, world: World) -> Float[Array, " n"]:
    """Distance from the partner's center less both collision radii, m."""
    radius = world.params.collision_radius
    return norm(world.drones.pos - world.drones.pos[::-1]) - radius - radius[::-1]


def _met(metrics: Mapping[str, Array], dt: float) -> Array:
    """Whether the gap to the partner was at most 5 cm in the end."""
    return metrics["gap"][-1] < _NEAR_PARTNER
