"""A flight that a known vehicle flew."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones
from jaxdrones import State
from jaxdrones.control import Setpoint, for_team, geometric
from jaxdrones.flights import FlightLog
from jaxdrones.flights.log import OPTIONAL, STATE, STATE_AND_SPEEDS
from jaxdrones.flights.open_loop import EFFECTS

ROWS = 300


@pytest.fixture(scope="session")
def flown():
    """The parameters of a vehicle, and the log of three seconds that it flew on a wavy path."""
    cf2x = jaxdrones.load_params("cf2x")
    params = cf2x.replace(
        kf=1.2 * cf2x.kf,
        drag_coeff=2 * cf2x.drag_coeff,
        flapping_coeff=jnp.array([4e-8, 3e-8]),
        rate_damping=jnp.array([4e-5, 4e-5, 2e-5]),
        rotor_rise_time=jnp.asarray(0.05),
        rotor_fall_time=jnp.asarray(0.05),
    )
    return params, simulated("flown.npz", params)


def simulated(name, params):
    """The log of a flight by the geometric controller, with the speeds of lagging rotors at the times of its rows."""
    team = jaxdrones.repeat(params, 1)
    step = jaxdrones.make_step(effects=EFFECTS, integrator=jaxdrones.rk4, dt=0.01, rotors=jaxdrones.lagging_rotors)
    gains = geometric.gains()

    def advance(carry, t):
        memory, state = carry
        pos = jnp.stack([jnp.sin(3 * t), jnp.cos(2 * t) - 1, 0.5 * jnp.sin(4 * t)])
        setpoint = jax.tree.map(lambda x: x[None], Setpoint.at(pos))
        memory, rpm = jax.vmap(lambda *a: geometric.control(gains, *a, dt=0.01))(team, memory, state, setpoint)
        return (memory, step(team, state, rpm)), state

    memory = for_team(geometric.init(), 1)
    start = step.init(team, State.at_rest(jnp.zeros((1, 3))))
    start = start.replace(rpm=jnp.broadcast_to(team.hover_rpm[:, None], (1, 4)))
    _, states = jax.jit(lambda: jax.lax.scan(advance, (memory, start), jnp.arange(ROWS) * 0.01))()
    arrays = {column: np.asarray(getattr(states, column), float) for column in STATE_AND_SPEEDS}
    return FlightLog(np.arange(ROWS) * 0.01, **arrays, name=name)


@pytest.fixture(scope="session")
def columns_of():
    """The columns of a log of one drone, without the drone axis."""
    return lambda log: {"t": log.t} | {x: getattr(log, x)[:, 0] for x in STATE | OPTIONAL if log.has(x)}


@pytest.fixture
def columns(flown, columns_of):
    """The columns of a sound log."""
    return columns_of(flown[1])
