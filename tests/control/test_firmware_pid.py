"""The firmware's PID: against a recorded flight, and loop by loop."""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop import hovering, make_step, one, team_of
from helpers import VEHICLES, assert_finite, jit_optimized, jit_unoptimized

import jaxdrones
from jaxdrones import State, rotation
from jaxdrones.control import Setpoint, firmware_loops, firmware_motors, firmware_pid, for_team, mellinger
from jaxdrones.control.allocation import mixer
from jaxdrones.thrust_curves import thrust_at, voltage_for

RECORDED = Path(__file__).parent / "recorded" / "B10_lissajous_slow_rep1_from_take_off.npz"  # NanoBench, BSD-3
DT = 0.002
LEVEL = State(*(jnp.array(x) for x in ([0.0, 0, 1], [0.0, 0, 0, 1], [0.0, 0, 0], [0.0, 0, 0], [0.0] * 4)))


def setpoint(pos=(0.0, 0.0, 1.0), yaw=0.0):
    return Setpoint.at(jnp.array(pos), yaw=jnp.array(yaw))


@jit_unoptimized
def commanded(gains, est, ref_pos, ref_yaw, vbat):
    """What is commanded along a log of 100 Hz, from integrators that are empty where it begins."""

    def row(memory, log):
        est, ref_pos, ref_yaw, vbat = log
        call = partial(firmware_pid.pwm, gains)
        target = Setpoint.at(ref_pos, yaw=ref_yaw)
        memory, commands = jax.lax.scan(lambda memory, _: call(memory, est, target, vbat), memory, None, length=5)
        return memory, one(commands)

    return jax.lax.scan(row, firmware_pid.init(), (est, ref_pos, ref_yaw, vbat))[1]


@pytest.fixture(scope="module")
def flown():
    with np.load(RECORDED) as arrays:
        log = {name: arrays[name].astype(float) for name in arrays}
    quat = log["est_quat"] / np.linalg.norm(log["est_quat"], axis=1, keepdims=True)
    est = State(log["est_pos"], quat, log["est_vel"], log["gyro"], np.zeros_like(quat))
    return log, commanded(firmware_pid.gains(), est, log["ref_pos"], log["ref_yaw"], log["vbat"])


def test_the_attitude_is_asked_for_that_the_vehicle_asked_for(flown):
    log, command = flown
    off = np.asarray(command.attitude)[:, :2] - log["cmd"][:, :2]
    assert np.max(np.sqrt(np.mean(off[2:] ** 2, axis=0))) < 0.3  # degrees; measured: 0.2, most of it gaps of the log


def test_the_thrust_is_asked_for_that_the_vehicle_asked_for(flown):
    """Its integrator drifts with the gaps of the log: 2 % in 12 s."""
    log, command = flown
    off = np.asarray(command.thrust) - log["cmd"][:, 3]
    assert np.sqrt(np.mean(off[2:] ** 2)) < 0.02 * np.mean(log["cmd"][:, 3])


def test_duty_cycles_make_the_thrust_that_was_logged_at_every_voltage(flown):
    log, command = flown
    motor = firmware_motors.motor("2.1+")
    flying = slice(500, None)
    voltage = np.array(jax.jit(filtered)(log["vbat"]))
    thrust = thrust_at(motor.thrust, log["pwm"] / 65535 * voltage[:, None]).mean(axis=1)[flying]
    np.testing.assert_allclose(np.mean(thrust / log["cmd"][flying, 3] * 65535), motor.max_thrust, rtol=1e-3)
    again = np.asarray(command.pwm).mean(axis=1)[flying].mean()
    np.testing.assert_allclose(again, log["pwm"].mean(axis=1)[flying].mean(), rtol=0.02)


def filtered(vbat):
    keep = 0.99**10  # of 10 ms
    return jax.lax.scan(lambda v, x: (x + keep * (v - x),) * 2, vbat[0], vbat)[1]


@pytest.mark.parametrize("propellers", firmware_motors.PROPELLERS)
def test_the_voltage_for_a_thrust_gives_that_thrust(propellers):
    motor = firmware_motors.motor(propellers)
    thrust = jnp.linspace(motor.min_thrust, motor.max_thrust, 50)
    voltage = voltage_for(motor.thrust, thrust)
    np.testing.assert_allclose(thrust_at(motor.thrust, voltage), thrust, rtol=1e-11)
    assert jnp.all(jnp.diff(voltage) > 0) and 0 < voltage[0] < voltage[-1] < 4.2
    duty = firmware_motors.duty_cycle(motor, 30000 * jnp.ones(4), jnp.array(3.7))
    np.testing.assert_allclose(
        thrust_at(motor.thrust, duty / 65535 * 3.7), 30000 / 65535 * motor.max_thrust, rtol=1e-11
    )
    assert not jnp.any(firmware_motors.duty_cycle(motor, jnp.full(4, 30000.0), jnp.array(1.0)))
    assert not jnp.any(firmware_motors.duty_cycle(motor, jnp.full(4, 1000.0), jnp.array(3.7)))


def test_a_thrust_that_is_too_high_is_given_up_and_the_attitude_kept():
    commands = jnp.array([70000.0, 60000.0, 50000.0, 100.0])
    np.testing.assert_allclose(firmware_motors.within_range(commands), [65535, 55535, 45535, 0])
    np.testing.assert_allclose(firmware_motors.within_range(commands / 2), commands / 2)


def test_the_mixing_of_the_firmware_is_that_of_its_rotors():
    torque = jnp.array([100.0, 10.0, 1.0])
    from_rotors = firmware_motors.mix(jnp.array(3e4), torque, mixer(jaxdrones.load_params("cf2x")))
    np.testing.assert_allclose(firmware_motors.mix(jnp.array(3e4), torque), from_rotors, rtol=1e-12)


def test_the_slow_loops_run_at_every_fifth_call():
    memory, thrust = firmware_pid.init(), []
    call = jit_unoptimized(partial(firmware_pid.pwm, firmware_pid.gains()))
    for k in range(20):
        memory, command = call(memory, LEVEL.replace(pos=jnp.array([0, 0, 1 - 0.01 * k])), setpoint())
        thrust.append(float(command.thrust))
    steps = np.flatnonzero(np.diff(thrust))
    np.testing.assert_array_equal(steps, [4, 9, 14])


@pytest.mark.parametrize("dt", [DT, 0.03])
def test_a_position_is_followed_at_once_after_an_attitude_was_for_10_ms(dt):
    call = partial(firmware_pid.pwm, firmware_pid.gains(), dt=dt)
    memory = firmware_pid.init().replace(age=jnp.array(0.004))
    for _ in range(3):
        memory, _ = call(memory, LEVEL, firmware_pid.Attitude(jnp.zeros(3), jnp.array(36000.0)))
    memory, command = call(memory, LEVEL, setpoint((0.5, 0, 1)))
    np.testing.assert_allclose(command.attitude[:2], [0, -20], atol=1e-9)
    np.testing.assert_allclose(memory.vel_integral[0], max(dt, 0.01))  # of an error of 1 m/s over a period


@pytest.fixture(scope="module")
def teams():
    """Where drones of all vehicles are after each control step of 8 s of flight by scaled gains, lagging rotors."""
    team = team_of(*VEHICLES)
    gains = jax.tree.map(lambda *x: jnp.stack(x), *(firmware_pid.gains(one(team, i)) for i in range(len(VEHICLES))))
    step = make_step(dt=DT, rotors=jaxdrones.lagging_rotors)
    target = setpoint((0.3, -0.2, 1.2), 0.4)

    def control(team, memory, state, k):
        return jax.vmap(partial(firmware_pid.control, setpoint=target, dt=DT))(gains, team, memory, state)

    memory = for_team(firmware_pid.init(), len(VEHICLES))
    return jit_unoptimized(lambda: jaxdrones.rollout(step, control, team, hovering(team), memory, 4000)[1])()


@pytest.mark.parametrize("i", range(len(VEHICLES)), ids=VEHICLES)
@pytest.mark.slow
def test_every_vehicle_comes_to_its_place_and_heading(teams, i):
    off = np.linalg.norm(np.asarray(teams.pos[:, i]) - [0.3, -0.2, 1.2], axis=-1)
    yaw = np.asarray(jax.vmap(rotation.to_rpy)(teams.quat[:, i]))[:, 2]
    assert np.max(off[-500:]) < 0.03  # m; the integrator of height takes tens of seconds
    assert np.max(np.abs(yaw[-500:] - 0.4)) < 0.02
    assert np.max(np.std(teams.rpm[-500:, i], axis=0)) < 5e-3 * np.mean(teams.rpm[-500:, i])


@pytest.mark.slow
def test_velocities_attitudes_and_rates_are_flown():
    params = jaxdrones.load_params("cf2x")
    team = jaxdrones.repeat(params, 1)
    step = make_step(dt=DT, rotors=jaxdrones.lagging_rotors)

    @partial(jax.jit, static_argnums=1)
    def after(target, steps):
        def control(team, memory, state, k):
            fly = partial(firmware_pid.control, firmware_pid.gains(), setpoint=target, dt=DT)
            return jax.vmap(fly)(team, memory, state)

        memory = for_team(firmware_pid.init(), 1)
        return one(one(jaxdrones.rollout(step, control, team, hovering(team), memory, steps)[1], -1))

    vel = jnp.array([0.4, -0.3, 0.2])
    np.testing.assert_allclose(after(firmware_pid.Velocity(vel, jnp.array(0.5)), 4000).vel, vel, atol=0.02)
    rpy = jnp.array([0.1, -0.15, 0.3])
    tilted = after(firmware_pid.Attitude(rpy, jnp.array(36000.0)), 2500)
    np.testing.assert_allclose(rotation.to_rpy(tilted.quat), rpy, atol=0.02)
    omega = jnp.array([0.5, -0.4, 0.0])
    np.testing.assert_allclose(after(firmware_pid.Rates(omega, jnp.array(36000.0)), 150).omega, omega, atol=0.05)
    omega = jnp.array([0.0, 0.0, 0.5])
    np.testing.assert_allclose(after(firmware_pid.Rates(omega, jnp.array(36000.0)), 500).omega, omega, atol=0.05)


def per_axis(by_pos=(True, True, True), tilt=False, rates=(False, False), direct=False, **given):
    flags = dict(by_pos=by_pos, tilt_given=tilt, rates_given=rates, thrust_given=direct)
    zero = dict(pos=[0.0, 0, 0], vel=[0.0, 0, 0], rpy=[0.0, 0, 0], omega=[0.0, 0, 0], thrust=0.0)
    return firmware_pid.PerAxis(**{name: jnp.array(x) for name, x in (zero | flags | given).items()})


MODES = {
    "positions": (setpoint([0.4, -0.3, 1.2], 0.5), per_axis(pos=[0.4, -0.3, 1.2], rpy=[9.0, 9, 0.5])),
    "velocities": (
        firmware_pid.Velocity(jnp.array([0.4, -0.3, 0.2]), jnp.array(0.5)),
        per_axis((False,) * 3, vel=[0.4, -0.3, 0.2], rpy=[9.0, 9, 0.5]),
    ),
    "attitudes": (
        firmware_pid.Attitude(jnp.array([0.2, -0.1, 0.5]), jnp.array(4e4)),
        per_axis(tilt=True, direct=True, rpy=[0.2, -0.1, 0.5], thrust=4e4),
    ),
    "no thrust": (firmware_pid.Attitude(jnp.zeros(3), jnp.zeros(())), per_axis(tilt=True, direct=True)),
}


@pytest.mark.parametrize("name", MODES)
def test_modes_for_each_axis_give_what_the_set_points_of_all_axes_give(name):
    gains, tilted = firmware_pid.gains(), LEVEL.replace(quat=rotation.from_rpy(jnp.array([0.1, -0.2, 0.3])))

    def row(memories, omega):
        state = tilted.replace(omega=omega)
        steps = [firmware_pid.pwm(gains, memory, state, s) for memory, s in zip(memories, MODES[name], strict=True)]
        return [memory for memory, _ in steps], [command.pwm for _, command in steps]

    omegas = jnp.array([[0.0, 0, 0], [0.3, -0.2, 0.1]]).repeat(4, axis=0)
    by_axis, of_all = jit_unoptimized(lambda: jax.lax.scan(row, [firmware_pid.init()] * 2, omegas)[1])()
    np.testing.assert_allclose(by_axis, of_all)


def test_a_mode_of_one_axis_leaves_the_others_alone():
    gains = firmware_pid.gains()

    pwm = jit_unoptimized(firmware_pid.pwm)

    def command(**given):
        return pwm(gains, firmware_pid.init(), LEVEL, per_axis(**given))[1]

    hover = dict(by_pos=(False, False, True), pos=[5.0, 5, 1.2], vel=[0.4, -0.3, 5])  # as hover set-points are
    mixed = command(**hover)
    memory, _ = pwm(gains, firmware_pid.init(), LEVEL, per_axis(**hover))
    np.testing.assert_allclose(memory.pos_integral, [0, 0, 0.2 * 0.01], atol=1e-12)
    assert command(tilt=True, direct=True, thrust=7e4).thrust == firmware_motors.FULL
    along, up = command(by_pos=(False,) * 3, vel=[0.4, -0.3, 0]), command(pos=[0.0, 0, 1.2])
    np.testing.assert_allclose(mixed.attitude, along.attitude)
    np.testing.assert_allclose(mixed.thrust, up.thrust)
    tilted = command(tilt=True, rpy=[0.2, -0.1, 0], pos=[5.0, 5, 1.2])  # as those of attitude and height are
    np.testing.assert_allclose(tilted.attitude, np.rad2deg([0.2, 0.1, 0]), atol=1e-6)
    np.testing.assert_allclose(tilted.thrust, up.thrust)
    spun = command(tilt=True, rates=(True, True), direct=True, omega=[1.0, 2, 9], thrust=4e4)
    rates = firmware_pid.Rates(jnp.array([1.0, 2, 0]), jnp.array(4e4))
    np.testing.assert_allclose(spun.torque, firmware_pid.pwm(gains, firmware_pid.init(), LEVEL, rates)[1].torque)
    angles = command(tilt=True, direct=True, rpy=[0.2, -0.1, 0], thrust=4e4)
    for by_rate in ((True, False), (False, True)):
        mixed = command(tilt=True, rates=by_rate, direct=True, omega=[1.0, 2, 9], rpy=[0.2, -0.1, 0], thrust=4e4)
        np.testing.assert_allclose(mixed.torque[:2], np.where(by_rate, spun.torque[:2], angles.torque[:2]))


def test_an_attitude_is_not_integrated_on_an_axis_that_follows_a_rate():
    """Otherwise a drone that turned would be tilted, after its rates, by up to the limit of the integral."""
    gains, memory = firmware_pid.gains(), firmware_pid.init()
    rolled = LEVEL.replace(quat=rotation.from_rpy(jnp.array([0.5, 0.3, 0.0])))
    target = per_axis(tilt=True, rates=(True, False), direct=True, thrust=4e4)
    for _ in range(3):
        memory, command = firmware_pid.pwm(gains, memory, rolled, target)
    assert memory.attitude_integral[0] == 0 and memory.attitude_integral[1] != 0
    np.testing.assert_allclose(command.attitude[0], np.rad2deg(0.5))


def test_without_thrust_the_motors_stand_still():
    memory = firmware_pid.init()
    target = firmware_pid.Rates(jnp.array([1.0, 2, 3]), jnp.array(0.0))
    memory, command = firmware_pid.pwm(firmware_pid.gains(), memory, LEVEL, target, 4.0)
    assert not jnp.any(command.pwm) and not jnp.any(memory.rate_integral)


def test_gradients_of_duty_cycles_agree_with_differences():
    gains, memory = firmware_pid.gains(), firmware_pid.init()
    direction = jnp.array([0.3, -0.5, 0.2])

    @jit_unoptimized
    @jax.value_and_grad
    def first(x):
        state = LEVEL.replace(pos=LEVEL.pos + x * direction, omega=x * direction)
        now, _ = firmware_pid.pwm(gains, memory, state, setpoint(), 3.8)
        return firmware_pid.pwm(gains, now, state.replace(vel=x * direction), setpoint(), 3.7)[1].pwm[1]

    gradient = first(0.1)[1]
    assert_finite(gradient)
    np.testing.assert_allclose(gradient, (first(0.1 + 1e-6)[0] - first(0.1 - 1e-6)[0]) / 2e-6, rtol=1e-6)


def test_other_set_points_and_propellers_are_refused():
    with pytest.raises(
        ValueError, match="setpoint is a ndarray; give a Setpoint, Velocity, Attitude, Rates or PerAxis"
    ):
        firmware_pid.pwm(firmware_pid.gains(), firmware_pid.init(), LEVEL, np.zeros(3))
    with pytest.raises(ValueError, match=r"unknown propellers '2.2'.*known: 2.1, 2.1\+"):
        firmware_pid.gains(propellers="2.2")


def test_gradients_of_limited_commands_are_finite_however_a_compiler_rounds():
    """The largest command is chosen without comparing a command with a second rounding of it."""
    rng = np.random.default_rng(5)
    params, gains = jaxdrones.load_params("cf2x"), firmware_pid.gains()
    thrust, torque = jnp.asarray(rng.uniform(3e4, 6.5e4, 500)), jnp.asarray(rng.uniform(-3e4, 3e4, (500, 3)))

    def total(thrust, torque):
        return jnp.sum(firmware_motors.rotor_speeds(gains.motor, params, 1.1 * thrust + 3.3, 0.7 * torque))

    for compiled in jit_optimized, jit_unoptimized:
        assert_finite(compiled(jax.vmap(jax.grad(total, (0, 1))))(thrust, torque))


@pytest.mark.parametrize("controller", [firmware_pid, mellinger])
def test_gains_of_a_vehicle_that_cannot_yaw_leave_yaw_out_and_without_gravity_there_are_none(controller):
    params = jaxdrones.load_params("cf2x")
    gains, without = controller.gains(params), controller.gains(params.replace(km=jnp.zeros(())))
    assert_finite(without)
    np.testing.assert_array_equal(without.rate_p, gains.rate_p * jnp.array([1, 1, 0]))
    with pytest.raises(ValueError, match=r"params.gravity is .*0.*; give a positive number \(m/s\^2\)"):
        controller.gains(params.replace(gravity=jnp.zeros(())))


def test_an_attitude_that_was_followed_before_rates_is_neither_integrated_after_them_nor_differentiated_across_them():
    """As by the firmware, which resets the loop of attitudes while it follows rates."""
    state, gains, thrust = one(hovering(team_of("cf2x"))), firmware_pid.gains(), jnp.asarray(30_000.0)
    fly = jit_unoptimized(lambda memory, setpoint: firmware_pid.pwm(gains, memory, state, setpoint)[0])
    memory = fly(firmware_pid.init(), firmware_pid.Attitude(rpy=jnp.full(3, 0.2), thrust=thrust))
    assert np.all(np.abs(memory.attitude_integral) > 0.01)
    memory = fly(memory, firmware_pid.Rates(omega=jnp.zeros(3), thrust=thrust))
    np.testing.assert_array_equal(memory.attitude_integral, 0)
    far = memory.replace(rpy=jnp.full(3, 50.0))
    np.testing.assert_array_equal(fly(far, firmware_pid.Rates(omega=jnp.zeros(3), thrust=thrust)).rpy, memory.rpy)


def test_integrators_of_rates_and_attitude_are_limited():
    """By the firmware's 33.3 and 166.7 degrees, and 20 and 360 degrees s, times the gains; torques are right-handed."""
    gains, wound = firmware_pid.gains(), jnp.full(3, 1e9)
    memory = firmware_pid.init().replace(rate_integral=wound, attitude_integral=wound)
    _, torque = firmware_loops.rate_loop(gains, memory, LEVEL, jnp.zeros(3), DT)
    _, rates = firmware_loops.attitude_loop(gains, memory, LEVEL, jnp.zeros(3), DT)
    np.testing.assert_allclose(torque, [500 * 33.3, -500 * 33.3, 16.7 * 166.7])
    np.testing.assert_allclose(rates, [3 * 20, 3 * 20, 360])


def test_a_rate_that_rises_is_braked_and_the_torque_is_a_signed_number_of_16_bits():
    gains, memory = firmware_pid.gains(), firmware_pid.init()
    _, braking = firmware_loops.rate_loop(gains, memory.replace(rates=-jnp.ones(3)), LEVEL, jnp.zeros(3), DT)
    np.testing.assert_allclose(braking, [-2.5 / DT, 2.5 / DT, 0])
    _, torque = firmware_loops.rate_loop(gains, memory, LEVEL, jnp.full(3, 1e6), DT)
    np.testing.assert_array_equal(torque, [32767, -32767, 32767])


def test_a_heading_that_crosses_half_a_turn_has_no_kick():
    """The derivative of yaw is that of the turn, from 179 to -179 degrees as from -1 to 1 degree."""
    targets = []
    for start, end in ((179.0, -179.0), (-1.0, 1.0)):
        memory = firmware_pid.init().replace(rpy=jnp.array([0, 0, start]))
        quat = rotation.from_rpy(jnp.deg2rad(jnp.array([0, 0, end])))
        attitude = jnp.array([0, 0, end])
        targets.append(
            firmware_loops.attitude_loop(firmware_pid.gains(), memory, LEVEL.replace(quat=quat), attitude, DT)[1]
        )
    np.testing.assert_allclose(targets[0], [0, 0, -0.35 * 2 / DT], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(targets[0], targets[1], rtol=1e-9, atol=1e-9)


def test_the_output_of_the_vertical_loop_is_limited_about_the_base_thrust():
    gains = firmware_pid.gains().replace(base_thrust=jnp.array(30000.0))
    up = jnp.array([0, 0, 1e3])
    thrusts = [float(firmware_loops.velocity_loop(gains, firmware_pid.init(), LEVEL, v, DT)[2]) for v in (up, -up)]
    assert thrusts == [pytest.approx(30000 + 32767), 20000]


def test_the_voltage_is_filtered_over_a_tenth_of_a_second_whatever_the_rate():
    """From 4 to 3 V by 1 % of the rest in a millisecond; the first voltage is taken as it is."""
    motor = firmware_pid.gains().motor
    arguments = motor, jnp.array(3e4), jnp.zeros(3), 3.0
    for before, dt, after in ((4.0, 0.001, 3.99), (4.0, 0.002, 3 + 0.99**2), (0.0, 0.002, 3.0)):
        assert firmware_motors.duty_cycles(*arguments, jnp.array(before), dt)[0] == pytest.approx(after, rel=1e-9)
