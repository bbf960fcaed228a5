"""Gains by the gradient of the simulation."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop import make_step

import jaxdrones
from jaxdrones import State
from jaxdrones.control import CONTROLLERS, for_team, rates
from jaxdrones.optimal import tune, tuning
from jaxdrones.tasks.curves import RANDOM_NUMBERS, SHAPES, setpoint_on

HZ = 500
FEW = dict(control_hz=100, iterations=3)


def errors(controller, params, gains):
    """Root mean square distance, m, from a place 0.6 m away and from a curve that was not in the battery."""
    module, team = CONTROLLERS[controller], jaxdrones.repeat(params, 1)
    random = jnp.asarray(np.random.default_rng(7).uniform(-1, 1, RANDOM_NUMBERS))
    step = make_step(dt=1 / HZ, rotors=jaxdrones.lagging_rotors)

    def off(point, start):
        target = partial(setpoint_on, point)
        first = target(jnp.zeros(()))

        def control(team, memory, state, k):
            call = partial(module.control, gains, setpoint=target((k + 1) / HZ), dt=1 / HZ)
            return jax.vmap(call)(team, memory, state)

        state = State.at_rest((first.pos + start)[None])
        state = state.replace(vel=first.vel[None], rpm=jnp.full((1, 4), 1.0) * params.hover_rpm)
        flown = jax.jit(lambda: jaxdrones.rollout(step, control, team, state, for_team(module.init(), 1), 8 * HZ)[1])()
        wanted = jax.vmap(point)(jnp.arange(1, 8 * HZ + 1) / HZ)
        return float(np.sqrt(np.mean(np.sum(np.asarray(flown.pos[:, 0] - wanted) ** 2, axis=-1))))

    def curve(t):
        return SHAPES["polynomial"](random, t / 14)

    return off(lambda t: jnp.zeros(3) * t, jnp.array([0.4, -0.3, 0.3])), off(curve, jnp.zeros(3))


def of_test_flights(module, params, *gains):
    """The mean errors of the flights by which gains are costs."""
    sets = jax.tree.map(lambda *x: jnp.repeat(jnp.stack(x)[:, None], tuning._FLIGHTS, axis=1), *gains)
    hz, seconds = FEW["control_hz"], tuning._EVALUATION_SECONDS
    errors_of = jax.jit(lambda: tuning._errors_of_flights(module, params, hz, seconds, sets))
    return jnp.mean(errors_of(), axis=1).tolist()


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.parametrize(
    ("controller", "vehicle"),
    [
        ("geometric", "racer"),
        ("rates", "hb"),
        ("simple_pid", "racer"),
        ("firmware_pid", "hb"),
        ("mellinger", "hb"),
        ("pid", "cf2x"),
    ],
)
def test_tuned_gains_hover_and_track_better_than_the_controllers_own(controller, vehicle):
    params = jaxdrones.load_params(vehicle)
    before = errors(controller, params, tuning.start(CONTROLLERS[controller], params))
    tuned = errors(controller, params, tune(params, controller))
    assert tuned[0] < before[0] and tuned[1] < 0.8 * before[1], (before, tuned)


@pytest.mark.slow
def test_a_few_iterations_lower_the_error_and_a_second_vehicle_compiles_nothing():
    racer, hb = (jaxdrones.load_params(vehicle) for vehicle in ("racer", "hb"))
    tuned = tune(racer, "rates", **FEW)
    compiled = tuning._compiled()._cache_size()
    before, after = of_test_flights(rates, racer, rates.gains(), tuned)
    assert after < before - 0.1
    for_hb = tune(hb, rates, **FEW)  # by its module
    assert tuning._compiled()._cache_size() == compiled
    assert not np.allclose(for_hb.vel, tuned.vel)


def test_no_gradient_of_a_flight_is_longer_than_the_limit_and_broken_ones_do_not_count():
    steep = tuning._clipped({"pos": jnp.array([3e5, 4e5]), "vel": jnp.zeros(2)})
    np.testing.assert_allclose(steep["pos"], [0.6 * tuning._MAX_GRAD_NORM, 0.8 * tuning._MAX_GRAD_NORM], rtol=1e-6)
    gentle = {"pos": jnp.array([0.3, 0.4])}
    np.testing.assert_array_equal(tuning._clipped(gentle)["pos"], gentle["pos"])
    for broken in jnp.nan, jnp.inf:
        assert not np.any(tuning._clipped({"pos": jnp.array([broken, 1.0]), "vel": jnp.ones(2)})["vel"])


def test_gains_with_which_one_flight_becomes_much_worse_are_not_the_best():
    start, better, lost, broken = [-3.0, -3.0], [-3.5, -2.9], [-9.0, 3.5], [-9.0, jnp.nan]
    costs_of = jax.jit(tuning._costs)
    costs = np.asarray(costs_of(jnp.array([start, better, lost, broken])))
    np.testing.assert_allclose(costs[:3], [-3.0, -3.2, 3.25])
    assert np.isinf(costs[3]) and np.argmin(costs) == 1
    assert np.argmin(costs_of(jnp.array([[-3.0, jnp.inf], [-2.0, 4.0]]))) == 1  # the start itself breaks


def test_what_cannot_be_tuned_is_refused():
    hb = jaxdrones.load_params("hb")
    with pytest.raises(ValueError, match="mrac has no gains that could be tuned; give one of pid, simple_pid, geo"):
        tune(hb, "mrac")
    with pytest.raises(ValueError, match=r"unknown controller 'lqr' \(known: firmware_pid, geometric"):
        tune(hb, "lqr")
    with pytest.raises(ValueError, match="has no gains that could be tuned; give one of"):
        tune(hb, rates.gains())
    with pytest.raises(ValueError, match=r"pid commands the PWM of a Crazyflie.*tune another controller"):
        tune(hb, "pid")
    with pytest.raises(ValueError, match=r"params.mass has shape \(2,\).*single drone"):
        tune(jaxdrones.repeat(hb, 2), "geometric")
    with pytest.raises(ValueError, match=r"control_hz is 50.*at least 100"):
        tune(hb, "geometric", control_hz=50)
