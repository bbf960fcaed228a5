"""Dryden turbulence: intensities and spectra of the specification at any control rate, and episodes with it."""

import dataclasses
import itertools
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_finite, assert_same_kind, jit_unoptimized, mostly_slow

import jaxdrones as jd
from jaxdrones.envs import make
from jaxdrones.envs.disturbances import random_pushes, scales
from jaxdrones.envs.randomize import constant_wind, scaled, shifted
from jaxdrones.sensing import Scene, Sphere

KEY = jax.random.key(0)
CF2X = jd.load_params("cf2x")
AXES = "uvw"
MEAN = np.array([3.0, 4.0, 0.0])
DRONES = 64


@lru_cache
def gusts(speed, altitude, airspeed, dt, length=20000):
    """(length, drones, 3) gusts along the mean wind, across it and upwards, m/s."""
    turbulence = jd.dryden(speed, altitude, airspeed)
    team = jd.repeat(jd.load_params("cf2x").replace(wind=jnp.array(MEAN)), DRONES)
    team = jax.jit(jax.vmap(turbulence.start))(jax.random.split(KEY, DRONES), team)

    def advance(team, key):
        team = turbulence(key, team, dt)
        return team, team.wind

    wind = jax.jit(lambda team, keys: jax.lax.scan(advance, team, keys)[1])(team, jax.random.split(KEY, length))
    gust = np.asarray(wind) - MEAN
    return np.stack([gust @ [0.6, 0.8, 0], gust @ [-0.8, 0.6, 0], gust[..., 2]], axis=-1)


def specified(axis, omega, speed, altitude, airspeed):
    """One-sided spectral density of MIL-F-8785C over the angular frequency, (m/s)^2 s."""
    feet = altitude / 0.3048
    length = altitude if axis == "w" else altitude / (0.177 + 0.000823 * feet) ** 1.2
    sigma = 0.1 * speed * (1 if axis == "w" else (0.177 + 0.000823 * feet) ** -0.4)
    x = length * omega / airspeed
    shape = 2 / (1 + x**2) if axis == "u" else (1 + 3 * x**2) / (1 + x**2) ** 2
    return sigma**2 * length / (np.pi * airspeed) * shape


CASES = [(7.7, 6.1, 5.0, 0.02), (7.7, 50.0, 20.0, 0.2), (15.4, 100.0, 8.0, 0.25)]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.slow
def test_intensities_are_those_of_the_specification(case):
    """3 %; 64 gusts of 20,000 steps, of which at least 70 length scales each are independent."""
    speed, altitude, *_ = case
    feet = altitude / 0.3048
    horizontal = 0.1 * speed / (0.177 + 0.000823 * feet) ** 0.4
    np.testing.assert_allclose(gusts(*case).std(axis=(0, 1)), [horizontal, horizontal, 0.1 * speed], rtol=0.03)


@pytest.mark.parametrize("case", mostly_slow(CASES, [CASES[1]]))
def test_spectra_are_those_of_the_specification(case):
    """10 %, in ten bands from 8 periods in a window up to the highest frequency, half of the sampling rate.

    Samples in time show the density at a frequency and at its images beyond the highest one: the specification is
    folded likewise. Up to a third of the highest frequency that is 7 % at most, and the density itself is compared.
    """
    dt, window = case[-1], 4000
    gust = gusts(*case)
    taper = np.hanning(window)[:, None, None]
    parts = gust.reshape(-1, window, DRONES, 3) * taper
    power = np.mean(np.abs(np.fft.rfft(parts, axis=1)) ** 2, axis=(0, 2)) * dt / np.sum(taper**2) / np.pi
    omega = 2 * np.pi * np.fft.rfftfreq(window, dt)
    sampling = 2 * np.pi / dt
    for i, axis in enumerate(AXES):
        plain = specified(axis, omega, *case[:-1])
        folded = sum(specified(axis, np.abs(omega + k * sampling), *case[:-1]) for k in range(-30, 31))
        for density, highest in (plain, sampling / 6), (folded, sampling / 2):
            edges = np.geomspace(omega[8], highest, 11)
            for low, high in itertools.pairwise(edges):
                band = (omega >= low) & (omega < high)
                np.testing.assert_allclose(np.mean(power[band, i] / density[band]), 1, atol=0.1, err_msg=axis)


@pytest.mark.slow
def test_an_episode_starts_within_the_turbulence():
    """The first gusts of 4,000 drones have the intensities, too; 3.3 % is three standard deviations."""
    turbulence = jd.dryden(10.0, 30.0)
    team = jd.repeat(jd.load_params("cf2x"), 4000)
    team = jax.vmap(turbulence.start)(jax.random.split(KEY, 4000), team)
    wind = turbulence(jax.random.key(1), team, 1e-3).wind
    np.testing.assert_allclose(wind.std(axis=0), [scales(10.0, 30.0)[axis][1] for axis in AXES], rtol=0.034)


@pytest.mark.slow
def test_a_step_of_any_length_keeps_the_intensity():
    """From the stationary state; 3.3 % is three standard deviations."""
    turbulence = jd.dryden(10.0, 30.0)

    def wind_after(dt):
        team = jd.repeat(jd.load_params("cf2x"), 4000)
        team = jax.vmap(turbulence.start)(jax.random.split(KEY, 4000), team)
        for key in jax.random.split(jax.random.key(1), 3):
            team = turbulence(key, team, dt)
        return team.wind

    sigma = np.array([scales(10.0, 30.0)[axis][1] for axis in AXES])
    for wind in jit_unoptimized(lambda: [wind_after(dt) for dt in (1e-6, 0.01, 5.0, 1e4)])():
        np.testing.assert_allclose(wind.std(axis=0), sigma, rtol=0.034)


@pytest.mark.float32
@pytest.mark.slow
def test_short_steps_hold_in_single_precision():
    """Gusts of 1 ms at 100 m are 1e-4 of a time constant apart: differences have the variance of a random walk."""
    turbulence = jd.dryden(10.0, 100.0, 5.0)
    team = jd.repeat(jd.load_params("cf2x"), 4000)
    team = jax.vmap(turbulence.start)(jax.random.split(KEY, 4000), team)
    before = turbulence(jax.random.key(1), team, 1e-3)
    after = turbulence(jax.random.key(2), before, 1e-3)
    assert after.wind.dtype == jnp.float32
    steps = [1e-3 * 5.0 / scales(10.0, 100.0)[axis][0] for axis in AXES]
    sigma = np.array([scales(10.0, 100.0)[axis][1] for axis in AXES])
    expected = sigma * np.sqrt(np.array([2, 3, 3]) * steps)
    np.testing.assert_allclose((after.wind - before.wind).std(axis=0), expected, rtol=0.04)


@pytest.mark.slow
def test_an_environment_flies_in_turbulence_that_starts_anew():
    env = make("hover", drones=2, effects=("drag",), disturbance=jd.dryden(7.7))
    _, world = env.reset(KEY)
    _, after, reward, *_ = env.step(KEY, world, jnp.zeros((2, 4)))
    assert_same_kind(after, world)
    assert_finite((after, reward))
    assert np.all(after.params.wind[0] != after.params.wind[1])
    other = env.reset(jax.random.key(1))[1].params.aux["dryden"]
    assert np.all(other["u"] != world.params.aux["dryden"]["u"])
    assert env.privileged_observation(after).params.shape == (2, env.privileged_size)
    assert "Dryden turbulence of 7.7 m/s" in jd.explain(env).physics["disturbance"]


def own_wind(key, params):
    return params.replace(wind=jax.random.normal(key, (3,), params.wind.dtype))


def own_gusts(key, params, dt):
    return params.replace(wind=jax.random.normal(key, params.wind.shape, params.wind.dtype))


WINDS = {
    "turbulence": dict(disturbance=jd.dryden(7.7)),
    "constant": dict(randomize=(constant_wind(3.0),)),
    "own randomization": dict(randomize=(own_wind,)),
    "own disturbance": dict(disturbance=own_gusts),
}


@pytest.mark.parametrize("name", WINDS)
def test_a_random_wind_without_an_effect_of_it_is_refused(name):
    with pytest.raises(ValueError, match="there is a random wind, and no effect depends on it; give an effect"):
        make("hover", effects=("ground_effect",), **WINDS[name])


def test_a_random_force_without_an_effect_of_it_is_refused():
    """Also one that replaces a field of an environment, in its first reset."""
    message = "there is a random external_force, and no effect depends on it; give an effect"
    with pytest.raises(ValueError, match=message):
        make("hover", randomize=(shifted("external_force", -0.1, 0.1),))
    env = dataclasses.replace(make("hover"), disturbance=random_pushes(0.3))
    with pytest.raises(ValueError, match=message):
        env.reset(jax.random.key(0))
    make("hover", disturbance=random_pushes(0.3))


def test_a_constant_wind_or_force_without_an_effect_of_it_is_refused():
    """It was ignored without a word, by a step and by an environment."""
    windy, pushed = (CF2X.replace(**{field: jnp.ones(3)}) for field in ("wind", "external_force"))
    step, team = jd.make_step(effects=(jd.external_force,)), jd.repeat(windy, 1)
    with pytest.raises(ValueError, match="there is a constant wind, and no effect depends on it; give an effect"):
        jax.eval_shape(lambda rpm: step(team, jd.State.at_rest(jnp.zeros((1, 3))), rpm), jnp.zeros((1, 4)))
    with pytest.raises(ValueError, match="there is a constant external_force, and no effect depends on it"):
        make("hover", vehicle=pushed, effects=("drag",))
    make("hover", vehicle=windy, effects=("drag",))


def gusty_rotors(params, state, command):
    return command + params.wind[0], 0 * command


@pytest.mark.parametrize("by", [dict(effects=(jax.jit(jd.inflow_thrust),)), dict(rotors=gusty_rotors)])
def test_a_random_wind_may_act_on_an_own_effect_or_on_rotors(by):
    make("hover", scene=lambda key: Scene.of(Sphere(pos=(3.0, 0, 1), radius=0.1)), **by, **WINDS["constant"])


def test_a_random_push_needs_no_effect_of_wind():
    make("hover", disturbance=random_pushes(0.3), randomize=(scaled("mass", 0.9, 1.1),))


def test_mistakes_are_named():
    with pytest.raises(
        ValueError, match=r"altitude of the turbulence is 1; give a number of at least 3.048 and at most"
    ):
        jd.dryden(7.7, altitude=1)
    with pytest.raises(ValueError, match=r"speed of the wind at 20 ft is 0; give a positive number \(m/s\)"):
        jd.dryden(0)
    team = jd.repeat(jd.load_params("cf2x"), 2)
    with pytest.raises(ValueError, match=r"params.aux lacks 'dryden', the memory of a disturbance"):
        jd.dryden(7.7)(KEY, team, 0.01)
