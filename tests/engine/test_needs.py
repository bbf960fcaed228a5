"""What effects declare about themselves: the scene, contact, and the longest step with which contact is stable."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, jit_unoptimized

import jaxdrones as jd
from jaxdrones import assets, vehicles
from jaxdrones.dynamics.contact import LARGEST_STEP
from jaxdrones.engine import bullet
from jaxdrones.engine.physics import Physics
from jaxdrones.envs.randomize import scaled, shifted
from jaxdrones.sensing import Scene, Sphere

TEAM = jd.repeat(jd.load_params("cf2x"), 1)
START = jd.State.at_rest([[0.0, 0, 0.02]])
STILL = jnp.zeros((1, 4))
SCENE = Scene.of(Sphere(pos=(0, 0, 0), radius=0.02), ground=False)
CONTACTS = {"effects": (jd.ground_contact, jd.obstacle_contact), "pairs": (jd.drone_contact,)}


def pushed(scene, gain):
    """A force of a user's effect: the distance of the scene from the origin."""
    return jd.Wrench.of_force(gain * scene.distance(jnp.ones(3)) * jnp.ones(3))


class Push:
    def __call__(self, params, state, gain=2.0, scene=None):
        return pushed(scene, gain)


def with_default(params, state, scene=None, gain=2.0):
    return pushed(scene, gain)


def by_keyword(params, state, *, gain=2.0, scene):
    return pushed(scene, gain)


def of_scene(params, state, gain, scene):
    return pushed(scene, gain)


@pytest.mark.parametrize("effect", [Push(), with_default, by_keyword, functools.partial(of_scene, gain=2.0)])
def test_an_effect_with_a_parameter_named_scene_is_given_the_scene(effect):
    physics = Physics([effect])
    assert physics.takes_scene and physics.seen(SCENE) is SCENE
    pushing, bare = jit_unoptimized(lambda: [p.wrench(TEAM, START, SCENE).force for p in (physics, Physics())])()
    found = pushing - bare
    np.testing.assert_allclose(found, np.full((1, 3), 2.0 * SCENE.distance(jnp.ones(3))), rtol=1e-6)


def test_a_scene_that_is_bound_is_not_replaced():
    bound = functools.partial(with_default, scene=SCENE)
    assert not Physics([bound]).takes_scene
    assert_close(
        Physics([bound]).wrench(TEAM, START, Scene()), Physics([with_default]).wrench(TEAM, START, SCENE), 1e-9
    )
    with pytest.raises(ValueError, match="obstacle_contact has a bound scene"):
        jd.make_step(effects=[functools.partial(jd.obstacle_contact, scene=SCENE)])


@pytest.mark.parametrize("kind", CONTACTS)
def test_contact_with_bound_arguments_is_the_same_contact(kind):
    """The engine treats it the same, and Bullet refuses it in the same words."""
    for contact in CONTACTS[kind]:
        partial = functools.partial(functools.partial(contact))
        one, other = Physics(**{kind: [contact]}), Physics(**{kind: [partial]})
        assert one.touches(SCENE) == other.touches(SCENE) == (contact is jd.obstacle_contact)
        assert one.takes_scene == other.takes_scene
        assert len(other.contacts("ground", "obstacles", "drones")) == 1


def stiff(params, state, scene):
    return jd.obstacle_contact(params, state, scene)


@pytest.mark.parametrize("enclosed", [jd.obstacle_contact])
def test_a_function_around_contact_declares_it_or_is_refused(enclosed):
    """Undeclared, the disc of a drone at 20 m/s would pass a thin wall."""
    for around in stiff, lambda params, state, scene: enclosed(params, state, scene):
        name = around.__name__
        with pytest.raises(
            ValueError, match=rf"{name} calls obstacle_contact .*give functools.wraps\(obstacle_contact\)"
        ):
            jd.make_step(effects=[around])
        assert Physics([functools.wraps(jd.obstacle_contact)(around)]).touches(SCENE)
    with pytest.raises(ValueError, match="pairs: <lambda> calls drone_contact"):
        jd.make_step(pairs=[lambda *both: jd.drone_contact(*both)])
    jd.make_step(pairs=[lambda *both: jd.downwash(*both)])


class Touching:
    """A user's effect with contact inside."""

    def __call__(self, params, state, scene):
        return jd.obstacle_contact(params, state, scene)

    def method(self, params, state, scene):
        return jd.obstacle_contact(params, state, scene)


def test_contact_in_any_wrapper_is_the_same_contact():
    """That of a compiled or wrapped one is found, and that of an object is refused as that of a function is."""
    soft = functools.partial(jd.obstacle_contact)
    for around in jax.jit(jd.obstacle_contact), functools.partial(jax.jit(soft)), functools.wraps(soft)(Touching()):
        assert Physics([around]).touches(SCENE)
    with pytest.raises(ValueError, match=r"up to 1/240 s; give dt=0\.004167"):
        jd.make_step(effects=[jax.jit(jd.ground_contact)], dt=1 / 60)

    def function(params, state, scene):
        return jd.obstacle_contact(params, state, scene)

    for around in (
        Touching(),
        functools.partial(Touching()),
        Touching().method,
        functools.partial(function),
        jax.jit(function),
    ):
        with pytest.raises(ValueError, match=r"calls obstacle_contact .*give functools.wraps\(obstacle_contact\)"):
            jd.make_step(effects=[around])


@pytest.mark.needs("pybullet")
def test_bullet_refuses_contact_with_bound_arguments():
    with pytest.raises(ValueError, match="ground_contact is given and Bullet resolves"):
        bullet.make_step(effects=[functools.partial(jd.ground_contact)])


@pytest.mark.parametrize("kind", CONTACTS)
def test_contact_refuses_steps_with_which_it_gains_energy_and_says_what_to_give(kind):
    for contact in (*CONTACTS[kind], functools.partial(CONTACTS[kind][0])):
        with pytest.raises(ValueError, match=r"up to 1/240 s; give dt=0\.004167 and substeps=8"):
            jd.make_step(**{kind: [contact]}, dt=1 / 60, substeps=2)
        with pytest.raises(ValueError, match=r"give dt=0\.0025 and substeps=2"):
            jd.make_step(**{kind: [contact]}, dt=0.005)
        for dt in LARGEST_STEP, 1 / 240, 1 / 500:
            jd.make_step(**{kind: [contact]}, dt=dt)
    jd.make_step(effects=[jd.drag, jd.ground_effect], dt=1 / 60)


def test_without_a_ground_nothing_pushes_a_drone_up():
    """Neither contact nor ground effect; a drone at rest on the ground falls as if it were in the air."""
    rpm = TEAM.hover_rpm[:, None] * jnp.full((1, 4), 0.7)
    effects = (functools.partial(jd.ground_contact), jd.ground_effect, jd.ground_effect_2021)
    step, bare = jd.make_step(effects=effects, substeps=48), jd.make_step(substeps=48)
    start = START.replace(pos=jnp.array([[0.0, 0, 0.01]]))

    @jit_unoptimized
    def flown():
        return step(TEAM, start, rpm, Scene(ground=False)), bare(TEAM, start, rpm), step(TEAM, start, rpm)

    fallen, free, pushed_up = flown()
    assert_close(fallen, free, 1e-9)
    assert fallen.pos[0, 2] < -0.05 and pushed_up.pos[0, 2] > 0


@pytest.mark.slow
def test_no_vehicle_gains_energy_by_contact_at_the_longest_step():
    """Bundled and sampled vehicles, dropped level, tilted and on edge; 0.1 % for the explicit gyroscopic term."""
    bundled = [jd.load_params(str(path)) for path in assets.vehicles().values()]
    sampled = jax.vmap(lambda key: vehicles.draw(key, bundled[0]))(jax.random.split(jax.random.key(0), 100))
    params = jax.tree.map(lambda *x: jnp.concatenate([jnp.stack(x[:-1]), x[-1]]), *bundled, sampled)
    step = jd.make_step(effects=[jd.ground_contact], dt=LARGEST_STEP)

    def energy(params, state):
        kinetic = params.mass * jnp.sum(state.vel**2) + jnp.sum(params.inertia * state.omega[0] ** 2)
        return kinetic / 2 + params.weight * state.pos[0, 2]

    def gain(params, tilt):
        height = params.collision_radius + params.collision_height + jnp.abs(params.collision_offset)
        start = jd.State.at_rest(jnp.stack([0 * height, 0 * height, height])[None])
        quat = jd.rotation.from_rpy(jnp.stack([tilt, tilt / 3, 0 * tilt]))[None]
        start = start.replace(quat=quat, vel=jnp.array([[1.0, 0.0, -2.0]]))

        def fall(state, _):
            state = step(jd.repeat(params, 1), state, STILL)
            return state, energy(params, state)

        return jnp.max(jax.lax.scan(fall, start, length=240)[1]) / energy(params, start) - 1

    of_tilts = jax.vmap(gain, (None, 0))
    gains = jit_unoptimized(jax.vmap(of_tilts, (0, None)))(params, jnp.array([0.0, 0.35, 0.8, 1.5]))
    assert gains.shape == (111, 4) and np.all(gains < 1e-3)


@pytest.mark.parametrize("rotors", [jd.lagging_rotors, jd.failing(jd.lagging_rotors)])
def test_rotors_whose_lag_is_too_short_for_the_step_are_refused(rotors):
    """Their speed would swing ever wider about the command, also below zero."""
    racer = jd.repeat(jd.load_params("racer"), 1)
    longest = 2 * float(racer.rotor_rise_time[0])
    for refused in (
        lambda: jd.make_step(rotors=rotors, dt=1.1 * longest)(racer, START, STILL),
        lambda: jax.jit(lambda rpm: jd.make_step(rotors=rotors, dt=1.1 * longest)(racer, START, rpm))(STILL),
        lambda: jd.make("hover", vehicle="racer", rotors=rotors, control_hz=1 / (2.2 * longest), substeps=2),
    ):
        with pytest.raises(ValueError, match=r"step is 0\.044 s and rotors that lag by 0\.02 s are stable up to 0\.04"):
            refused()


def test_rotors_by_pwm_have_the_same_lag():
    racer = jd.load_params("racer")
    racer = jd.repeat(racer.replace(aux={"motors": jd.crazyflie_motors()}), 1)
    step = jd.make_step(rotors=jd.pwm_rotors, dt=2.2 * float(racer.rotor_rise_time[0]))
    with pytest.raises(ValueError, match=r"rotors that lag by 0\.02 s are stable up to 0\.04"):
        step(racer, START, STILL)


@pytest.mark.slow
def test_random_lags_that_are_too_short_for_the_step_are_refused():
    options = dict(vehicle="racer", rotors="lagging", control_hz=50, substeps=1)
    jd.make("hover", randomize=(scaled("rotor_rise_time", 0.6, 1.5),), **options)
    for law in (scaled("rotor_rise_time", 0.4, 1.5), shifted("rotor_fall_time", -0.015, 0.0)):
        with pytest.raises(ValueError, match=r"step is 0\.02 s and rotors that lag by 0\.00"):
            jd.make("hover", randomize=(law,), **options)


def test_the_shortest_lags_of_realistic_flights_are_refused_where_they_are_too_short():
    """A racer whose rotors slow down five times as fast falls by 2.5 times the difference of its speed in 10 ms."""
    jd.make("follow", vehicle="racer", realistic=True, substeps=3)
    with pytest.raises(ValueError, match=r"step is 0\.01 s and rotors that lag by 0\.004 s are stable up to 0\.008 s"):
        jd.make("follow", vehicle="racer", realistic=True)


def test_rotors_follow_at_the_longest_step_that_is_not_refused():
    racer = jd.repeat(jd.load_params("racer"), 1)
    step = jd.make_step(rotors=jd.lagging_rotors, dt=1.9 * float(racer.rotor_rise_time[0]))
    state, command = START, jnp.full((1, 4), racer.hover_rpm[0])
    for _ in range(100):
        state = step(racer, state, command)
    np.testing.assert_allclose(state.rpm, command, rtol=1e-3)
