"""Arrays exchanged between compiled programs and the Bullet host, one row per drone."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxdrones import rotation
from jaxdrones.checks import UNIT_LENGTH
from jaxdrones.dynamics.integrators import models_after
from jaxdrones.dynamics.rotors import limited
from jaxdrones.engine.physics import Physics
from jaxdrones.engine.team import Layout, columns
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.state import State
from jaxdrones.vector import along_z

# The host sees a team as one array, a row per drone: the fields of `State`, commands, and the states of models.
BODY, COMMAND = slice(0, 13), slice(17, 21)
QUAT, OMEGA, RPM = slice(3, 7), slice(10, 13), slice(13, 17)
AUX = slice(21, None)
COLUMNS = dict(pos=slice(0, 3), quat=QUAT, vel=slice(7, 10), omega=OMEGA, rpm=RPM)
# And what acts on it: force and torque, the angular velocity that rotors leave which take a speed at once (all in the
# world frame); whether it may touch the ground or another drone; whether its numbers are suspect; then the rotor speeds
# and states of models that follow.
START_OMEGA, NEAR, SUSPECT, NEXT_RPM, NEXT_AUX = slice(6, 9), 9, 10, slice(11, 15), slice(15, None)


def one_array(state: State, rpm: jax.Array) -> jax.Array:
    """Array (n, k) of a team for the host."""
    body = [state.pos, state.quat, state.vel, state.omega, state.rpm, rpm]
    return jnp.concatenate([*body, *columns(state.aux, len(state.pos))], axis=-1)


def reach(radius: Any, height: Any, offset: Any) -> Any:
    """Radius (m) of a ball around a drone in which everything lies that Bullet may let touch it, its margins included.

    Arguments are those of the collision cylinder, with its offset along body z, m.
    """
    return 1.05 * (radius**2 + (abs(offset) + height / 2) ** 2) ** 0.5 + 0.02


def near(params: Params, pos: jax.Array, ground: bool) -> jax.Array:
    """Which drones of a team (n,) at `pos` (n, 3), m, may touch another one or the ground."""
    ball = reach(params.collision_radius, params.collision_height, params.collision_offset)
    apart = jnp.sum((pos[:, None] - pos[None]) ** 2, axis=-1) > (ball[:, None] + ball[None]) ** 2
    alone = jnp.all(apart | jnp.eye(len(pos), dtype=bool), axis=-1)
    return ~(alone & (pos[:, 2] > ball)) if ground else ~alone


def suspect(team: jax.Array) -> jax.Array:
    """Rows of a team's array (n,) to be checked: not finite, or a quaternion that may not be of unit length."""
    excess = jnp.sum(team[:, QUAT] ** 2, axis=-1) - 1
    return ~(jnp.isfinite(jnp.sum(team, axis=-1)) & (jnp.abs(excess) < UNIT_LENGTH))


def bodies_of(params: Params) -> jax.Array:
    """Bodies of a team for Bullet, (n, 20): see `Client.set_team`."""
    shape = [params.collision_radius, params.collision_height, params.collision_offset, params.prop_radius]
    rotor_pos = jnp.reshape(params.rotor_pos, (-1, 12))
    return jnp.concatenate([jnp.stack(shape, axis=-1), rotor_pos, params.mass[:, None], params.inertia], axis=-1)


def make_start(physics: Physics) -> Callable[[Params, State, jax.Array], State]:
    """Build the function for the state at the start of a physics step, with its rotor speeds."""

    def start(params: Params, state: State, command: jax.Array) -> State:
        return physics.at_speed(params, state.replace(rpm=jax.vmap(limited)(params, state.rpm)), command)

    return start


def make_loads(physics: Physics, dt: float) -> Callable[..., jax.Array]:
    """Build `loads(layout, aux, flat_params, team, scene)`.

    It returns loads and the next rotor and model states, (n, 15 + k). The layouts are those of packed parameters and
    model states.
    """
    start = make_start(physics)

    def loads(layout: Layout, aux: Layout, flat_params: jax.Array, team: jax.Array, scene: Scene) -> jax.Array:
        params: Params = layout.unpack(flat_params)
        state = State(**{name: team[:, place] for name, place in COLUMNS.items()}, aux=aux.unpack(team, AUX.start))
        command = team[:, COMMAND]
        state = start(params, state, command)
        acting = physics.loads(params, state, command, scene)

        in_world = jax.vmap(rotation.rotate)
        force = in_world(state.quat, acting.wrench.force) - jax.vmap(along_z)(params.weight)
        torque, omega = in_world(state.quat, acting.wrench.torque), in_world(state.quat, state.omega)
        rpm = acting.state.rpm + dt * acting.rpm_rate
        aux_rate = jax.tree.map(jnp.zeros_like, state.aux) | acting.aux_rate
        following = models_after(state.aux, aux_rate, dt)
        flags = jnp.stack([near(params, state.pos, scene.ground), suspect(team)], axis=-1)
        return jnp.concatenate([force, torque, omega, flags, rpm, *columns(following, len(team))], axis=-1)

    return loads
