"""Observation terms by name, each with a bound; an observation is their concatenation.

`kinematics` is equation 7 of Panerati et al. 2021, `adjacency` equation 8; images (equation 9) are in `vision`.
"""

import dataclasses
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.envs.surroundings import adjacency, encounters, neighbors, obstacles
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.quantity import Quantity, quantities
from jaxdrones.tasks.task import ObservationTerm, Task, World, norm

_MAX_DISTANCE, _MAX_SPEED, _MAX_RATE = 20.0, 30.0, 100.0  # m, m/s, rad/s: bounds of the observations
_MAX_RPM = 1e5
_UNIT = 1.0 + 1e-6


def position(task: Task, world: World) -> Array:
    """Position, m, world."""
    return world.drones.pos


def position_error(task: Task, world: World) -> Array:
    """Vector from the drone to its target, m, world axes."""
    return task.target_now(world).pos - world.drones.pos


def position_error_body(task: Task, world: World) -> Array:
    """Vector from the drone to its target, m, body axes."""
    return _to_body(world, position_error(task, world))


def velocity(task: Task, world: World) -> Array:
    """Velocity, m/s, world."""
    return world.drones.vel


def velocity_body(task: Task, world: World) -> Array:
    """Velocity, m/s, body axes."""
    return _to_body(world, world.drones.vel)


def velocity_error(task: Task, world: World) -> Array:
    """Velocity of the target relative to the drone, m/s, world axes."""
    return task.target_now(world).vel - world.drones.vel


def quaternion(task: Task, world: World) -> Array:
    """Attitude (x, y, z, w), with w >= 0."""
    quat = world.drones.quat
    return jnp.where(quat[:, 3:] < 0, -quat, quat)


def rpy(task: Task, world: World) -> Array:
    """Roll, pitch, yaw, rad."""
    return jax.vmap(rotation.to_rpy)(world.drones.quat)


def rotation_matrix(task: Task, world: World) -> Array:
    """Attitude as a matrix, body to world, row by row."""
    return jnp.reshape(jax.vmap(rotation.to_matrix)(world.drones.quat), (-1, 9))


def gravity(task: Task, world: World) -> Array:
    """Direction of gravity in body axes: the attitude without the heading."""
    return -jax.vmap(lambda quat: rotation.to_matrix(quat)[2])(world.drones.quat)


def omega(task: Task, world: World) -> Array:
    """Angular velocity, rad/s, body."""
    return world.drones.omega


def omega_world(task: Task, world: World) -> Array:
    """Angular velocity, rad/s, world axes, as in gym-pybullet-drones."""
    return jax.vmap(rotation.rotate)(world.drones.quat, world.drones.omega)


def rotor_speed(task: Task, world: World) -> Array:
    """Rotor speeds as fractions of the highest."""
    return world.drones.rpm / world.params.max_rpm[:, None]


def kinematics(task: Task, world: World) -> Array:
    """Equation 7: position, quaternion, roll-pitch-yaw, velocity, angular velocity (world), rotor speeds (RPM)."""
    drones = world.drones
    return jnp.concatenate(
        [drones.pos, drones.quat, rpy(task, world), drones.vel, omega_world(task, world), drones.rpm], -1
    )


def kinematics_2x(task: Task, world: World) -> Array:
    """Position, roll-pitch-yaw, velocity, angular velocity (world): observation of gym-pybullet-drones (2.x)."""
    drones = world.drones
    return jnp.concatenate([drones.pos, rpy(task, world), drones.vel, omega_world(task, world)], -1)


def normalized_kinematics(task: Task, world: World) -> Array:
    """Twelve numbers in [-1, 1]: observation of gym-pybullet-drones (2021).

    As there, vz is clipped at 1 m/s but divided by 3, and only the direction of the angular velocity is observed.
    """
    x, y, z = world.drones.pos.T
    vx, vy, vz = world.drones.vel.T
    roll, pitch, yaw = rpy(task, world).T / jnp.pi
    turn = omega_world(task, world)
    speed = norm(turn)
    place = [jnp.clip(x, -15, 15) / 15, jnp.clip(y, -15, 15) / 15, jnp.clip(z, 0, 5) / 5]
    motion = [jnp.clip(vx, -3, 3) / 3, jnp.clip(vy, -3, 3) / 3, jnp.clip(vz, -1, 1) / 3]
    columns = jnp.stack([*place, roll, pitch, yaw, *motion], axis=-1)
    turns = speed > jnp.finfo(speed.dtype).eps ** 0.5  # rad/s: below, the direction would be rounding noise
    return jnp.concatenate([columns, turn * (turns / jnp.where(turns, speed, 1))[:, None]], -1)


def last_actions(count: int) -> ObservationTerm:
    """Observation term of the last actions, oldest first."""

    def observe(task: Task, world: World) -> Array:
        """Last actions, oldest first."""
        return jnp.reshape(world.actions[:, -count:], (len(world.actions), -1))

    def entries(drones: int, action: tuple[Quantity, ...]) -> tuple[Quantity, ...]:
        ages = ["last action"] if count == 1 else [f"action {count - i} steps ago" for i in range(count)]
        return tuple(dataclasses.replace(entry, name=f"{age}: {entry.name}") for age in ages for entry in action)

    return ObservationTerm(observe, _UNIT, history=count, entries=entries, name=f"last_actions({count})")


def reading(sensor: str, bound: float = math.inf, entries: tuple[Quantity, ...] = ()) -> ObservationTerm:
    """Observation term of the latest reading of a sensor, flattened; `entries` describe it."""

    def observe(task: Task, world: World) -> Array:
        """Latest reading of a sensor."""
        n = len(world.drones.pos)
        return jnp.concatenate([jnp.reshape(x, (n, -1)) for x in jax.tree.leaves(world.readings[sensor])], axis=-1)

    return ObservationTerm(observe, bound, entries=entries, name=sensor)


def preview(*ahead: float) -> ObservationTerm:
    """Observation term of the target positions `ahead` (s) from now, relative to the drone, m, world axes."""

    def observe(task: Task, world: World) -> Array:
        """Future positions of the target, relative to the drone."""
        later = [task.target(world.variables, world.time + t).pos - world.drones.pos for t in ahead]
        return jnp.concatenate(later, axis=-1)

    entries = [entry for t in ahead for entry in quantities(f"target in {t:g} s, from the drone", "m", "world")]
    return ObservationTerm(observe, _MAX_DISTANCE, entries=tuple(entries), name=f"preview{ahead}")


def observe(terms: Sequence[ObservationTerm], task: Task, world: World) -> Float[Array, "n d"]:
    """Concatenated observation terms, clipped at their bounds."""
    return jnp.concatenate([_clip(term.observe(task, world), term.bound) for term in terms], axis=-1)


def bounds(terms: Sequence[ObservationTerm], widths: Sequence[int]) -> np.ndarray:
    """(d,) largest magnitude of every entry of an observation, given the lengths of its terms."""
    columns = [np.broadcast_to(term.bound, (width,)) for term, width in zip(terms, widths, strict=True)]
    return np.concatenate(columns).astype(np.float32)


class PrivilegedObservation(PyTreeNode):
    """Privileged observation of a team."""

    obs: Array
    """(n, d) observation without noise."""
    params: Array
    """(n, e) relative deviations of the drawn parameters from their nominal values."""


def deviations(params: Params, nominal: Params, drawn: Sequence[bool]) -> Float[Array, "n e"]:
    """Concatenated deviations of the drawn leaves of a team's parameters from their nominal values."""
    n = len(nominal.mass)
    leaves = zip(jax.tree.leaves(params), jax.tree.leaves(nominal), drawn, strict=True)
    columns = [jnp.reshape(_deviation(value, own), (n, -1)) for value, own, is_drawn in leaves if is_drawn]
    return jnp.concatenate([jnp.zeros((n, 0)), *columns], axis=-1)


def _deviation(value: Array, nominal: Array) -> Array:
    largest = jnp.max(jnp.abs(nominal))
    return (value - nominal) / jnp.where(largest > 0, largest, 1)


def _clip(x: Array, bound: float | tuple[float, ...]) -> Array:
    x = x.astype(jnp.result_type(x, 1.0))  # a whole number may have no room for the bound, or for its negative
    limit = jnp.broadcast_to(jnp.asarray(bound, x.dtype), x.shape[-1:])[None]
    return jnp.clip(x, -limit, limit)


def _to_body(world: World, v: Array) -> Array:
    return jax.vmap(rotation.rotate_inverse)(world.drones.quat, v)


_TURN = math.pi + 1e-6
_KINEMATICS = (
    (_MAX_DISTANCE,) * 3 + (_UNIT,) * 4 + (_TURN,) * 3 + (_MAX_SPEED,) * 3 + (_MAX_RATE,) * 3 + (_MAX_RPM,) * 4
)
_KINEMATICS_2X = _KINEMATICS[:3] + _KINEMATICS[7:16]

_POSITION = quantities("position", "m", "world")
_VELOCITY = quantities("velocity", "m/s", "world")
_QUATERNION = quantities("quaternion", "-", "body to world", "xyzw")
_RPY = tuple(Quantity(angle, "rad", "body to world") for angle in ("roll", "pitch", "yaw"))
_MATRIX = tuple(Quantity(f"{b} of body {a} axis", "-", "world") for b in "xyz" for a in "xyz")
_OMEGA_WORLD = quantities("angular velocity", "rad/s", "world")
_RPM = tuple(Quantity(f"speed of rotor {i}", "RPM") for i in range(4))
_NORMALIZED = (
    *quantities("position", "m", "world", "xy", (-15.0, 0.0, 15.0)),
    *quantities("position, seen from 0 to 5 m", "m", "world", "z", (-5.0, 0.0, 5.0)),
    *(dataclasses.replace(angle, values=(-math.pi, 0.0, math.pi)) for angle in _RPY),
    *quantities("velocity", "m/s", "world", "xy", (-3.0, 0.0, 3.0)),
    *quantities("velocity, seen up to 1 m/s", "m/s", "world", "z", (-3.0, 0.0, 3.0)),
    *quantities("direction of the angular velocity", "-", "world"),
)


OBSERVATIONS: dict[str, ObservationTerm] = {
    "position": ObservationTerm(position, _MAX_DISTANCE, entries=_POSITION),
    "position_error": ObservationTerm(
        position_error, _MAX_DISTANCE, entries=quantities("target, from the drone", "m", "world")
    ),
    "position_error_body": ObservationTerm(
        position_error_body, _MAX_DISTANCE * 2, entries=quantities("target, from the drone", "m", "body")
    ),
    "velocity": ObservationTerm(velocity, _MAX_SPEED, entries=_VELOCITY),
    "velocity_body": ObservationTerm(velocity_body, _MAX_SPEED, entries=quantities("velocity", "m/s", "body")),
    "velocity_error": ObservationTerm(
        velocity_error, _MAX_SPEED, entries=quantities("velocity of the target, relative", "m/s", "world")
    ),
    "quaternion": ObservationTerm(quaternion, _UNIT, entries=_QUATERNION),
    "rpy": ObservationTerm(rpy, _TURN, entries=_RPY),
    "rotation_matrix": ObservationTerm(rotation_matrix, _UNIT, entries=_MATRIX),
    "gravity": ObservationTerm(gravity, _UNIT, entries=quantities("direction of gravity", "-", "body")),
    "omega": ObservationTerm(omega, _MAX_RATE, entries=quantities("angular velocity", "rad/s", "body")),
    "omega_world": ObservationTerm(omega_world, _MAX_RATE, entries=_OMEGA_WORLD),
    "rotor_speed": ObservationTerm(
        rotor_speed, 10.0, entries=tuple(Quantity(f"speed of rotor {i}", "of the highest") for i in range(4))
    ),
    "kinematics": ObservationTerm(
        kinematics, _KINEMATICS, entries=(*_POSITION, *_QUATERNION, *_RPY, *_VELOCITY, *_OMEGA_WORLD, *_RPM)
    ),
    "kinematics_2x": ObservationTerm(
        kinematics_2x, _KINEMATICS_2X, entries=(*_POSITION, *_RPY, *_VELOCITY, *_OMEGA_WORLD)
    ),
    "normalized_kinematics": ObservationTerm(normalized_kinematics, _UNIT, entries=_NORMALIZED),
    "adjacency": ObservationTerm(
        adjacency, 1.0, entries=lambda n, _: tuple(Quantity(f"whether drone {i} is within 10 m") for i in range(n))
    ),
    "last_action": last_actions(1),
    "last_actions_2x": last_actions(15),
    "neighbors": neighbors(2),
    "encounters": encounters(8),
    "obstacles": obstacles(4),
    "opponents": encounters(3),
    "preview": preview(0.1, 0.2, 0.3),
}
