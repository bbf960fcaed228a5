"""Users' models fly as the core does: every integrator at its order, mapped, differentiated, in kernels, on Bullet."""

from dataclasses import replace
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from extensions import battery, flapping
from extensions.payload import Payload
from helpers import assert_close, assert_finite, jit_unoptimized, mostly_slow

import jaxdrones as jd

LOAD = Payload()
TEAM = jd.repeat(jd.load_params("cf2x"), 2)
EXTENSIONS = {
    "battery": dict(models=(battery.battery(),), rotors=battery.rotors),
    "payload": dict(models=(LOAD.model,), team_effects=(LOAD.effect,)),
    "flapping": dict(models=(flapping.flapping(),), effects=(flapping.tilted_thrust,)),
}
INTEGRATORS = {"rk4": jd.rk4, "semi-implicit Euler": jd.semi_implicit_euler}
each_extension = pytest.mark.parametrize("name", EXTENSIONS)
each_integrator = pytest.mark.parametrize(
    "integrator", [pytest.param(jd.rk4, marks=pytest.mark.slow), jd.semi_implicit_euler], ids=INTEGRATORS
)

make_step = lru_cache(
    lambda name, integrator, dt=1 / 240: jd.make_step(**EXTENSIONS[name], integrator=integrator, dt=dt)
)


def moving(step, team=TEAM):
    """Two drones 0.6 m apart that drift further apart, the load below them on taut cables."""
    state = jd.State.at_rest([[0.0, 0, 1], [0.6, 0, 1]]).replace(
        vel=jnp.array([[0.3, 0.2, 0.1], [0.5, -0.2, 0.0]]), rpm=0.95 * jnp.broadcast_to(team.hover_rpm[:, None], (2, 4))
    )
    state = step.init(team, state)
    if "payload" in state.aux:
        place = {"pos": jnp.tile(jnp.array([[0.3, 0.02, 0.59]]), (2, 1)), "vel": jnp.zeros((2, 3))}
        state = state.replace(aux={"payload": place})
    return state


def flown(step, state, steps, team=TEAM, share=1.05):
    command = share * jnp.broadcast_to(team.hover_rpm[:, None], (2, 4))
    return jd.rollout(step, lambda params, memory, s, k: (memory, command), team, state, None, steps)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXTENSIONS)
def test_rk4_measures_order_four_in_the_states_of_models(name):
    def end(dt):
        step = make_step(name, jd.rk4, dt)
        return flown(step, moving(step), round(0.1 / dt))[0].aux[name]

    exact = end(0.1 / 128)
    coarse, fine = (
        np.sqrt(sum(np.sum((a - b) ** 2) for a, b in zip(*map(jax.tree.leaves, (end(dt), exact)), strict=True)))
        for dt in (0.1 / 8, 0.1 / 16)
    )
    assert 3.7 < np.log2(coarse / fine) < 4.4


@pytest.mark.slow
@each_integrator
@each_extension
def test_a_model_is_mapped_and_flies_in_one_kernel_as_alone(name, integrator):
    step = make_step(name, integrator)
    start = moving(step)

    def fly(vel):
        return flown(step, start.replace(vel=vel), 20)[0]

    vels = jnp.stack([start.vel, 2 * start.vel, -start.vel])
    alone = jax.tree.map(lambda *x: jnp.stack(x), *map(fly, vels))
    assert_close(jit_unoptimized(jax.vmap(fly))(vels), alone, 1e-9)
    assert_close(jd.over_worlds(fly)(vels), alone, 1e-9)


@pytest.mark.slow
@each_integrator
@each_extension
def test_gradients_through_a_model_are_those_of_differences(name, integrator):
    step = make_step(name, integrator)
    start = moving(step)

    def sum_of_aux(scale):
        end = flown(step, start.replace(vel=scale * start.vel), 20, share=1.02)[0]
        return sum(jnp.sum(x) for x in jax.tree.leaves((end.aux, end.pos)))

    value = jit_unoptimized(sum_of_aux)
    h = 1e-4
    measured = (value(1 + h) - value(1 - h)) / (2 * h)
    assert abs(measured) > 1e-9
    np.testing.assert_allclose(jit_unoptimized(jax.grad(sum_of_aux))(1.0), measured, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.needs("pybullet")
@each_extension
def test_bullet_integrates_a_model_beside_the_rotors(name):
    """Half the step, half the distance to the explicit backend: both are of order one."""
    from jaxdrones.engine import bullet

    exact = make_step(name, jd.rk4)
    truth = flown(exact, moving(exact), 24)[0]
    misses = []
    for substeps in 4, 8:
        with bullet.make_step(**EXTENSIONS[name], dt=1 / 240 / substeps, substeps=substeps) as step:
            end = flown(step, moving(step), 24)[0]
        misses.append(sum(np.sum(np.abs(a - b)) for a, b in zip(*map(jax.tree.leaves, (end, truth)), strict=True)))
    assert misses[1] < 0.7 * misses[0]


@pytest.mark.slow
def test_a_battery_loses_the_energy_that_the_rotors_take():
    """At constant rotor speed: the charge falls by the current, and with it the highest speed."""
    step = jd.make_step(**EXTENSIONS["battery"], integrator=jd.rk4)
    state = moving(step).replace(rpm=jnp.full((2, 4), 14e3))
    drawn = jax.vmap(battery.current)(TEAM, state)
    rate = step.rate(TEAM, state, state.rpm).aux["battery"]
    np.testing.assert_allclose(rate, -drawn)
    full, low = (state.replace(aux={"battery": jnp.full(2, x)}) for x in (battery.CAPACITY, 0.1 * battery.CAPACITY))
    fastest = [flown(step, s, 480, share=10.0)[0].rpm.max() for s in (full, low)]
    assert fastest[1] < 0.9 * fastest[0] < float(TEAM.max_rpm[0])


@pytest.mark.slow
@pytest.mark.parametrize(("integrator", "order"), [(jd.rk4, 4), (jd.semi_implicit_euler, 1)])
def test_a_payload_on_cables_without_damping_keeps_energy_to_the_order_of_the_integrator(integrator, order):
    load = replace(LOAD, damping=0.0)
    team = TEAM.replace(kf=TEAM.kf * 1e-12)  # nothing but gravity and the cables

    def energy(state):
        pos, vel = (state.aux["payload"][x][0] for x in ("pos", "vel"))
        span = jnp.sqrt(jnp.sum((state.pos - pos[None]) ** 2, axis=1))
        stretch = jnp.maximum(span - load.length, 0)
        moving = jnp.sum(team.mass[:, None] * state.vel**2) + load.mass * jnp.sum(vel**2)
        lifted = jnp.sum(team.weight * state.pos[:, 2]) + load.mass * team.gravity[0] * pos[2]
        return moving / 2 + lifted + load.stiffness * jnp.sum(stretch**2) / 2

    def drift(dt):
        step = jd.make_step(team_effects=(load.effect,), models=(load.model,), integrator=integrator, dt=dt)
        start = moving(step, team).replace(rpm=jnp.zeros((2, 4)))
        sinking = start.aux["payload"] | {
            "vel": jnp.tile(jnp.array([[0, 0, -0.5]]), (2, 1))
        }  # so that no cable goes slack
        start = start.replace(aux={"payload": sinking})
        return abs(float(energy(flown(step, start, round(0.05 / dt), team, 0.0)[0]) - energy(start)))

    dt = 0.05 / 8
    assert drift(dt) > 1e-12
    assert np.log2(drift(dt) / drift(dt / 2)) > order - 0.4


@pytest.mark.slow
@each_integrator
def test_a_payload_keeps_the_momentum_of_team_and_load_to_rounding(integrator):
    team = TEAM.replace(gravity=jnp.zeros(2))
    step = make_step("payload", integrator)
    start = moving(step, team).replace(rpm=jnp.zeros((2, 4)))
    end = flown(step, start, 200, team, 0.0)[0]

    def momentum(state):
        return jnp.sum(team.mass[:, None] * state.vel, axis=0) + LOAD.mass * state.aux["payload"]["vel"][0]

    assert np.max(np.abs(end.aux["payload"]["vel"] - start.aux["payload"]["vel"])) > 0.05
    np.testing.assert_allclose(momentum(end), momentum(start), rtol=0, atol=1e-15)


@pytest.mark.slow
def test_flapping_follows_the_wind_by_a_first_order_lag():
    """In a wind that blows from the front of a drone that is held where it is."""
    team = TEAM.replace(wind=jnp.tile(jnp.array([[-4.0, 0, 0]]), (2, 1)), mass=TEAM.mass * 1e9, gravity=jnp.zeros(2))
    team = team.replace(inertia=team.inertia * 1e9)
    step = make_step("flapping", jd.rk4)
    state = step.init(team, jd.State.at_rest([[0.0, 0, 1], [0.6, 0, 1]]))
    tilt = flown(step, state, 24, team, 1e-6)[1].aux["flapping"][:, 0, 0]
    time = (1 + np.arange(24)) / 240
    np.testing.assert_allclose(tilt, 0.06 * (1 - np.exp(-time / flapping.TIME_CONSTANT)), rtol=1e-4)


def test_a_state_without_that_of_a_model_says_where_to_start():
    step = make_step("battery", jd.rk4)
    with pytest.raises(ValueError, match=r"state\.aux lacks 'battery'.*step\.init\(params, state\)"):
        step(TEAM, jd.State.at_rest(np.zeros((2, 3))), jnp.zeros((2, 4)))


@pytest.mark.slow
def test_a_rollout_starts_models_anew_and_keeps_those_that_are_there():
    step = make_step("battery", jd.rk4)
    start = jd.State.at_rest([[0.0, 0, 1], [0.6, 0, 1]])
    fresh = flown(step, start, 1)[0].aux["battery"]
    half = flown(step, start.replace(aux={"battery": jnp.full(2, battery.CAPACITY / 2)}), 1)[0].aux["battery"]
    np.testing.assert_allclose(fresh - half, battery.CAPACITY / 2, rtol=1e-4)


@pytest.mark.parametrize(
    ("rate", "message"),
    [
        (lambda params, state, command: None, "returned None; return a pytree like the model's state"),
        (lambda params, state, command: jnp.zeros(2), "return a pytree like the model's state"),
        (lambda params, state: 0, r"give a function of \(params, state, command\)"),
    ],
)
def test_a_rate_of_another_type_is_named(rate, message):
    with pytest.raises(ValueError, match=message):
        step = jd.make_step(models=(jd.Model("charge", lambda params: jnp.zeros(()), rate),))
        flown(step, jd.State.at_rest(np.zeros((2, 3))), 1)


@pytest.mark.slow
def test_gradients_through_a_full_battery_are_finite():
    step = make_step("battery", jd.rk4)
    start = moving(step)
    assert_finite(jax.grad(lambda s: jnp.sum(flown(step, s, 3, share=10.0)[0].pos))(start))


@pytest.mark.parametrize("backend", ["explicit", pytest.param("bullet", marks=pytest.mark.needs("pybullet"))])
@pytest.mark.parametrize("name", mostly_slow(EXTENSIONS, ["battery"]))
@pytest.mark.slow
def test_a_model_flies_in_an_environment_and_starts_anew_with_the_episode(name, backend):
    with jd.make("hover", drones=2, backend=backend, **EXTENSIONS[name]) as env:
        _, world = env.reset(jax.random.key(0))
        fresh = world.drones.aux
        _, world, reward, *_ = env.step(jax.random.key(1), world, jnp.zeros((2, 4)))
        assert jax.tree.structure(world.drones.aux) == jax.tree.structure(fresh) and name in fresh
        assert any(np.any(a != b) for a, b in zip(*map(jax.tree.leaves, (world.drones.aux, fresh)), strict=True))
        assert_finite((world.drones, reward))
        assert_close(env.reset(jax.random.key(2))[1].drones.aux, fresh, 0)
