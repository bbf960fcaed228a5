"""Motors: thrust curves and their inverses, PWM at any supply, and failures of any rotors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_finite, make_step

import jaxdrones as jd
from jaxdrones.dynamics import ROTORS
from jaxdrones.thrust_curves import THRUST_CURVES

CF2X = jd.load_params("cf2x")
STATE = jax.tree.map(lambda x: x[0], jd.State.at_rest([[0.0, 0, 1]]))
each_curve = pytest.mark.parametrize("propellers", THRUST_CURVES)


def with_motors(supply=3.0, **aux):
    return CF2X.replace(aux={"motors": jd.crazyflie_motors("2.1+", supply)} | aux)


@each_curve
@pytest.mark.slow
def test_the_voltage_of_a_thrust_gives_that_thrust(propellers):
    motors = jd.crazyflie_motors(propellers)
    thrust = jnp.linspace(0, 0.2, 9)
    np.testing.assert_allclose(motors.thrust(motors.voltage(thrust)), thrust, rtol=0, atol=1e-15)
    slope = jax.vmap(jax.grad(motors.voltage))(thrust[1:]) * jax.vmap(jax.grad(motors.thrust))(
        motors.voltage(thrust[1:])
    )
    np.testing.assert_allclose(slope, 1, rtol=1e-9)


@pytest.mark.float32
@each_curve
@pytest.mark.slow
def test_the_inverse_holds_in_single_precision(propellers):
    motors = jd.crazyflie_motors(propellers)
    thrust = jnp.linspace(0.001, 0.2, 50)
    np.testing.assert_allclose(motors.thrust(motors.voltage(thrust)), thrust, rtol=0, atol=3e-7)


def test_the_largest_thrust_of_a_loaded_crazyflie_is_the_one_that_was_flown():
    """0.1125 N at full PWM on a battery of NanoBench (`B2_circle_fast_rep2`) at 3.0 V, within 1 %."""
    np.testing.assert_allclose(jd.crazyflie_motors("2.1+").thrust(jnp.array(3.0)), 0.1125, rtol=1e-2)


def test_pwm_is_a_share_of_the_supply_and_ends_at_65535():
    params = with_motors(supply=3.0).replace(max_rpm=jnp.array(jnp.inf))
    command = jnp.array([-100.0, 0.5 * 65535, 65535, 80000])
    _, rate = jd.pwm_rotors(params, STATE, command)
    steady = rate * params.rotor_rise_time  # from rest
    motors = params.aux["motors"]
    np.testing.assert_allclose(params.kf * steady**2, motors.thrust(jnp.array([0, 1.5, 3.0, 3.0])), rtol=1e-12)
    assert steady[0] == 0


def test_battery_compensation_gives_the_same_thrust_at_any_voltage():
    wanted = jnp.array([0.03, 0.05, 0.06, 0.07])
    reached = []
    for charge in 850.0, 300.0:
        params = with_motors(battery=jd.lithium_polymer())
        aux = {"battery": {"charge": jnp.array(charge), "slow_drop": jnp.array(0.0)}}
        state = STATE.replace(aux=aux, rpm=jnp.full(4, 14e3))
        pwm = jd.pwm_of_thrust(params, state, wanted)
        state_rate = jd.pwm_rotors(params, state, pwm)[1]
        lag = jnp.where(state_rate > 0, params.rotor_rise_time, params.rotor_fall_time)
        reached.append((pwm, params.kf * (state.rpm + lag * state_rate) ** 2))
    np.testing.assert_allclose([thrust for _, thrust in reached], [wanted, wanted], rtol=1e-9)
    assert np.all(reached[1][0] > 1.02 * reached[0][0])


ALL_ROTORS = ROTORS | {"pwm": jd.pwm_rotors}


@pytest.mark.parametrize("name", ALL_ROTORS)
def test_sound_rotors_are_as_without_failures_and_a_dead_one_gets_no_command(name):
    rotors = ALL_ROTORS[name]
    state = STATE.replace(rpm=jnp.full(4, 15e3))
    command = jnp.array([15e3, 16e3, 17e3, 18e3])
    sound, ill = (with_motors(rotor_health=jnp.array([1.0, 1, 1, last])) for last in (1, 0))
    for a, b in zip(jd.failing(rotors)(sound, state, command), rotors(sound, state, command), strict=True):
        np.testing.assert_array_equal(a, b)
    dead = rotors(ill, state, command.at[3].set(0))
    for a, b in zip(jd.failing(rotors)(ill, state, command), dead, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_a_drone_with_a_dead_rotor_turns_over_and_its_gradient_in_the_health_is_finite():
    team = jd.repeat(with_motors(rotor_health=jnp.ones(4)), 1)
    step = make_step(rotors=jd.failing(jd.lagging_rotors))
    start = jd.State.at_rest([[0.0, 0, 1]]).replace(rpm=jnp.full((1, 4), CF2X.hover_rpm))

    def end(health):
        ill = team.replace(aux=team.aux | {"rotor_health": health})
        hover = jnp.full((1, 4), CF2X.hover_rpm)
        return jd.rollout(step, lambda params, memory, s, k: (memory, hover), ill, start, None, 60)[0]

    np.testing.assert_allclose(end(jnp.ones((1, 4))).omega, 0, atol=1e-9)
    fallen = end(jnp.array([[0.0, 1, 1, 1]]))  # front right
    assert fallen.omega[0, 0] > 1 and fallen.rpm[0, 0] < 0.7 * CF2X.hover_rpm
    slope = jax.grad(lambda health: end(health).omega[0, 0])(jnp.full((1, 4), 0.9))
    assert_finite(slope)
    assert slope[0, 0] * slope[0, 3] < 0


def test_mistakes_are_named():
    with pytest.raises(ValueError, match=r"unknown propellers '2.2'.*known: 2.1, 2.1\+, thrust upgrade"):
        jd.crazyflie_motors("2.2")
    with pytest.raises(ValueError, match="does not rise everywhere; give a cubic whose slope is positive"):
        jd.cubic_motors([0.0, 0.1, -0.2, 0.01])
    with pytest.raises(ValueError, match=r"coefficients of the thrust curve has shape \(3,\); expected \(4,\)"):
        jd.cubic_motors([0.0, 0.1, 0.2])
    with pytest.raises(ValueError, match=r"params.aux lacks 'motors'; found nothing"):
        jd.pwm_rotors(CF2X, STATE, jnp.zeros(4))
    with pytest.raises(ValueError, match=r"params.aux lacks 'rotor_health'; found motors"):
        jd.failing(jd.pwm_rotors)(with_motors(), STATE, jnp.zeros(4))
    team, step = jd.repeat(with_motors(), 1), jd.make_step(rotors=jd.failing(jd.instant_rotors))
    for wrong in 1.01, -0.01, jnp.nan:
        ill = team.replace(aux={"rotor_health": jnp.array([[1.0, 0, wrong, 1]])})
        with pytest.raises(
            ValueError, match=r"params.aux\['rotor_health'\] is \[\[1.0, 0.0, .* give numbers from 0 to 1"
        ):
            step(ill, jd.State.at_rest([[0.0, 0, 1]]), jnp.zeros((1, 4)))
