"""Action types that ask for a setpoint: every vehicle flies there, or the environment is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import VEHICLES, make_step

import jaxdrones
from jaxdrones import State, assets, rotation
from jaxdrones.control import Setpoint, for_team, pid, velocity
from jaxdrones.envs import ACTIONS, make

HZ, SECONDS = 100, 6
START = np.array([0.2, -0.1, 1.0])
GOAL = np.array([0.5, -0.4, 0.8])
CRAZYFLIE = jaxdrones.load_params("cf2x")
HEAVY = CRAZYFLIE.replace(mass=1.4 * CRAZYFLIE.mass)
TEAMS = {  # flown by the PID, and by the geometric controller
    "pid": [jaxdrones.load_params(vehicle) for vehicle in pid.VEHICLES],
    "geometric": [HEAVY, *(jaxdrones.load_params(vehicle) for vehicle in ("hb", "racer"))],
}
ON = {  # action type: which of the coordinates it commands, and the action towards the goal
    "position": (slice(0, 3), lambda way: jnp.clip(way / 0.1, -1, 1)),
    "one_d_position": (slice(2, 3), lambda way: jnp.clip(way[2:] / 0.1, -1, 1)),
    "destination": (slice(0, 3), lambda way: jnp.asarray(GOAL)),
    "velocity": (slice(0, 3), lambda way: jnp.append(way, jnp.clip(5 * jnp.max(jnp.abs(way)), 0, 1))),
    "one_d_velocity": (slice(2, 3), lambda way: jnp.clip(5 * way[2:], -1, 1)),
}


def fly(team, name, act):
    """Positions (length, n, 3) of a team that moves a little at the start, under actions `act(way to the goal)`."""
    n = len(team.mass)
    action = ACTIONS[name]().fitted(team)
    rpm = jnp.broadcast_to(team.hover_rpm[:, None], (n, 4))
    vel = jnp.tile(jnp.array([[0.1, -0.05, 0.05]]), (n, 1))
    start = State.at_rest(np.tile(START, (n, 1))).replace(rpm=rpm, vel=vel)

    def control(params, memory, state, k):
        def of_one(params, memory, state):
            return action.rpm(params, memory, state, act(GOAL - state.pos), None, 1 / HZ)

        return jax.vmap(of_one)(params, memory, state)

    step = make_step(dt=1 / HZ / 3, substeps=3)
    rollout = jax.jit(
        lambda team, start: jaxdrones.rollout(step, control, team, start, for_team(action.init(), n), SECONDS * HZ)
    )
    return np.asarray(rollout(team, start)[1].pos)


@pytest.mark.parametrize("controller", TEAMS)
@pytest.mark.slow
@pytest.mark.parametrize("name", ON)
def test_every_vehicle_goes_where_an_action_asks_and_stays_where_none_does(name, controller):
    """A nominal 3 % of the top speed, 0.25 m/s of a Crazyflie, covers the 0.47 m in time."""
    axes, act = ON[name]
    pos = fly(jaxdrones.stack(TEAMS[controller]), name, act)[-1]
    np.testing.assert_allclose(pos[:, axes], np.broadcast_to(GOAL[axes], pos[:, axes].shape), rtol=0, atol=0.05)
    if name != "destination":  # for which zero is the origin
        still = fly(jaxdrones.stack(TEAMS[controller]), name, lambda way: 0 * act(way))
        assert np.max(np.linalg.norm(still - START, axis=-1)) < 0.1


def test_the_pid_flies_crazyflies_by_their_numbers_whatever_their_name(tmp_path):
    copy = tmp_path / "mine.urdf"
    copy.write_text(assets.vehicles()["cf2p"].read_text())
    suits = {vehicle: pid.fits(jaxdrones.load_params(vehicle)) for vehicle in (*VEHICLES, copy)}
    assert suits == {"cf2x": True, "cf2p": True, "hb": False, "racer": False, copy: True}
    assert pid.fits(CRAZYFLIE.replace(mass=1.1 * CRAZYFLIE.mass)) and not pid.fits(HEAVY)
    assert not pid.fits(jaxdrones.stack([CRAZYFLIE, HEAVY]))


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", ["hb", "racer"])
def test_hover_with_a_large_vehicle_stays_at_its_start_under_no_action(vehicle):
    """The environment by its name, from any of its starts: it slows down from up to 1 m/s and stays."""
    env = make("hover", vehicle=vehicle, action="position")

    @jax.jit
    def fly(key):
        _, start = env.reset(key)
        action = jnp.zeros((1, env.action_size))
        return start, jax.lax.fori_loop(0, 500, lambda k, world: env.step(key, world, action)[1], start)

    start, end = jax.vmap(fly)(jax.random.split(jax.random.key(0), 20))
    assert jnp.all(jnp.linalg.norm(end.drones.vel, axis=-1) < 0.01)
    assert jnp.all(jnp.linalg.norm(end.drones.pos - start.drones.pos, axis=-1) < 1.5)


@pytest.mark.parametrize("vehicle", ["hb", HEAVY])
def test_gains_of_a_pid_that_does_not_suit_the_vehicle_cannot_be_scaled(vehicle):
    with pytest.raises(ValueError, match=r"'pid_gains' scales .* suit only cf2x, cf2p .* another action type"):
        make("hover", vehicle=vehicle, action="pid_gains")
    with pytest.raises(ValueError, match="'pid_gains' scales"):
        make("tune", vehicle=vehicle)


@pytest.mark.parametrize("name", [*ON, "pid_gains"])
def test_what_a_controller_cannot_hold_is_refused(name):
    """A Crazyflie whose rotors lag as they do, and too few calls per second."""
    for lagging in dict(rotors="lagging"), dict(realistic=True):
        with pytest.raises(ValueError, match=rf"'{name}' .* rotors with a time constant .* has 0\.15 s; give rotors="):
            make("hover", action=name, **lagging)
    with pytest.raises(ValueError, match=rf"control_hz is 20; the action type '{name}' .* needs 30 or more"):
        make("hover", action=name, control_hz=20)
    if name != "pid_gains":
        make("hover", vehicle="racer", action=name, realistic=True)
        make("hover", vehicle="racer", action=ACTIONS[name](), control_hz=30)


def test_the_numbers_of_a_vehicle_must_be_known_where_a_controller_is_chosen_by_them():
    with pytest.raises(ValueError, match=r"params are being traced.*outside of jax\.jit"):
        jax.jit(lambda mass: ACTIONS["position"]().fitted(CRAZYFLIE.replace(mass=mass)).size)(0.03)


def test_an_environment_has_motors_with_a_limit():
    with pytest.raises(ValueError, match=r"vehicle\.max_rpm is not finite"):
        make("hover", vehicle=CRAZYFLIE.replace(max_rpm=jnp.array(jnp.inf)))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (dict(kf=91.19 * CRAZYFLIE.kf), "hovers at 1515 RPM of at most 2.17e.04, with a highest thrust of 205.2 times"),
        (dict(kf=CRAZYFLIE.kf / 91.19), "hovers at 1.382e.05 RPM of at most 2.17e.04, .* 0.02467 times its weight"),
        (dict(mass=1000 * CRAZYFLIE.mass), "highest thrust of 0.00225 times its weight; .* mass in kg"),
        (dict(max_rpm=0.999 * CRAZYFLIE.hover_rpm), "give a ratio above 1 and up to 100"),
    ],
)
def test_constants_in_another_unit_with_which_a_vehicle_cannot_hover_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        make("hover", vehicle=CRAZYFLIE.replace(**wrong))


def test_a_vehicle_without_gravity_needs_no_thrust_to_hover():
    make("hover", vehicle=CRAZYFLIE.replace(gravity=jnp.array(0.0)))


def test_a_velocity_is_that_of_the_paper_whoever_flies():
    action = jnp.array([3.0, 0, 4, 0.5])
    for vehicle in VEHICLES:
        params = jaxdrones.load_params(vehicle)
        asked = velocity.commanded(params, action)
        np.testing.assert_allclose(asked, 0.015 * params.max_speed * jnp.array([0.6, 0, 0.8]), rtol=1e-6)


def test_failing_rotors_lag_as_those_that_they_wrap():
    params = jaxdrones.load_params("cf2x").replace(aux={"rotor_health": jnp.ones(4)})
    for rotors in jaxdrones.lagging_rotors, jaxdrones.failing(jaxdrones.lagging_rotors):
        with pytest.raises(ValueError, match=r"'pid_gains' .* this vehicle has 0\.15 s"):
            make("hover", vehicle=params, action="pid_gains", rotors=rotors)


def test_throttle_is_the_share_of_the_largest_speed_whatever_the_vehicle_hovers_with():
    command = ACTIONS["throttle"]().rpm
    for vehicle in VEHICLES:
        params = jaxdrones.load_params(vehicle)
        _, speeds = command(params, None, None, jnp.array([-1.0, -0.5, 0.0, 1.0]), None, 0.01)
        np.testing.assert_allclose(speeds / params.max_rpm, [0, 0.25, 0.5, 1], atol=1e-12)


@pytest.mark.parametrize("name", ["thrust_and_torques", "one_d_thrust", "thrust_and_rates", "attitude"])
def test_the_collective_thrust_of_an_action_is_what_its_description_says(name):
    action, level = ACTIONS[name](), jax.tree.map(lambda x: x[0], State.at_rest(jnp.zeros((1, 3))))
    for x, thrust in zip((-1.0, 0.0, 1.0), action.entries(CRAZYFLIE)[0].values, strict=True):
        _, rpm = action.rpm(CRAZYFLIE, None, level, jnp.zeros(action.size).at[0].set(x), None, 0.01)
        np.testing.assert_allclose(CRAZYFLIE.kf * jnp.sum(rpm**2), thrust, rtol=1e-9, atol=1e-12)


def test_gains_times_one_are_those_of_the_pid():
    state = jax.tree.map(lambda x: x[0], State.at_rest(jnp.zeros((1, 3))))
    action, target = ACTIONS["pid_gains"](), Setpoint.at(jnp.array([0.1, -0.1, 0.05]))
    _, rpm = action.rpm(CRAZYFLIE, pid.init(), state, jnp.zeros(6), target, 0.01)
    expected = pid.control(pid.gains(), CRAZYFLIE, pid.init(), state, target, dt=0.01)[1]
    np.testing.assert_array_equal(rpm, expected)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        *[("rpm", {"near_hover": x}) for x in (0, -0.1, 2.0, np.nan)],
        ("one_d_rpm", {"near_hover": 1.1}),
        ("thrust_and_torques", {"torque_share": -1.0}),
        ("one_d_thrust", {"share": 2.0}),
        ("position", {"step": -0.1}),
        ("one_d_position", {"step": np.inf}),
        ("destination", {"max_step": 0.0}),
        ("thrust_and_rates", {"max_rate": (1.0, 2.0)}),
        *[("attitude", {"max_tilt": x}) for x in (-60, 181)],
    ],
)
def test_limits_of_actions_are_refused_where_they_make_no_sense(name, options):
    with pytest.raises(ValueError, match=next(iter(options))):
        ACTIONS[name](**options)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_attitude_is_turned_to_and_kept(axis):
    action, limits = ACTIONS["attitude"](), np.radians([60, 60, 180])
    level = jax.tree.map(lambda x: x[0], State.at_rest(jnp.zeros((1, 3))))
    asked = jnp.zeros(4).at[1 + axis].set(0.25)

    def torque(state):
        thrust = CRAZYFLIE.kf * action.rpm(CRAZYFLIE, None, state, asked, None, 0.01)[1] ** 2
        x, y = CRAZYFLIE.rotor_pos[:, 0], CRAZYFLIE.rotor_pos[:, 1]
        return jnp.array([thrust @ y, -thrust @ x, thrust @ CRAZYFLIE.rotor_spin])

    assert torque(level)[axis] > 1e-9
    there = rotation.from_rpy(jnp.asarray(0.25 * limits * (np.arange(3) == axis)))
    np.testing.assert_allclose(torque(level.replace(quat=there)), 0, atol=1e-12)
