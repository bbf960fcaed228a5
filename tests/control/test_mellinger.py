"""The Mellinger controller of the Crazyflie's firmware."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop import hovering, make_step, one, team_of
from helpers import VEHICLES, jit_unoptimized

import jaxdrones
from jaxdrones import State, rotation
from jaxdrones.control import Setpoint, firmware_motors, firmware_pid, for_team, mellinger
from jaxdrones.tasks.curves import setpoint_on

DT = 0.002
LEVEL = State(*(jnp.array(x) for x in ([0.0, 0, 1], [0.0, 0, 0, 1], [0.0, 0, 0], [0.0, 0, 0], [0.0] * 4)))


def flight(module, vehicles, target, seconds, **constants):
    """The states of drones of these vehicles after each control step, by scaled gains, (steps, n, ...)."""
    team, n = team_of(*vehicles), len(vehicles)
    team = team.replace(**{name: jnp.full(n, value) for name, value in constants.items()})
    gains = jax.tree.map(lambda *x: jnp.stack(x), *(module.gains(one(team, i)) for i in range(n)))
    step = make_step(dt=DT, rotors=jaxdrones.lagging_rotors)

    def control(team, memory, state, k):
        call = partial(module.control, setpoint=target(k * DT), dt=DT)
        return jax.vmap(call)(gains, team, memory, state)

    start, memory = hovering(team), for_team(module.init(), n)
    return jit_unoptimized(lambda: jaxdrones.rollout(step, control, team, start, memory, round(seconds / DT))[1])()


@pytest.fixture(scope="module")
def placed():
    target = Setpoint.at(jnp.array([0.3, -0.2, 1.2]), yaw=jnp.array(0.4))
    return flight(mellinger, VEHICLES, lambda t: target, 8, rotor_rise_time=0.041, rotor_fall_time=0.041)


@pytest.mark.slow
@pytest.mark.parametrize("i", range(len(VEHICLES)), ids=VEHICLES)
def test_every_vehicle_comes_to_its_place_and_heading(placed, i):
    off = np.linalg.norm(np.asarray(placed.pos[:, i]) - [0.3, -0.2, 1.2], axis=-1)
    yaw = np.asarray(jax.vmap(rotation.to_rpy)(placed.quat[:, i]))[:, 2]
    assert np.max(off[-500:]) < 0.03  # m; the integrator of the weight is slow
    assert np.max(np.abs(yaw[-500:] - 0.4)) < 0.01
    assert np.max(np.std(placed.rpm[-500:, i], axis=0)) < 5e-3 * np.mean(placed.rpm[-500:, i])


@pytest.mark.parametrize("propellers", firmware_motors.PROPELLERS)
def test_it_knows_the_mass_of_the_vehicle_with_each_kind_of_propellers(propellers):
    gains = mellinger.gains(propellers=propellers)
    assert 0.025 < gains.mass < 0.035  # kg
    np.testing.assert_allclose(gains.weight, 9.81 * gains.mass)


@pytest.mark.slow
def test_it_follows_what_the_pid_trails():
    """A circle of 0.5 m in 4 s, 0.8 m/s."""

    def target(t):
        return setpoint_on(
            lambda t: jnp.stack([0.5 * jnp.sin(t * np.pi / 2), 0.5 - 0.5 * jnp.cos(t * np.pi / 2), 1.0]), t
        )

    def off(module):
        flown = flight(module, ("cf2x",), target, 8, rotor_rise_time=0.041, rotor_fall_time=0.041)
        wanted = jax.vmap(target)(DT * jnp.arange(1, 4001)).pos
        return float(np.sqrt(np.mean(np.sum(np.asarray(flown.pos[:, 0] - wanted)[2000:] ** 2, axis=-1))))

    assert off(mellinger) < 0.08
    assert 0.3 < off(firmware_pid) < 0.45  # 0.8 m/s times 0.5 s


@pytest.mark.parametrize("vehicle", [None, "hb"])
def test_without_an_error_it_commands_the_weight_that_it_believes(vehicle):
    """For a scaled vehicle, too, it is the command of a Crazyflie, as full command is a scaled thrust."""
    gains = mellinger.gains(vehicle and jaxdrones.load_params(vehicle))
    _, command = mellinger.pwm(gains, mellinger.init(), LEVEL, Setpoint.at(LEVEL.pos))
    np.testing.assert_allclose(command.pwm, 132000 * 0.029 * 9.81, rtol=1e-12)
    np.testing.assert_allclose(command.attitude, 0, atol=1e-12)


def test_a_target_ahead_lowers_the_nose():
    _, command = mellinger.pwm(mellinger.gains(), mellinger.init(), LEVEL, Setpoint.at(jnp.array([0.5, 0, 1.0])), 3.8)
    assert command.attitude[1] < -1 and command.torque[1] > 0
    assert jnp.min(command.pwm[1:3]) > jnp.max(command.pwm[jnp.array([0, 3])])


def test_a_lasting_heading_error_is_integrated():
    target, memory, torques = Setpoint.at(LEVEL.pos, yaw=jnp.array(0.1)), mellinger.init(), []
    for _ in range(2):
        memory, command = mellinger.pwm(mellinger.gains(), memory, LEVEL, target, dt=DT)
        torques.append(float(command.torque[2]))
    np.testing.assert_allclose(torques[1] / torques[0], (60000 + 2 * 500 * DT) / (60000 + 500 * DT), rtol=1e-9)
    assert torques[0] > 0


def test_without_thrust_the_motors_stand_still_and_integrators_are_empty():
    turned = LEVEL.replace(quat=rotation.from_rpy(jnp.array([0.1, 0, 0.2])))
    full = mellinger.init().replace(pos_integral=jnp.ones(3), attitude_integral=jnp.ones(3))
    memory, command = mellinger.pwm(mellinger.gains(), full, turned, Setpoint.at(jnp.array([0, 0, -9.0])))
    for x in command.pwm, command.torque, memory.pos_integral, memory.attitude_integral:
        np.testing.assert_array_equal(x, 0)


def test_rates_are_damped_from_the_first_call_on_without_a_kick_and_up_to_the_limit_of_the_torque():
    gains, target = mellinger.gains(), Setpoint.at(LEVEL.pos)
    for rate in 1.0, 5.0:
        turning = LEVEL.replace(omega=jnp.array([rate, 0, 0]))
        memory = mellinger.init()
        for _ in range(2):
            memory, command = mellinger.pwm(gains, memory, turning, target)
            np.testing.assert_allclose(command.torque, [-min(20000 * rate, 32000), 0, 0], rtol=1e-9, atol=1e-6)


def test_an_acceleration_of_the_setpoint_takes_its_thrust_and_the_heading_error_is_integrated_up_to_a_limit():
    target = Setpoint.at(LEVEL.pos, acc=jnp.array([0, 0, 2.0]))
    wound = mellinger.init().replace(attitude_integral=jnp.array([9.0, -9, 2000]))
    memory, command = mellinger.pwm(mellinger.gains(), wound, LEVEL, target)
    np.testing.assert_allclose(command.thrust, 132000 * 0.029 * 11.81)
    np.testing.assert_array_equal(memory.attitude_integral, [1, -1, 1500])
