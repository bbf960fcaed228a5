"""Order of convergence, and what each integrator keeps of a tumbling body."""

from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import INTEGRATORS, flying, jit_unoptimized, make_step, mostly_slow, mostly_slow_rows, name_of

import jaxdrones
from jaxdrones import (
    State,
    drag,
    euler,
    implicit_midpoint,
    instant_rotors,
    lagging_rotors,
    midpoint,
    rk4,
    rotation,
    semi_implicit_euler,
)

ORDER = {euler: 1, semi_implicit_euler: 1, midpoint: 2, implicit_midpoint: 2, rk4: 4}
params = jaxdrones.load_params("cf2x")


@lru_cache
def flight_in_steps(integrator, rotors):
    """A flight of 0.2 s through the air as a function of the number of steps, compiled once for any number.

    The command turns the drone fast, differs from rotor to rotor, and stays on one side of every rotor speed.
    """
    team = jaxdrones.repeat(params, 1)
    start = flying(team).replace(omega=jnp.array([[4.0, -3.0, 2.0]]), rpm=jnp.full((1, 4), 12e3))
    command = jnp.array([[14.0e3, 14.2e3, 14.6e3, 14.3e3]])

    @jit_unoptimized
    def after(steps):
        def many_steps(derivative, state, dt):
            return jax.lax.fori_loop(0, steps, lambda _, s: integrator(derivative, s, dt / steps), state)

        step = jaxdrones.make_step((drag,), rotors=rotors, integrator=many_steps, dt=0.2)
        return step(team, start, command)

    return after


@pytest.mark.parametrize("rotors", mostly_slow([instant_rotors, lagging_rotors], [lagging_rotors]), ids=name_of)
@pytest.mark.parametrize("integrator", INTEGRATORS, ids=name_of)
def test_each_integrator_converges_with_its_order(integrator, rotors):
    """Halving the step divides the error by 2^order: in position, velocity, attitude, body rates, rotor speed.

    The exact flight is that of RK4 in 4,000 steps. 0.15 covers what the next order adds (measured: at most 0.09).
    RK4 takes fewer steps than the others, so that its errors stay above round-off.
    """
    exact = flight_in_steps(rk4, rotors)(4000)
    after = flight_in_steps(integrator, rotors)
    steps = (25, 50) if integrator is rk4 else (100, 200)
    errors = [jax.tree.map(lambda a, b: np.linalg.norm(a - b), after(n), exact) for n in steps]
    for name in ("pos", "vel", "quat", "omega") + (("rpm",) if rotors is lagging_rotors else ()):
        error = [getattr(e, name) for e in errors]
        order = np.log2(error[0] / error[1])
        assert abs(order - ORDER[integrator]) < 0.15, f"{name}: order {order:.2f} from errors {error}"


@partial(jax.jit, static_argnums=0)
def tumble(integrator, params):
    """Energy gained and angular momentum (world) changed, both relative, by 1 s at 240 Hz from (10, 5, 20) rad/s."""
    free = params.replace(gravity=jnp.zeros(()))
    start = State.at_rest(jnp.zeros((1, 3))).replace(omega=jnp.array([[10.0, 5.0, 20.0]]))
    step = jaxdrones.make_step(integrator=integrator, dt=1 / 240, substeps=240)
    end = step(jaxdrones.repeat(free, 1), start, jnp.zeros((1, 4)))

    def energy(state):
        return jnp.sum(free.inertia * state.omega[0] ** 2) / 2

    def momentum(state):
        return rotation.rotate(state.quat[0], free.inertia * state.omega[0])

    change = momentum(end) - momentum(start)
    return energy(end) / energy(start) - 1, jnp.linalg.norm(change) / jnp.linalg.norm(momentum(start))


@pytest.mark.parametrize(("vehicle", "loss"), [("cf2x", 1e-8), ("cf2p", 1e-8), ("racer", 1e-8), ("hb", 4e-8)])
def test_rk4_keeps_energy_and_momentum_of_a_tumbling_drone(vehicle, loss):
    """Measured: energy -5.2e-9, -3.9e-10, 0, -2.8e-8; momentum at most 1.2e-7. The flatter the body, the more."""
    energy, momentum = tumble(rk4, jaxdrones.load_params(vehicle))
    assert abs(energy) <= loss
    assert momentum <= 2e-7


@pytest.mark.parametrize("vehicle", ["cf2x", "cf2p", "racer", "hb"])
def test_implicit_midpoint_gains_no_energy(vehicle):
    """Only what eight iterations leave of the implicit equation, 1e-13; momentum has its second-order error."""
    energy, momentum = tumble(implicit_midpoint, jaxdrones.load_params(vehicle))
    assert abs(energy) <= 1e-12
    assert momentum <= 1e-4


@pytest.mark.parametrize(("vehicle", "gain"), [("cf2x", 0.110), ("cf2p", 0.043), ("racer", 0.0), ("hb", 0.226)])
def test_semi_implicit_euler_gains_the_documented_energy(vehicle, gain):
    """The price of its explicit gyroscopic term; nothing for a body with three equal moments of inertia."""
    energy, momentum = tumble(semi_implicit_euler, jaxdrones.load_params(vehicle))
    np.testing.assert_allclose(energy, gain, rtol=0.01, atol=1e-14)
    assert momentum <= 0.07


def test_the_fastest_tumble_stays_finite_and_slower_ones_are_not_limited():
    """Without the limit, a drone of 22 g that turns at 590 rad/s is not finite after a second."""
    light = params.replace(mass=jnp.array(0.022), gravity=jnp.zeros(()))
    team = jaxdrones.repeat(light, 2)
    omega = jnp.array([[340.0, 340.0, 340.0], [376.0, 0.0, 0.0]])
    start = State.at_rest(jnp.zeros((2, 3))).replace(omega=omega)
    end = make_step(substeps=240)(team, start, jnp.zeros((2, 4)))
    assert np.all(np.abs(end.omega) <= 240 * np.pi / 2 * (1 + 1e-12)) and np.isfinite(end.quat).all()
    np.testing.assert_array_equal(end.omega[1], omega[1])


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS, ids=name_of)
def test_without_forces_a_drone_flies_straight_on(integrator):
    team = jaxdrones.repeat(params.replace(gravity=jnp.zeros(())), 3)
    start = flying(team)
    end = make_step(integrator=integrator, substeps=240)(team, start, jnp.zeros((3, 4)))
    np.testing.assert_array_equal(end.vel, start.vel)
    np.testing.assert_allclose(end.pos, start.pos + start.vel, atol=1e-12)  # 240 roundings of 1e-16 times 3 m


@pytest.mark.parametrize(
    ("integrator", "lag"),
    mostly_slow_rows(
        [(euler, -1), (semi_implicit_euler, 1), (implicit_midpoint, 0), (rk4, 0)], [(semi_implicit_euler, 1), (rk4, 0)]
    ),
)
def test_a_falling_drone_follows_the_parabola(integrator, lag):
    """Exactly for order 2 and up; the Eulers are ahead or behind by half a step's worth of velocity."""
    team = jaxdrones.repeat(params, 3)
    end = make_step(integrator=integrator, substeps=240)(team, State.at_rest(np.zeros((3, 3))), jnp.zeros((3, 4)))
    np.testing.assert_allclose(end.vel, np.tile([0, 0, -9.8], (3, 1)), atol=1e-12)
    np.testing.assert_allclose(end.pos, np.tile([0, 0, -9.8 / 2 * (1 + lag / 240)], (3, 1)), atol=1e-12)


@pytest.mark.parametrize("integrator", mostly_slow(INTEGRATORS, [jaxdrones.semi_implicit_euler, rk4]), ids=name_of)
def test_quaternions_keep_unit_length(integrator):
    team = jaxdrones.repeat(params, 3)
    start = flying(team).replace(omega=jnp.array([[10.0, 5, 20], [0, 0, 0], [-30, 20, 10]]))
    end = make_step(integrator=integrator, substeps=240)(team, start, start.rpm)
    np.testing.assert_allclose(np.linalg.norm(end.quat, axis=1), 1, atol=1e-15 * 3)
