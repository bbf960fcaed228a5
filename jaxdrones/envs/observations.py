"""What a policy sees: named parts that are put side by side, each with finite bounds.

`kinematics` is the paper's equation 7, `adjacency` its equation 8; images (equation 9) are the environment's.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.tasks.task import Part, Task, World, norm

_FAR, _FAST, _SPINNING = 20.0, 30.0, 100.0  # m, m/s, rad/s: the bounds of what is seen
_RPM = 1e5
_UNIT = 1.0 + 1e-6


def position(task: Task, world: World) -> Array:
    """m, world."""
    return world.drones.pos


def position_error(task: Task, world: World) -> Array:
    """From the drone to its target, m, world axes."""
    return task.target_now(world).pos - world.drones.pos


def position_error_body(task: Task, world: World) -> Array:
    """From the drone to its target, m, body axes."""
    return _to_body(world, position_error(task, world))


def velocity(task: Task, world: World) -> Array:
    """m/s, world."""
    return world.drones.vel


def velocity_body(task: Task, world: World) -> Array:
    """m/s, body axes."""
    return _to_body(world, world.drones.vel)


def velocity_error(task: Task, world: World) -> Array:
    """Of the target relative to the drone, m/s, world axes."""
    return task.target_now(world).vel - world.drones.vel


def quaternion(task: Task, world: World) -> Array:
    """(x, y, z, w) with w >= 0: of the two that are the same attitude, one."""
    quat = world.drones.quat
    return jnp.where(quat[:, 3:] < 0, -quat, quat)


def rpy(task: Task, world: World) -> Array:
    """Roll, pitch, yaw, rad."""
    return jax.vmap(rotation.to_rpy)(world.drones.quat)


def rotation_matrix(task: Task, world: World) -> Array:
    """Row by row."""
    return jnp.reshape(jax.vmap(rotation.to_matrix)(world.drones.quat), (-1, 9))


def omega(task: Task, world: World) -> Array:
    """rad/s, body."""
    return world.drones.omega


def omega_world(task: Task, world: World) -> Array:
    """rad/s, world axes, as the paper has it."""
    return jax.vmap(rotation.rotate)(world.drones.quat, world.drones.omega)


def rotor_speed(task: Task, world: World) -> Array:
    """Share of the highest."""
    return world.drones.rpm / world.params.max_rpm[:, None]


def kinematics(task: Task, world: World) -> Array:
    """Equation 7: position, quaternion, roll-pitch-yaw, velocity, angular velocity (world), rotor speeds (RPM)."""
    drones = world.drones
    return jnp.concatenate(
        [drones.pos, drones.quat, rpy(task, world), drones.vel, omega_world(task, world), drones.rpm], -1
    )


def kinematics_2x(task: Task, world: World) -> Array:
    """Position, roll-pitch-yaw, velocity, angular velocity (world): today's version of the paper's simulator."""
    drones = world.drones
    return jnp.concatenate([drones.pos, rpy(task, world), drones.vel, omega_world(task, world)], -1)


def normalized_kinematics(task: Task, world: World) -> Array:
    """The paper's twelve numbers in [-1, 1].

    That vz is cut at 1 m/s and divided by 3, and that only the direction of the angular velocity is seen, is the
    reference's.
    """
    x, y, z = world.drones.pos.T
    vx, vy, vz = world.drones.vel.T
    roll, pitch, yaw = rpy(task, world).T / jnp.pi
    turn = omega_world(task, world)
    speed = norm(turn)
    place = [jnp.clip(x, -15, 15) / 15, jnp.clip(y, -15, 15) / 15, jnp.clip(z, 0, 5) / 5]
    motion = [jnp.clip(vx, -3, 3) / 3, jnp.clip(vy, -3, 3) / 3, jnp.clip(vz, -1, 1) / 3]
    columns = jnp.stack([*place, roll, pitch, yaw, *motion], axis=-1)
    turns = speed > jnp.finfo(speed.dtype).eps ** 0.5  # rad/s: below, a direction would be one of rounding errors
    return jnp.concatenate([columns, turn * (turns / jnp.where(turns, speed, 1))[:, None]], -1)


def adjacency(task: Task, world: World, radius: float = 10.0) -> Array:
    """Equation 8: 1 for every drone nearer than `radius` (m) and for itself, else 0."""
    return (_distances(world) < radius).astype(world.drones.pos.dtype)


def last_actions(count: int) -> Part:
    """The last actions, oldest first."""

    def observe(task: Task, world: World) -> Array:
        return jnp.reshape(world.actions[:, -count:], (len(world.actions), -1))

    return Part(observe, _UNIT, history=count)


def neighbours(count: int) -> Part:
    """Position (m) and velocity (m/s) of the nearest drones relative to one's own, world axes, nearest first.

    In a team with fewer others the rest is zero.
    """

    def observe(task: Task, world: World) -> Array:
        n = len(world.drones.pos)
        away = jnp.where(jnp.eye(n, dtype=bool), jnp.inf, _distances(world))
        motion = jnp.concatenate([world.drones.pos, world.drones.vel], -1)
        relative = [jnp.zeros((n, 0), motion.dtype)]
        for _ in range(min(count, n - 1)):  # the nearest, the next one, ...: faster than sorting while they are few
            nearest = jnp.argmin(away, axis=-1)
            relative.append(motion[nearest] - motion)
            away = jnp.where(jnp.arange(n)[None] == nearest[:, None], jnp.inf, away)
        return jnp.pad(jnp.concatenate(relative, -1), ((0, 0), (0, 6 * max(count - n + 1, 0))))

    return Part(observe, _FAR)


def preview(*ahead: float) -> Part:
    """Where the target will be (s ahead), relative to the drone, m, world axes."""

    def observe(task: Task, world: World) -> Array:
        later = [task.target(world.variables, world.time + t).pos - world.drones.pos for t in ahead]
        return jnp.concatenate(later, axis=-1)

    return Part(observe, _FAR)


def _to_body(world: World, v: Array) -> Array:
    return jax.vmap(rotation.rotate_inverse)(world.drones.quat, v)


def _distances(world: World) -> Float[Array, "n n"]:
    pos = world.drones.pos
    return jax.vmap(lambda own: norm(pos - own[None]))(pos)


_TURN = math.pi + 1e-6
_KINEMATICS = (_FAR,) * 3 + (_UNIT,) * 4 + (_TURN,) * 3 + (_FAST,) * 3 + (_SPINNING,) * 3 + (_RPM,) * 4
_KINEMATICS_V2 = (_FAR,) * 3 + (_TURN,) * 3 + (_FAST,) * 3 + (_SPINNING,) * 3

OBSERVATIONS: dict[str, Part] = {
    "position": Part(position, _FAR),
    "position_error": Part(position_error, _FAR),
    "position_error_body": Part(position_error_body, _FAR * 2),
    "velocity": Part(velocity, _FAST),
    "velocity_body": Part(velocity_body, _FAST),
    "velocity_error": Part(velocity_error, _FAST),
    "quaternion": Part(quaternion, _UNIT),
    "rpy": Part(rpy, _TURN),
    "rotation_matrix": Part(rotation_matrix, _UNIT),
    "omega": Part(omega, _SPINNING),
    "omega_world": Part(omega_world, _SPINNING),
    "rotor_speed": Part(rotor_speed, 10.0),
    "kinematics": Part(kinematics, _KINEMATICS),
    "kinematics_2x": Part(kinematics_2x, _KINEMATICS_V2),
    "normalized_kinematics": Part(normalized_kinematics, _UNIT),
    "adjacency": Part(adjacency, 1.0),
    "last_action": last_actions(1),
    "last_actions_2x": last_actions(15),
    "neighbours": neighbours(2),
    "preview": preview(0.1, 0.2, 0.3),
}
