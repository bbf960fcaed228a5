"""Hover of many vehicles whose rotors lag, by the geometric controller and a lead that makes up for most of the lag."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from jaxdrones import rotation
from jaxdrones.control import Setpoint, geometric

HZ = 240
_STEP = jd.make_step(effects=(jd.drag,), rotors=jd.lagging_rotors, dt=1 / HZ)
_LAG = 0.03  # s, time constant that is left of the rotors


def gains() -> geometric.Gains:
    """The gains of the geometric controller at half their speed, which suits rotors with the lag that is left."""
    return jax.tree.map(lambda gain, power: gain / 2**power, geometric.gains(), geometric.Gains(2, 1, 2, 1))


def quickened(params: jd.Params, rpm: jax.Array, wanted: jax.Array) -> jax.Array:
    """The command at which rotors that turn at `rpm` approach the speed that is wanted with a lag of `_LAG`."""
    lag = jnp.where(wanted > rpm, params.rotor_rise_time, params.rotor_fall_time)
    return rpm + jnp.maximum(lag / _LAG, 1) * (wanted - rpm)


@partial(jax.jit, static_argnames="seconds")
def _hover(team: jd.Params, key: jax.Array, seconds: int) -> jd.State:
    def fly(params, key):
        where, turned = jax.random.split(key)
        start = jd.State(
            pos=jnp.array([0, 0, 10.0])
            + 0.3 * rotation.rotate(rotation.exp(jax.random.normal(where, (3,))), jnp.eye(3)[0]),
            quat=rotation.exp(jnp.deg2rad(20) * jnp.array([1.0, 0, 0]) * jax.random.rademacher(turned, (), float)),
            vel=jnp.zeros(3),
            omega=jnp.zeros(3),
            rpm=jnp.full(4, params.hover_rpm),
        )
        one = jax.tree.map(lambda x: x[None], params)

        def advance(state, _):
            _, rpm = geometric.control(gains(), params, None, state, Setpoint.at(jnp.array([0, 0, 10.0])), dt=1 / HZ)
            rpm = quickened(params, state.rpm, rpm)
            team_state = jax.tree.map(lambda x: x[None], state)
            return jax.tree.map(lambda x: x[0], _STEP(one, team_state, rpm[None])), None

        return jax.lax.scan(advance, start, length=seconds * HZ)[0]

    return jax.vmap(fly)(team, jax.random.split(key, len(team.mass)))


def hover_errors(team: jd.Params, key: jax.Array, seconds: int) -> tuple[np.ndarray, np.ndarray]:
    """Distance from the place to hover at (m) and speed (m/s) of each drone of a team, each alone in its world.

    They start 0.3 m away and tilted by 20 degrees.
    """
    end = _hover(team, key, seconds)
    distance = np.linalg.norm(end.pos - np.array([[0, 0, 10.0]]), axis=-1)
    return distance, np.linalg.norm(end.vel, axis=-1)
