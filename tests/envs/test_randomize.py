"""Randomized parameters, sensor noise, delay, wind and pushes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, jit_unoptimized

import jaxdrones as jd
from jaxdrones.envs import episode, make
from jaxdrones.envs.disturbances import random_pushes
from jaxdrones.envs.randomize import (
    constant_wind,
    delayed,
    draw,
    drawn_leaves,
    realistic_randomization,
    scaled,
    sensor_noise,
    shifted,
)

KEY = jax.random.key(5)
TEAM = jd.repeat(jd.load_params("cf2x"), 200)


def test_a_scaled_parameter_stays_in_its_range_and_fills_it():
    mass = draw([scaled("mass", 0.9, 1.1)], KEY, TEAM).mass / TEAM.mass
    assert 0.9 <= mass.min() < 0.91 and 1.09 < mass.max() <= 1.1


def test_an_array_is_scaled_by_one_factor_and_shifted_entry_by_entry():
    inertia = draw([scaled("inertia", 0.5, 1.5)], KEY, TEAM).inertia / TEAM.inertia
    np.testing.assert_allclose(inertia, jnp.broadcast_to(inertia[:, :1], inertia.shape), rtol=1e-12)
    wind = draw([shifted("wind", -1.0, 1.0)], KEY, TEAM).wind
    assert np.ptp(np.asarray(wind), axis=1).min() > 0


def test_randomizations_compose_and_draw_independently():
    both = draw([scaled("mass", 0.9, 1.1), scaled("kf", 0.9, 1.1)], KEY, TEAM)
    correlation = np.corrcoef(both.mass / TEAM.mass, both.kf / TEAM.kf)[0, 1]
    assert abs(correlation) < 0.25
    assert_close(both.replace(mass=TEAM.mass, kf=TEAM.kf), TEAM, 0)


@pytest.mark.slow
def test_a_drawn_parameter_is_hidden_from_the_action_type():
    """A heavier drone is not given more thrust; a nominal one hovers at zero action, whatever its mass."""
    env = make("hover", randomize=(scaled("mass", 1.5, 1.5),), tilt=0.0, speed=0.0, omega=0.0)
    _, world = env.reset(KEY)
    zero = jnp.zeros((1, 4))
    assert env.step(KEY, world, zero)[1].drones.vel[0, 2] < world.drones.vel[0, 2] - 0.03
    heavy = make("hover", vehicle=jd.load_params("cf2x").replace(mass=0.04), tilt=0.0, speed=0.0, omega=0.0)
    _, world = heavy.reset(KEY)
    np.testing.assert_allclose(heavy.step(KEY, world, zero)[1].drones.vel, world.drones.vel, atol=1e-9)


def test_noise_has_the_standard_deviations_it_is_given():
    state = jd.State.at_rest(jnp.zeros((4000, 3)))
    seen = sensor_noise(pos=0.01, vel=0.02, angle=0.03, omega=0.04)(KEY, state)
    angle = 2 * seen.quat[:, :3]
    for x, sigma in (seen.pos, 0.01), (seen.vel, 0.02), (angle, 0.03), (seen.omega, 0.04):
        np.testing.assert_allclose(jnp.std(x, axis=0), sigma, rtol=0.05)
    np.testing.assert_allclose(jnp.sum(seen.quat**2, axis=-1), 1, rtol=1e-12)
    together = np.corrcoef(np.concatenate([seen.pos, seen.vel, angle, seen.omega], axis=1), rowvar=False)
    np.testing.assert_allclose(together, np.eye(12), atol=0.08)  # 5 standard deviations


@pytest.mark.slow
def test_noise_is_seen_and_does_not_move_the_drone():
    plain, noisy = make("hover"), make("hover", noise=sensor_noise())
    _, world = plain.reset(KEY)
    _, noisy_world = noisy.reset(KEY)
    assert_close(noisy_world.drones, world.drones, 0)
    zero = jnp.zeros((1, 4))
    seen, flown, *_ = noisy.step(KEY, world, zero)
    expected, undisturbed, *_ = plain.step(KEY, world, zero)
    assert_close(flown.drones, undisturbed.drones, 0)
    assert 0 < jnp.abs(seen - expected).max() < 0.2


@pytest.mark.parametrize(
    ("steps", "expected"), [(0.0, 5.0), (1.0, 4.0), (2.0, 3.0), (2, 3.0), (0.25, 4.75), (1.5, 3.5)]
)
def test_a_delay_takes_an_older_action_or_mixes_two(steps, expected):
    actions = jnp.arange(6.0)[None, :, None]
    np.testing.assert_allclose(delayed(actions, steps), expected)


def test_every_episode_draws_a_delay_of_its_own_and_flies_with_it():
    """The share of the newest action says how late it is: 1 without delay, 0.25 of 0.75 control steps."""
    env = make("hover", drones=2, delay=(0.0, 0.01))
    assert env.privileged_size == 1
    np.testing.assert_allclose(env.params.aux["delay"], 0.5)  # control steps, the mean

    @jit_unoptimized
    @jax.vmap
    def first_speeds(key):
        _, world = env.reset(key)
        _, rpm = episode.command(env, None, world, jnp.full((2, 4), 0.5))
        return world.params.aux["delay"], rpm[:, 0]

    delay, speed = first_speeds(jax.random.split(KEY, 200))
    hover = env.params.hover_rpm[None]
    full = hover + 0.5 * (env.params.max_rpm[None] - hover)
    np.testing.assert_allclose((speed - hover) / (full - hover), 1 - delay, rtol=1e-9)
    assert 0 <= delay.min() < 0.05 and 0.95 < delay.max() <= 1 and abs(delay.mean() - 0.5) < 0.05
    assert not np.any(delay[:, 0] == delay[:, 1])


def test_a_privileged_observation_has_the_parameters_of_the_episode():
    """The drawn ones, as deviations from the nominal vehicle."""
    env = make("hover", drones=2, randomize=(scaled("mass", 0.8, 1.2), scaled("kf", 0.9, 1.1)))

    @jit_unoptimized
    def drawn(key):
        world = env.reset(key)[1]
        return world.params.mass, world.params.kf, env.privileged_observation(world).params

    mass, kf, found = drawn(KEY)
    ratio = np.stack([mass / env.params.mass, kf / env.params.kf], axis=1)
    np.testing.assert_allclose(np.sort(found), np.sort(ratio - 1), rtol=1e-9)
    assert env.privileged_size == 2 and len(np.unique(found)) == 4


def test_bounds_of_a_delay_are_checked():
    made = make("hover")
    for delay in (0.02, 0.01), (0.0, 5.0), (-0.01, 0.01), (0.01,), (0.0, np.nan):
        with pytest.raises(ValueError, match="delay"):
            make("hover", delay=delay)
        with pytest.raises(ValueError, match="delay"):
            dataclasses.replace(made, delay=delay)
    assert dataclasses.replace(made, delay=0.02).delay_steps == (2, 2)
    assert make("hover", delay=(0.02, 0.02)).privileged_size == 0


@pytest.mark.slow
def test_a_delayed_action_reaches_the_rotors_late():
    env = make("hover", delay=0.02)
    _, world = env.reset(KEY)
    commanded = []
    for k in range(4):
        world = env.step(KEY, world, jnp.full((1, 4), 0.5 if k == 0 else 0.0))[1]
        commanded.append(float(world.drones.rpm[0, 0]))
    hover = float(env.params.hover_rpm[0])
    np.testing.assert_allclose(commanded[:2] + commanded[3:], hover)
    assert commanded[2] > 1.2 * hover


def test_before_the_first_destination_arrives_a_drone_holds_its_place():
    env = make("hover", drones=2, action="destination", delay=(0.02, 0.025))
    pos = jnp.array([[0.5, -0.4, 0.8], [-0.3, 0.6, 0.2]])
    world = env.reset(KEY)[1]
    world = world.replace(drones=jd.State.at_rest(pos))
    moved = []
    for _ in range(3):
        world = env.step(KEY, world, jnp.full((2, 3), -1.0))[1]
        moved.append(float(jnp.max(jnp.abs(world.drones.pos - pos))))
    assert max(moved[:2]) < 1e-12 < 1e-6 < moved[2]


@pytest.mark.slow
def test_wind_blows_a_drone_with_drag_away():
    env = make("hover", effects=("drag",), randomize=(constant_wind(3.0),), tilt=0.0, speed=0.0, omega=0.0)
    _, world = env.reset(KEY)
    wind = world.params.wind[0]
    for _ in range(20):
        world = env.step(KEY, world, jnp.zeros((1, 4)))[1]
    assert jnp.dot(world.drones.vel[0], wind) > 0


def test_pushes_come_as_often_and_last_as_long_as_asked():
    disturbance = random_pushes(0.5, interval=1.0, duration=0.1)
    team = jax.vmap(disturbance.start)(jax.random.split(KEY, len(TEAM.mass)), TEAM)

    def advance(team, key):
        team = disturbance(key, team, 0.01)
        return team, team.external_force

    push = np.asarray(jax.lax.scan(advance, team, jax.random.split(KEY, 2000))[1])
    active = np.any(push != 0, axis=-1)
    begins = np.sum(active[1:] & ~active[:-1])
    np.testing.assert_allclose(begins / (200 * 20.0), 1.0, rtol=0.15)
    np.testing.assert_allclose(active.mean(), 0.1, rtol=0.15)
    assert np.abs(push).max() <= 0.5 * float(team.weight[0])


def test_pushes_are_added_to_the_force_at_the_start():
    disturbance, force = random_pushes(0.5, interval=0.1, duration=0.05), jnp.array([0.05, 0.0, -0.01])
    team = TEAM.replace(external_force=jnp.broadcast_to(force, TEAM.external_force.shape))
    team = jax.vmap(disturbance.start)(jax.random.split(KEY, len(team.mass)), team)

    def push(team, key):
        team = disturbance(key, team, 0.01)
        return team, team.external_force - force[None]

    found = jax.jit(lambda team: jax.lax.scan(push, team, jax.random.split(KEY, 200))[1])(team)
    calm = np.all(found == 0, axis=-1)
    assert 0.3 < calm.mean() < 0.9 and not np.allclose(found, 0)


@pytest.mark.slow
def test_a_push_accelerates_as_newton_says():
    env = make("hover", effects=("external_force",), tilt=0.0, speed=0.0, omega=0.0)
    _, world = env.reset(KEY)
    world = world.replace(params=world.params.replace(external_force=jnp.array([[0.027, 0, 0]])))
    vel = env.step(KEY, world, jnp.zeros((1, 4)))[1].drones.vel
    np.testing.assert_allclose(vel[0, 0] - world.drones.vel[0, 0], 1.0 * env.dt, rtol=1e-9)


def test_mistakes_are_named():
    with pytest.raises(ValueError, match="unknown parameter 'mas'; did you mean 'mass'"):
        scaled("mas", 0.9, 1.1)
    with pytest.raises(ValueError, match="unknown parameter 'mas'; did you mean 'mass'"):
        realistic_randomization(mas=(0.9, 1.1))
    with pytest.raises(ValueError, match=r"mass has shape .*lower and upper bound"):
        realistic_randomization(mass=0.9)
    with pytest.raises(ValueError, match=r"the range of mass is \(1.1, 0.9\); give the lower bound first"):
        scaled("mass", 1.1, 0.9)
    for randomization in scaled, shifted:
        with pytest.raises(ValueError, match=r"unknown parameter 'aux' \(known: air_density, collision_"):
            randomization("aux", 0.9, 1.1)


@pytest.mark.slow
def test_a_privileged_observation_has_no_noise_and_shows_the_drawn_parameters():
    randomize = (scaled("mass", 0.9, 1.1), constant_wind(2.0))
    env = make("hover", effects=("drag",), randomize=randomize, noise=sensor_noise())
    obs, world = env.reset(KEY)
    known = env.privileged_observation(world)
    assert known.params.shape == (1, env.privileged_size) == (1, 4)
    np.testing.assert_allclose(known.params[0, 0], world.params.mass[0] / env.params.mass[0] - 1, rtol=1e-12)
    np.testing.assert_array_equal(known.params[0, 1:], world.params.wind[0])
    plain = make("hover", effects=("drag",), randomize=randomize)
    np.testing.assert_allclose(known.obs, plain.reset(KEY)[0], rtol=0, atol=1e-15)
    assert np.abs(obs - known.obs).max() > 1e-4
    assert plain.reset(KEY)[0].shape == known.obs.shape and make("hover").privileged_size == 0


def rarely_twice_as_heavy(key, params):
    rare = jax.random.uniform(key) < 0.001
    return jax.lax.cond(rare, lambda params: params.replace(mass=2 * params.mass), lambda params: params, params)


@pytest.mark.parametrize(
    ("randomize", "drawn"),
    [
        (rarely_twice_as_heavy, ["mass"]),
        (jax.jit(rarely_twice_as_heavy), ["mass"]),
        (scaled("inertia", 0.5, 1.5), ["inertia"]),
        (jax.jit(constant_wind(1.0)), ["wind"]),
        (lambda key, params: params.replace(mass=2 * params.mass), []),
    ],
)
def test_drawn_parameters_are_found_however_rarely_they_differ(randomize, drawn):
    """From the program, not from what one key happens to draw; what is the same in every episode is not drawn."""
    leaves = jax.tree_util.tree_leaves_with_path(TEAM)
    found = zip(leaves, drawn_leaves([randomize], TEAM), strict=True)
    assert [jax.tree_util.keystr(path, simple=True) for (path, _), is_drawn in found if is_drawn] == drawn
    env = make("hover", effects=("drag",), randomize=(randomize,))
    assert env.privileged_size == sum(getattr(env.params, name).size for name in drawn)


def test_the_first_observation_has_the_noise_and_the_state_has_not():
    env = make("hover", observation=("velocity",), noise=lambda key, state: state.replace(vel=state.vel + 3))
    first = jit_unoptimized(lambda key: episode.first_observation(env, key, episode.start(env, key), None))
    obs, world = first(KEY)
    np.testing.assert_allclose(obs - world.drones.vel, 3, rtol=1e-6)
    assert jnp.all(jnp.abs(world.drones.vel) < 2)
