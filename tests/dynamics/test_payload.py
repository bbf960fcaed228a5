"""A load on cables swings as a pendulum, keeps momentum and energy, and weighs on the drones that carry it."""

from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, jit_unoptimized, mostly_slow

import jaxdrones as jd
from jaxdrones.dynamics.payload import LARGEST_STEP

pytestmark = pytest.mark.float32
MASS = 0.008  # kg
ABOVE = np.array([[0.2, 0, 2], [-0.1, 0.173205, 2], [-0.1, -0.173205, 2]])
INTEGRATORS = {"semi-implicit Euler": jd.semi_implicit_euler, "rk4": jd.rk4}
shared_or_not = pytest.mark.parametrize("shared", [pytest.param(False, marks=pytest.mark.slow), True])
each_integrator = pytest.mark.parametrize(
    "integrator", mostly_slow(INTEGRATORS.values(), [jd.semi_implicit_euler]), ids=INTEGRATORS
)


def team(n):
    return jd.repeat(jd.load_params("cf2x"), n)


@lru_cache
def make_step(shared=False, integrator=jd.semi_implicit_euler, dt=1 / 250):
    return jd.make_step(effects=(jd.cable,), models=(jd.payload(shared),), integrator=integrator, dt=dt)


def flown(step, params, state, seconds, command=None):
    """The end of a flight at constant rotor speeds, by default those of the start, and all its states."""
    command = state.rpm if command is None else command
    return jd.rollout(step, lambda p, m, s, k: (m, command), params, state, None, round(seconds / step.period))


fly = partial(jit_unoptimized, static_argnums=(0, 3))(flown)
tensions = jit_unoptimized(jax.vmap(jax.vmap(jd.cable_tension), (None, 0)))


def heavy(params):
    """Drones that hover as before, and that no load moves."""
    return params.replace(mass=1e6 * params.mass, inertia=1e6 * params.inertia, kf=1e6 * params.kf)


def weightless(params):
    return params.replace(gravity=jnp.zeros_like(params.gravity))


def hovering(step, params, pos=((0.0, 0, 2),)):
    start = jd.State.at_rest(pos)
    return step.init(params, start.replace(rpm=jnp.broadcast_to(params.hover_rpm[:, None], start.rpm.shape)))


def with_load(state, pos=None, vel=None):
    load = state.aux["payload"]
    rows = load.pos.shape
    pos, vel = (
        a if b is None else jnp.broadcast_to(jnp.asarray(b, a.dtype), rows)
        for a, b in zip((load.pos, load.vel), (pos, vel), strict=True)
    )
    return state.replace(aux={"payload": jd.PointMass(pos, vel)})


def swinging(step, params, angle, length, pos=(0.0, 0, 2)):
    """Level drone at rest; the load at rest at an angle (rad) from the vertical, on a taut cable."""
    offset = length * jnp.array([jnp.sin(angle), 0, -jnp.cos(angle)])
    return with_load(hovering(step, params, (pos,)), pos=(jnp.array(pos) + offset)[None])


def tossed(step, params, shared):
    """Drones that turn and drift, the load moving below them on cables that become taut."""
    n = len(params.mass)
    state = hovering(step, params, ABOVE[:n])
    rng = np.random.default_rng(3)
    vel, omega = (jnp.asarray(size * rng.normal(size=(n, 3)), state.vel.dtype) for size in (0.3, 2.0))
    return with_load(state.replace(vel=vel, omega=omega), vel=0.5 * rng.normal(size=(1 if shared else n, 3)))


@partial(jit_unoptimized, static_argnums=2)
def energy(params, state, shared):
    """Kinetic and potential energy of drones, cables and loads, J."""
    own, load = params.aux["payload"], state.aux["payload"]
    count = 1 if shared else len(params.mass)
    anchor = state.pos + jax.vmap(jd.rotation.rotate)(state.quat, own.anchor)
    stretch = jnp.maximum(jnp.linalg.norm(load.pos - anchor, axis=-1) - own.length, 0)
    kinetic = jnp.sum(params.mass * jnp.sum(state.vel**2, axis=-1) + jnp.sum(params.inertia * state.omega**2, axis=-1))
    kinetic += jnp.sum((own.mass * jnp.sum(load.vel**2, axis=-1))[:count])
    lifted = jnp.sum(params.weight * state.pos[:, 2]) + jnp.sum((own.mass * params.gravity * load.pos[:, 2])[:count])
    return (kinetic + jnp.sum(own.stiffness * stretch**2)) / 2 + lifted


@partial(jit_unoptimized, static_argnums=2)
def energies(params, states, shared):
    return jax.vmap(lambda state: energy.__wrapped__(params, state, shared))(states)


@pytest.mark.parametrize("degrees", [2, 90])
@each_integrator
def test_a_load_below_a_fixed_drone_swings_with_the_period_of_a_pendulum(integrator, degrees):
    """2 pi sqrt(l/g), over the arithmetic-geometric mean of 1 and cos(angle / 2) at a large amplitude.

    The cable stretches by up to 0.3 % at the bottom of the large swing.
    """
    step = make_step(integrator=integrator, dt=1 / 1000)
    params = jd.with_payload(heavy(team(1)), MASS, 1.0, stretch=0.001, damping_ratio=0.0)
    angle = np.radians(degrees)
    _, states = fly(step, params, swinging(step, params, angle, 1.0), 4.8)
    x = np.asarray(states.aux["payload"].pos[:, 0, 0] - states.pos[:, 0, 0])
    crossings = np.flatnonzero(x[:-1] * x[1:] < 0)
    times = (crossings + 1 + x[crossings] / (x[crossings] - x[crossings + 1])) * step.dt
    a, b = 1.0, np.cos(angle / 2)
    for _ in range(6):
        a, b = (a + b) / 2, np.sqrt(a * b)
    period = 2 * np.pi / np.sqrt(float(team(1).gravity[0])) / a
    assert len(times) >= 4
    np.testing.assert_allclose(np.diff(times[:4]), period / 2, rtol=2e-3)
    np.testing.assert_allclose(times[0], period / 4, rtol=3e-3)


@each_integrator
@shared_or_not
def test_momentum_of_drones_and_loads_is_constant_without_gravity(shared, integrator):
    params = weightless(jd.with_payload(team(3), MASS, 0.4, anchor=(0.01, 0, -0.01), cables=3 if shared else 1))
    step = make_step(shared, integrator)
    start = tossed(step, params, shared).replace(rpm=jnp.zeros((3, 4)))
    _, states = fly(step, params, start, 1.0)

    def momentum(state):
        own = jnp.sum(params.mass[:, None] * state.vel, axis=0)
        return own + jnp.sum((MASS * state.aux["payload"].vel)[: 1 if shared else 3], axis=0)

    exchanged = MASS * np.abs(states.aux["payload"].vel[-1] - start.aux["payload"].vel).max()
    assert exchanged > 1e-3
    np.testing.assert_allclose(
        jit_unoptimized(jax.vmap(momentum))(states), momentum(start)[None].repeat(250, 0), atol=1e-3 * exchanged
    )


@shared_or_not
def test_angular_momentum_of_drones_and_loads_is_constant_without_gravity(shared):
    """The pull at an anchor off the center of mass turns the drone by as much as it turns the load."""
    params = weightless(jd.with_payload(team(3), MASS, 0.4, anchor=(0.01, 0, -0.02), cables=3 if shared else 1))
    step = make_step(shared, jd.rk4)
    start = tossed(step, params, shared).replace(rpm=jnp.zeros((3, 4)))
    _, states = fly(step, params, start, 1.0)

    def momentum(state):
        spin = jax.vmap(jd.rotation.rotate)(state.quat, params.inertia * state.omega)
        load = state.aux["payload"]
        of_load = (MASS * jnp.cross(load.pos, load.vel))[: 1 if shared else 3]
        return jnp.sum(spin + params.mass[:, None] * jnp.cross(state.pos, state.vel), axis=0) + jnp.sum(of_load, axis=0)

    spins = params.inertia[None] * states.omega
    assert np.abs(spins[-1] - spins[0]).max() > 2e-5
    np.testing.assert_allclose(
        jit_unoptimized(jax.vmap(momentum))(states), momentum(start)[None].repeat(250, 0), atol=4e-6
    )


@pytest.mark.slow
@each_integrator
@shared_or_not
def test_damped_cables_never_add_energy(shared, integrator):
    """Of a fall, in which cables become taut and slack; 0.3 % of the kinetic energy for the order of the integrator."""
    params = jd.with_payload(team(3), MASS, 0.4, anchor=(0.005, 0, -0.01), cables=3 if shared else 1)
    step = make_step(shared, integrator, dt=1 / 1000)
    start = tossed(step, params, shared)
    start = start.replace(rpm=jnp.zeros((3, 4)), omega=0.2 * start.omega)
    _, states = fly(step, params, start, 1.5)
    tension = tensions(params, states)
    assert 0.05 < np.mean(tension > 0) < 0.95
    of_time = np.asarray(energies(weightless(params), states, shared))
    still = energies(params, states, shared)
    scale = of_time.max()
    assert np.diff(still).max() < 3e-4 * scale
    assert still[-1] < still[0] - 0.01 * float(energy(weightless(params), start, shared))


@pytest.mark.slow
@pytest.mark.parametrize(
    "integrator, least", [(jd.semi_implicit_euler, 0.8), pytest.param(jd.rk4, 3.5, marks=pytest.mark.slow)]
)
@shared_or_not
def test_energy_is_conserved_to_the_order_of_the_integrator_without_damping(shared, integrator, least):
    with jax.enable_x64(True):
        params = jd.with_payload(
            team(3), MASS, 0.4, damping_ratio=0.0, anchor=(0.005, 0, -0.01), cables=3 if shared else 1
        )

        def drift(dt):
            step = make_step(shared, integrator, dt)
            start = hovering(step, params, 1.3 * ABOVE if shared else ABOVE)
            pulled = start.aux["payload"]
            start = with_load(start.replace(rpm=jnp.zeros((3, 4))), vel=jnp.array([[0.1, 0.05, -0.3]]))
            start = with_load(start, pos=pulled.pos - jnp.array([[0, 0, 0.02]]))
            states = fly(step, params, start, 0.02)[1]
            taut = tensions(params, states)
            assert np.all(taut > 0)
            return abs(
                float(energy(params, jax.tree.map(lambda x: x[-1], states), shared) - energy(params, start, shared))
            )

        coarse, fine = drift(1 / 400), drift(1 / 800)
        assert np.log2(coarse / fine) > least


@pytest.mark.slow
def test_a_swing_keeps_its_amplitude_at_the_longest_step():
    """Explicit Euler would gain a tenth of the energy a second at 1/100 s."""
    step = make_step(dt=LARGEST_STEP)
    params = jd.with_payload(heavy(team(1)), MASS, 0.5)
    _, states = fly(step, params, swinging(step, params, 0.5, 0.505), 10.0)
    x = np.abs(np.asarray(states.aux["payload"].pos[:, 0, 0] - states.pos[:, 0, 0]))
    assert 0.97 < x[-150:].max() / x[:150].max() < 1.005


@pytest.mark.slow
@each_integrator
@shared_or_not
def test_a_hovering_drone_carries_the_weight_of_its_load(shared, integrator):
    """Thrust for drone and load alone holds the height; without the load's share the team sinks."""
    mass = 3 * MASS if shared else MASS
    params = jd.with_payload(team(3), mass, 0.5, cables=3 if shared else 1)
    step = make_step(shared, integrator)
    start = hovering(step, params, 1e-3 * ABOVE + np.array([[0, 0, 2]]))
    rpm = jnp.sqrt((params.mass + MASS) * params.gravity / (4 * params.kf))[:, None] * jnp.ones(4)[None]
    end, _ = fly(step, params, start, 2.0, rpm)
    np.testing.assert_allclose(end.pos, start.pos, atol=2e-3)
    np.testing.assert_allclose(end.aux["payload"].pos, start.aux["payload"].pos, atol=2e-3)
    np.testing.assert_allclose(jax.vmap(jd.cable_tension)(params, end), MASS * params.gravity, rtol=5e-3)
    sunk, _ = fly(step, params, start, 1.0)
    expected = -MASS / (MASS + params.mass[0]) * params.gravity[0] / 2
    np.testing.assert_allclose(sunk.pos[:, 2] - start.pos[:, 2], expected, rtol=0.02)


def test_a_slack_cable_exerts_no_force_and_the_load_falls_freely():
    params = jd.with_payload(team(1), MASS, 0.5)
    step = make_step()
    start = hovering(step, params)
    start = with_load(start, pos=start.pos - jnp.array([[0, 0, 0.3]]), vel=jnp.array([[0.2, 0, 0.0]]))
    _, states = fly(step, params, start, 0.18)
    t = 0.18
    np.testing.assert_allclose(states.vel[-1], 0, atol=1e-5)
    expected = start.aux["payload"].pos[0] + jnp.array([0.2 * t, 0, -9.8 * t**2 / 2])
    np.testing.assert_allclose(states.aux["payload"].pos[-1, 0], expected, atol=4e-3)
    assert not np.any(tensions(params, states))


def test_the_tension_is_that_of_the_formula_and_continuous_where_the_cable_becomes_taut():
    params = jax.tree.map(lambda x: x[0], jd.with_payload(team(1), MASS, 0.5))
    own = params.aux["payload"]

    def tension(stretch, growth):
        load = jd.PointMass(jnp.array([0, 0, -(0.5 + stretch)]), jnp.array([0, 0, -growth]))
        state = jax.tree.map(lambda x: x[0], jd.State.at_rest([[0.0, 0, 0]])).replace(aux={"payload": load})
        return float(jd.cable_tension(params, state))

    k, c, d = (float(x) for x in (own.stiffness, own.damping, own.onset))
    np.testing.assert_allclose(k * d, MASS * 9.8, rtol=1e-5)
    np.testing.assert_allclose(tension(d, 0.2), k * d + 0.2 * c, rtol=1e-3)
    np.testing.assert_allclose(tension(2 * d, 0.2), 2 * k * d + 0.2 * c, rtol=1e-3)
    np.testing.assert_allclose(tension(d / 2, 0.2), (k * d + 0.2 * c) / 2, rtol=2e-3)
    assert tension(1e-6, 3.0) < 1e-3 and tension(d, -5.0) == 0 and tension(-0.1, 5.0) == 0
    mu = 1 / (1 / MASS + 1 / float(params.mass))
    np.testing.assert_allclose(c, 2 * 0.3 * np.sqrt(k * mu), rtol=1e-5)


@pytest.mark.slow
@shared_or_not
def test_gradients_through_the_cables_are_those_of_central_differences(shared):
    params = jd.with_payload(team(3), MASS, 0.4, anchor=(0.005, 0, -0.01), cables=3 if shared else 1)
    step = make_step(shared)
    start = hovering(step, params, ABOVE)

    def miss(x):
        rpm = start.rpm * (1.1 + 0.02 * x[:3])[:, None]
        load = params.aux["payload"]
        own = load.replace(mass=load.mass * (1 + x[3]), length=load.length * (1 + 0.1 * x[4]))
        flying = with_load(start, vel=jnp.broadcast_to(jnp.stack([0.2 + x[5], x[6], 0 * x[6]])[None], (3, 3)))
        end, _ = flown(step, params.replace(aux={"payload": own}), flying, 0.4, rpm)
        load = end.aux["payload"]
        return jnp.sum(load.pos**2) + jnp.sum(load.vel * jnp.array([[1.0, 2, 3]])) + jnp.sum(end.pos**2)

    with jax.enable_x64(True):
        params, start = jax.tree.map(lambda x: jnp.asarray(x, float), (params, start))
        value, h = jit_unoptimized(miss), 1e-5
        measured = [(value(h * e) - value(-h * e)) / (2 * h) for e in np.eye(7)]
        exact = jit_unoptimized(jax.grad(miss))(jnp.zeros(7))
    assert np.all(np.abs(exact) > 1e-3)
    np.testing.assert_allclose(exact, measured, rtol=2e-4)
    params, start = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (params, start))
    np.testing.assert_allclose(jax.jit(jax.grad(miss))(jnp.zeros(7, jnp.float32)), exact, rtol=1e-2)


@pytest.mark.slow
def test_the_gradient_is_finite_for_a_load_at_its_anchor_and_at_the_end_of_a_slack_cable():
    params = jd.with_payload(team(1), MASS, 0.5)
    step = make_step()

    @jit_unoptimized
    @jax.grad
    def gradient(below):
        start = with_load(hovering(step, params), pos=jnp.stack([0 * below, 0 * below, 2 - below])[None])
        return jnp.sum(flown(step, params, start, 0.02)[0].pos)

    assert np.all(np.isfinite([gradient(x) for x in (0.0, 0.5, 0.6)]))


@pytest.mark.slow
@shared_or_not
def test_many_worlds_swing_as_one_does(shared):
    params = jd.with_payload(team(3), MASS, 0.4, cables=3 if shared else 1)
    step = make_step(shared)
    start = tossed(step, params, shared)

    def fly(scale):
        return flown(step, params, start.replace(vel=scale * start.vel), 0.3)[0]

    scales = jnp.array([0.5, 1.0, 2.0])
    alone = jax.tree.map(lambda *x: jnp.stack(x), *(jit_unoptimized(fly)(x) for x in scales))
    assert_close(jit_unoptimized(jax.vmap(fly))(scales), alone, 1e-4, 1e-4)
    assert_close(jd.over_worlds(fly)(scales), alone, 1e-4, 1e-4)


def test_the_rows_of_a_shared_load_stay_equal_and_it_starts_near_rest():
    params = jd.with_payload(team(3), 3 * MASS, 0.5, cables=3)
    step = make_step(True)
    start = hovering(step, params, ABOVE)
    tension = jax.vmap(jd.cable_tension)(params, start)
    height = start.pos[0, 2] - start.aux["payload"].pos[0, 2]
    np.testing.assert_allclose(tension * height / 0.5, MASS * 9.8, rtol=0.02)
    load = fly(step, params, tossed(step, params, True), 1.0)[0].aux["payload"]
    for x in (load.pos, load.vel):
        np.testing.assert_array_equal(x, np.broadcast_to(x[:1], x.shape))


def test_the_damping_is_a_share_of_the_critical_one_of_load_and_turning_drone():
    """The vertical cable beside the center of mass moves load and drone, and turns the drone."""
    params = jd.load_params("cf2x")
    own = jd.with_payload(params, MASS, damping_ratio=0.2, anchor=(0.02, 0, 0)).aux["payload"]
    reduced_mass = 1 / (1 / MASS + 1 / float(params.mass) + 0.02**2 / float(params.inertia[1]))
    np.testing.assert_allclose(own.damping, 0.2 * 2 * np.sqrt(float(own.stiffness) * reduced_mass), rtol=1e-6)


def test_steps_and_cables_that_are_unstable_are_refused():
    with pytest.raises(ValueError, match=r"cable is stable up to 1/100 s; give dt=0\.01 and substeps=2"):
        jd.make_step(effects=(jd.cable,), models=(jd.payload(),), dt=0.02)
    with pytest.raises(ValueError, match=r"stable up to physics steps of .* below 1/100 s; give a longer cable"):
        jd.with_payload(team(1), MASS, 0.02)
    with pytest.raises(ValueError, match=r"give a longer cable"):
        jd.with_payload(team(1), MASS, 0.5, stretch=1e-4)
    for mass in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="mass of the load"):
            jd.with_payload(team(1), mass)


def test_a_missing_load_or_missing_constants_are_named():
    params = jd.with_payload(team(1), MASS)
    without = jd.make_step(effects=(jd.cable,))
    with pytest.raises(ValueError, match=r"state\.aux lacks 'payload'; give models=\(jaxdrones\.payload\(\),\)"):
        without(params, jd.State.at_rest([[0.0, 0, 1]]), jnp.zeros((1, 4)))
    with pytest.raises(ValueError, match=r"params\.aux lacks 'payload'.*with_payload"):
        make_step().init(team(1), jd.State.at_rest([[0.0, 0, 1]]))


UDAAN = [
    [0.092455, 0.024299, 0.005309, -0.096222, 0.052004, -0.456896],
    [-0.058245, 0.013141, 0.008244, 0.055325, -0.001809, -0.478458],
    [-0.427473, -0.231506, -0.03152, -0.231139, -0.083952, -0.467043],
    [-1.304922, -0.838683, -0.159275, -1.317921, -0.765084, -0.653657],
]
"""Positions of drone and load, m, after 0.5, 1, 1.5 and 2 s by udaan 1.3.0: `QuadrotorCsPayloadBase._zoh`, equations
of a rigid cable (Sreenath, Lee and Kumar 2013), extrapolated from Euler steps of 0.1 and 0.05 ms, 0.22 mm apart."""


@pytest.mark.slow
@pytest.mark.parametrize("stretch", mostly_slow([1e-2, 1e-3], [1e-2]))
def test_a_flight_converges_to_that_of_udaan_as_the_cable_stretches_less(stretch):
    """Thrust for drone and load, small torques, a swing of 0.5 rad; the difference is twice the stretch of 0.5 m."""
    inertia = np.array([1.4e-5, 1.4e-5, 2.17e-5])

    def push(params, state):
        return jd.Wrench(jnp.array([0, 0, 0.035 * 9.8]), jnp.array([2e-6, -3e-6, 1e-6]))

    down = np.array([np.sin(0.5), 0, -np.cos(0.5)])
    vel = 0.5 * np.cross(np.cross(down, [0, 0.6, 0]), down)
    with jax.enable_x64(True):
        drone = team(1).replace(mass=jnp.array([0.027]), inertia=jnp.array([inertia]), gravity=jnp.array([9.8]))
        params = jd.with_payload(drone, 0.008, 0.5, stretch=stretch, damping_ratio=0.2)
        step = jd.make_step(effects=(push, jd.cable), models=(jd.payload(),), integrator=jd.rk4, dt=1 / 1000)
        start = step.init(params, jd.State.at_rest([[0.0, 0, 0]]))
        _, states = fly(step, params, with_load(start, 0.5 * (1 + stretch) * down[None], vel[None]), 2.0)
    flight = np.concatenate([states.pos[499::500, 0], states.aux["payload"].pos[499::500, 0]], axis=1)
    np.testing.assert_allclose(flight, UDAAN, atol=2.1 * stretch * 0.5)


def test_the_damping_resists_the_motion_of_the_anchor_by_the_rotation_of_the_drone():
    """The anchor moves up at 0.2 m/s as the drone turns, so the cable stretches at that rate."""
    params = jd.with_payload(team(1), MASS, 0.5, anchor=(0.1, 0, 0))
    own = jax.tree.map(lambda x: float(x[0]), params.aux["payload"].replace(anchor=jnp.zeros(1)))
    load = jd.PointMass(jnp.array([[0.1, 0, -(0.5 + own.onset)]]), jnp.zeros((1, 3)))
    state = jd.State.at_rest([[0.0, 0, 0]]).replace(omega=jnp.array([[0, -2.0, 0]]), aux={"payload": load})
    tension = jax.vmap(jd.cable_tension)(params, state)
    np.testing.assert_allclose(tension, own.stiffness * own.onset + 0.2 * own.damping, rtol=1e-3)
