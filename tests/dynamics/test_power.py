"""The battery: charge is kept to rounding, power is what voltage and current give, and an empty one gives nothing."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, assert_finite, make_step

import jaxdrones as jd
from jaxdrones import State
from jaxdrones.dynamics.power import battery_power, open_circuit_voltage

DRAWN = jd.Model("drawn", lambda params: 0 * params.mass, lambda params, state, _: jd.battery_current(params, state))
MODELS = (jd.battery(), DRAWN)


def equipped(**numbers):
    params = jd.load_params("cf2x")
    constants = {"battery": jd.lithium_polymer(**numbers), "motors": jd.crazyflie_motors("2.1+")}
    return jd.repeat(params.replace(aux=constants), 2)


TEAM = equipped(slow_resistance=0.05)


@partial(jax.jit, static_argnums=(0, 4))
def fly(step, team, state, pwm, length):
    return jd.rollout(step, lambda params, memory, s, k: (memory, pwm), team, state, None, length)[0]


def flown(team, pwm, length, integrator=jd.semi_implicit_euler, charge=None, models=MODELS):
    step = make_step(rotors=jd.pwm_rotors, models=models, integrator=integrator)
    state = step.init(team, jd.State.at_rest([[0.0, 0, 1], [1.0, 0, 1]]))
    if charge is not None:
        aux = state.aux | {"battery": state.aux["battery"] | {"charge": jnp.full(2, charge)}}
        state = state.replace(aux=aux)
    return fly(step, team, state, jnp.broadcast_to(pwm, (2, 4)), length)


@pytest.mark.parametrize("integrator", [jd.semi_implicit_euler, jd.rk4], ids=["semi-implicit Euler", "rk4"])
@pytest.mark.slow
def test_the_charge_falls_by_the_integral_of_the_current(integrator):
    """1e-9 A s of 4 A s; measured 4e-13."""
    end = flown(TEAM, jnp.array([5e4, 4e4, 6e4, 5e4]), 480, integrator)
    used = TEAM.aux["battery"].capacity - end.aux["battery"]["charge"]
    assert used[0] > 1
    np.testing.assert_allclose(used, end.aux["drawn"], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_voltage_times_current_is_the_power():
    end = flown(TEAM, 5e4, 240)
    voltage, current, power = (jax.vmap(f)(TEAM, end) for f in (jd.battery_voltage, jd.battery_current, battery_power))
    np.testing.assert_allclose(voltage * current, power, rtol=1e-12)
    assert np.all(voltage < 4.2 - 0.2 * current) and np.all(current > 1)


def test_a_slow_drop_comes_to_the_slow_resistance_times_the_current():
    end = flown(equipped(slow_resistance=0.05, slow_time=0.1), 4e4, 480)
    current = jax.vmap(jd.battery_current)(TEAM, end)
    battery, slow_drop = TEAM.aux["battery"], end.aux["battery"]["slow_drop"]
    np.testing.assert_allclose(slow_drop, 0.05 * current, rtol=1e-3)
    at_rest = jax.vmap(open_circuit_voltage)(battery, end.aux["battery"]["charge"])
    voltage = jax.vmap(jd.battery_voltage)(TEAM, end)
    np.testing.assert_allclose(voltage, at_rest - slow_drop - battery.resistance * current, rtol=1e-12)


def test_three_cells_in_series_give_power_and_drop_by_their_common_current():
    """In NumPy, from 1.225 kg/m^3 and the voltage of three full cells: U (E - U) = R P, Q' = -I, T d' = R_s I - d."""
    params = jd.load_params("racer")
    battery = jd.lithium_polymer(
        capacity=5400, cells=3, resistance=0.04, slow_resistance=0.02, slow_time=9, efficiency=0.5, idle_power=2
    )
    params = params.replace(aux={"battery": battery})
    memory = {"charge": jnp.array(5400.0), "slow_drop": jnp.array(0.3)}
    state = State(
        *(jnp.zeros(k) for k in (3, 4, 3, 3)), rpm=jnp.array([9e3, 1e4, 1.1e4, 1.2e4]), aux={"battery": memory}
    )
    thrust = float(params.kf) * np.array([9e3, 1e4, 1.1e4, 1.2e4]) ** 2
    power = 2 + np.sum(thrust**1.5) / np.sqrt(2 * 1.225 * np.pi * float(params.prop_radius) ** 2) / 0.5
    source = 3 * 4.2 - 0.3
    voltage = (source + np.sqrt(source**2 - 4 * 0.04 * power)) / 2
    rate = jd.battery().rate(params, state, state.rpm)
    np.testing.assert_allclose(rate["charge"], -power / voltage, rtol=2e-3)  # a full cell has 4.2 V to 1e-4
    np.testing.assert_allclose(rate["slow_drop"], (0.02 * power / voltage - 0.3) / 9, rtol=2e-3)


def test_a_weaker_battery_lifts_less():
    strong, weak = (flown(equipped(resistance=r), 6e4, 240).rpm[0, 0] for r in (0.1, 0.5))
    assert weak < 0.93 * strong


@pytest.mark.slow
def test_an_empty_battery_stops_the_rotors_and_gives_no_more():
    end = flown(TEAM, 5e4, 4800, charge=-28.0)
    assert np.all(end.rpm < 100)
    assert np.all(end.aux["battery"]["charge"] > -0.04 * TEAM.aux["battery"].capacity)
    assert np.all(jax.vmap(jd.battery_current)(TEAM, end) < 0.1)


@pytest.mark.slow
def test_more_power_than_a_battery_has_is_its_highest():
    team = equipped(resistance=2.0)
    params, state = jax.tree.map(lambda x: x[0], (team, flown(team, 0.0, 1)))
    state = state.replace(rpm=jnp.full(4, 25e3))
    source = open_circuit_voltage(params.aux["battery"], state.aux["battery"]["charge"])
    np.testing.assert_allclose(jd.battery_voltage(params, state), source / 2, rtol=1e-6)
    assert_finite(jax.grad(jd.battery_voltage, argnums=(0, 1))(params, state))


@pytest.mark.slow
def test_a_voltage_at_rest_gives_the_charge():
    cell = jd.lithium_polymer(cells=3)
    charge = jnp.array([10.0, 200, 890])
    voltage = jax.vmap(open_circuit_voltage, (None, 0))(cell, charge)
    np.testing.assert_allclose(jax.vmap(jd.charge_at, (None, 0))(cell, voltage), charge, rtol=1e-9)
    slope = jax.grad(open_circuit_voltage, argnums=1)(cell, 200.0)
    np.testing.assert_allclose(jax.grad(jd.charge_at, argnums=1)(cell, voltage[1]), 1 / slope, rtol=1e-9)
    np.testing.assert_allclose(open_circuit_voltage(cell, cell.capacity), 3 * 4.2, rtol=1e-4)
    assert jd.charge_at(cell, 13.0) == cell.capacity and jd.charge_at(cell, 1.0) == 0


@pytest.mark.slow
def test_gradients_through_a_battery_are_those_of_differences():
    def height(resistance):
        return flown(equipped(resistance=resistance), 5e4, 60).pos[0, 2]

    h = 1e-5
    np.testing.assert_allclose(jax.grad(height)(0.3), (height(0.3 + h) - height(0.3 - h)) / (2 * h), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.float32
def test_in_single_precision_the_charge_is_kept_to_rounding():
    team = equipped()
    end = flown(team, 5e4, 480)
    assert end.aux["battery"]["charge"].dtype == jnp.float32
    np.testing.assert_allclose(900 - end.aux["battery"]["charge"], end.aux["drawn"], rtol=2e-2)


@pytest.mark.slow
def test_many_batteries_in_one_program_are_as_alone():
    def fly(pwm):
        return flown(TEAM, pwm, 20)

    pwm = jnp.array([3e4, 5e4, 6e4])
    alone = jax.tree.map(lambda *x: jnp.stack(x), *map(fly, pwm))
    for mapped in jax.vmap(fly), jd.over_worlds(fly):
        assert_close(mapped(pwm), alone, 1e-9)


def test_mistakes_are_named():
    with pytest.raises(ValueError, match=r"capacity of the battery is -1; give a positive number \(A s\)"):
        jd.lithium_polymer(capacity=-1)
    with pytest.raises(ValueError, match=r"efficiency of the battery is 30; give a number above 0 and at most 1"):
        jd.lithium_polymer(efficiency=30)  # percent
    with pytest.raises(ValueError, match=r"resistance of the battery is -0.1; give a number of at least 0 \(ohm\)"):
        jd.lithium_polymer(resistance=-0.1)
    bare = jd.repeat(jd.load_params("cf2x"), 2)
    with pytest.raises(ValueError, match=r"params.aux lacks 'battery'; found nothing; give .*lithium_polymer\(\)"):
        jd.make_step(models=(jd.battery(),)).init(bare, jd.State.at_rest([[0.0, 0, 1], [1.0, 0, 1]]))
