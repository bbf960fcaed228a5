"""Simulated flights, and the errors of a state estimate along them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from jaxdrones.control import geometric
from jaxdrones.control.setpoint import Setpoint
from jaxdrones.sensing import Scene, kalman


@functools.lru_cache
def flights(n, hz, seconds, *, lag=False, seed=0):
    """Figures of eight of several sizes and speeds, flown by the geometric controller: params, states, derivatives."""
    params = jd.repeat(jd.load_params("cf2x"), n)
    rotors = dict(rotors=jd.lagging_rotors) if lag else {}
    step = jd.make_step(effects=(jd.drag,), integrator=jd.rk4, dt=1 / hz, **rotors)
    rng = np.random.default_rng(seed)
    radius, turn = jnp.asarray(rng.uniform(0.2, 1, n)), jnp.asarray(rng.uniform(0, 2 * np.pi, n))
    speed = jnp.asarray(rng.uniform(0.5, 2, n)) / jnp.sqrt(radius)
    gains = geometric.gains()
    if lag:
        gains = gains.replace(attitude=gains.attitude / 4, rate=gains.rate / 2)

    def target(t, r, w, turn):
        a = w * t + turn
        pos = jnp.stack([r * jnp.cos(a), r * jnp.sin(2 * a) / 2, 1 + 0.3 * jnp.sin(a)])
        vel = jnp.stack([-r * w * jnp.sin(a), r * w * jnp.cos(2 * a), 0.3 * w * jnp.cos(a)])
        return Setpoint.at(pos, vel, yaw=0.3 * t * jnp.sign(turn - 3))

    def command(state, t):
        def one(params, state, *figure):
            return geometric.control(gains, params, None, state, target(t, *figure), dt=1 / hz)[1]

        return jax.vmap(one)(params, state, radius, speed, turn)

    def advance(state, k):
        rpm = command(state, k / hz)
        state = step(params, state, rpm)
        return state, (state, step.rate(params, state, rpm))

    start = jax.vmap(lambda *figure: target(0.0, *figure).pos)(radius, speed, turn)
    start = jd.State.at_rest(start).replace(rpm=jnp.tile(params.hover_rpm[:, None], (1, 4)))
    fly = jax.jit(lambda start: jax.lax.scan(advance, start, jnp.arange(round(hz * seconds)))[1])
    return params, *fly(start)


def along(sensor, params, states, rates, key):
    """Memories and readings of a sensor at every state, (length, n, ...)."""
    n = len(params.mass)
    init_key, key = jax.random.split(key)

    def measure(memory, x):
        state, rate, key = x
        keys = jax.random.split(key, n)
        memory, reading = jax.vmap(sensor.measure, (0, 0, 0, 0, None, 0))(keys, params, state, rate, Scene(), memory)
        return memory, (memory, reading)

    begun = jax.vmap(sensor.init)(jax.random.split(init_key, n), params)
    keys = jax.random.split(key, len(states.pos))
    return jax.jit(lambda begun: jax.lax.scan(measure, begun, (states, rates, keys))[1])(begun)


def errors(memories, states, late=0):
    """Errors (length, n, 15) and covariances of estimates that are `late` samples old."""
    now = jax.tree.map(lambda x: x[late:], memories)
    then = jax.tree.map(lambda x: x[: len(states.pos) - late], (states, memories.imu))
    state, biases = then[0], {name: error.bias for name, error in then[1].items()}
    error = jax.vmap(jax.vmap(kalman.error))
    found = error(now.estimate, state.pos, state.vel, state.quat, biases["gyro"], biases["acc"])
    return np.asarray(found), np.asarray(now.estimate.cov)


def normalized(error, cov):
    """Squares of errors in units of their covariance, (length, n): chi-square."""
    return np.einsum("tni,tni->tn", error, np.linalg.solve(cov, error[..., None])[..., 0])


def few(flown, n, length=None):
    """The first of some flights, and of these the first instants."""
    params, states, rates = flown
    cut = (jax.tree.map(lambda x: x[:length, :n], tree) for tree in (states, rates))
    return jax.tree.map(lambda x: x[:n], params), *cut
