"""Arrays exchanged between compiled programs and the Bullet host, one row per drone."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxdrones import rotation
from jaxdrones.dynamics.rotors import limited
from jaxdrones.engine.physics import Physics
from jaxdrones.engine.team import Layout, pack
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.state import State

# The host sees a team as one array, a row per drone: pose and velocities in the world frame, rotor speeds, commands,
# and the states of models.
BODY, COMMAND = slice(0, 13), slice(17, 21)
QUAT, OMEGA, RPM = slice(3, 7), slice(10, 13), slice(13, 17)
AUX = slice(21, None)
COLUMNS = dict(pos=slice(0, 3), quat=QUAT, vel=slice(7, 10), omega=OMEGA, rpm=RPM)
# And what acts on it: force and torque, the angular velocity that rotors leave which take a speed at once (all in the
# world frame); then the rotor speeds and states of models that follow.
START_OMEGA, NEXT_RPM, NEXT_AUX = slice(6, 9), slice(9, 13), slice(13, None)


def one_array(state: State, rpm: jax.Array) -> jax.Array:
    """Array (n, k) of a team for the host."""
    omega = jax.vmap(rotation.rotate)(state.quat, state.omega)
    body = [state.pos, state.quat, state.vel, omega, state.rpm, rpm]
    return jnp.concatenate([*body, pack(state.aux, len(state.pos))], axis=-1)


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
    """Build the compiled `loads(layout, aux, flat_params, team, scene)`.

    It returns loads and the next rotor and model states, (n, 13 + k). The layouts are those of packed parameters and
    model states.
    """
    start = make_start(physics)

    def loads(layout: Layout, aux: Layout, flat_params: jax.Array, team: jax.Array, scene: Scene) -> jax.Array:
        params: Params = layout.unpack(flat_params)
        state = State(**{name: team[:, columns] for name, columns in COLUMNS.items()}, aux=aux.unpack(team[:, AUX]))
        omega = jax.vmap(rotation.rotate_inverse)(state.quat, state.omega)
        command = team[:, COMMAND]
        state = start(params, state.replace(omega=omega), command)
        acting = physics.loads(params, state, command, scene)

        in_world = jax.vmap(rotation.rotate)
        force = in_world(state.quat, acting.wrench.force).at[:, 2].add(-params.weight)
        torque, omega = in_world(state.quat, acting.wrench.torque), in_world(state.quat, state.omega)
        rpm = acting.state.rpm + dt * acting.rpm_rate
        aux_rate = jax.tree.map(jnp.zeros_like, state.aux) | acting.aux_rate
        following = jax.tree.map(lambda x, rate: x + dt * rate, state.aux, aux_rate)
        return jnp.concatenate([force, torque, omega, rpm, pack(following, len(team))], axis=-1)

    return jax.jit(loads, static_argnums=(0, 1))
