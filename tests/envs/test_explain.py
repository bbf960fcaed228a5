"""What an environment says of itself is what it does."""

import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import mostly_slow

import jaxdrones as jd
from jaxdrones.envs import ACTIONS, OBSERVATIONS, TASKS, ObservationTerm, explain, make
from jaxdrones.envs.actions import Action
from jaxdrones.envs.disturbances import random_pushes
from jaxdrones.envs.randomize import scaled, sensor_noise
from jaxdrones.quantity import Quantity, description
from jaxdrones.sensing import lidar, multi_ranger, optical_flow, time_of_flight
from jaxdrones.tasks.hover import hover

CRAZYFLIE = jd.load_params("cf2x")
ROTORS = ("rpm", "one_d_rpm", "thrust_and_torques", "one_d_thrust")
FRAMES = {"world", "body", "body to world", "device", "-"}


def is_sentence_part(text):
    return bool(re.search(r"\w", text)) and "\n" not in text


@pytest.mark.parametrize("name", mostly_slow(TASKS, ["hover", "forest"]))
def test_every_number_and_every_part_of_every_task_says_what_it_is(name):
    env = make(name)
    told = explain(env)
    assert len(told.observation) == env.observation_size and len(told.action) == env.action_size
    np.testing.assert_allclose([entry.high for entry in told.observation], env.observation_bound)
    for entry in (*told.observation, *told.action):
        what = entry.quantity
        assert is_sentence_part(what.name) and what.unit != "?" and what.frame in FRAMES
        assert entry.term in (*ACTIONS, *OBSERVATIONS, *env.task.observations)
        assert entry.low == -entry.high
    assert len({entry.quantity.name + entry.term for entry in told.observation}) == env.observation_size
    assert [part.name for part in told.rewards] == list(env.task.rewards)
    assert [part.weight for part in told.rewards] == [scale for scale, _ in env.task.rewards.values()]
    for part in (*told.rewards, *told.metrics, *told.terminations, *told.truncations):
        assert is_sentence_part(part.meaning), part.name
    assert all(is_sentence_part(text) for text in (*told.task.values(), *told.physics.values(), *told.vehicle.values()))
    assert set(told.images) == set(env.image_spaces)
    assert all(space.meaning in told.images[name] for name, space in env.image_spaces.items())
    assert json.loads(json.dumps(told.as_dict()))["rewards"] == told.as_dict()["rewards"]


@pytest.mark.parametrize("drones", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_every_observation_term_of_the_registry_describes_each_of_its_numbers(drones):
    env = make("hover", drones=drones, observation=list(OBSERVATIONS))
    told = explain(env).observation
    assert len(told) == env.observation_size
    assert list(dict.fromkeys(entry.term for entry in told)) == list(OBSERVATIONS)
    assert all(entry.quantity.unit != "?" and entry.quantity.frame in FRAMES for entry in told)
    assert all(is_sentence_part(description(term.observe)) for term in OBSERVATIONS.values())


@pytest.mark.parametrize("name", mostly_slow(ACTIONS, ["rpm", "velocity", "pid_gains", "attitude"]))
def test_every_action_type_of_the_registry_describes_each_of_its_numbers(name):
    env = make("tune", action=name, control_hz=100)
    told = explain(env).action
    assert len(told) == env.action_size and all(entry.term == name for entry in told)
    for entry in told:
        assert entry.quantity.frame in FRAMES and is_sentence_part(entry.quantity.name)
        assert entry.quantity.values is None or len(entry.quantity.values) == 3


def test_the_term_of_the_last_action_means_what_the_action_means():
    told = explain(make("hover", action="thrust_and_rates"))
    last = [entry.quantity for entry in told.observation if entry.term == "last_action"]
    assert [entry.values for entry in last] == [entry.quantity.values for entry in told.action]
    assert last[0].name == "last action: collective thrust" and last[0].unit == "N"


@pytest.mark.parametrize("name", mostly_slow(ROTORS, ["rpm", "thrust_and_torques"]))
def test_what_minus_one_zero_and_one_stand_for_is_what_the_rotors_do(name):
    action = ACTIONS[name]()
    command = jax.jit(lambda given: action.rpm(CRAZYFLIE, None, None, given, None, 0.01)[1])
    for i, entry in enumerate(action.entries(CRAZYFLIE)):
        for number, value in zip((-1.0, 0.0, 1.0), entry.values, strict=True):
            rpm = command(jnp.zeros(action.size).at[i].set(number))
            push = CRAZYFLIE.kf * rpm**2
            x, y, _ = CRAZYFLIE.rotor_pos.T
            torque = [jnp.sum(y * push), -jnp.sum(x * push), jnp.sum(CRAZYFLIE.rotor_spin * CRAZYFLIE.km * rpm**2)]
            done = {"RPM": rpm[i], "N": jnp.sum(push), "N m": torque["xyz".find(entry.name[0])]}[entry.unit]
            np.testing.assert_allclose(done, value, rtol=1e-6, atol=1e-12, err_msg=f"{entry.name} at {number}")


def test_the_attitude_matrix_is_told_row_by_row():
    env = make("hover", observation=("rotation_matrix",))
    _, world = env.reset(jax.random.key(0))
    turned = world.replace(drones=world.drones.replace(quat=jnp.array([[0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]])))
    numbers = env.privileged_observation(turned).obs[0]
    by_name = {entry.quantity.name: x for entry, x in zip(explain(env).observation, numbers, strict=True)}
    assert by_name["y of body x axis"] == pytest.approx(1) and by_name["x of body y axis"] == pytest.approx(-1)
    assert by_name["z of body z axis"] == pytest.approx(1)


def test_sensors_say_what_their_readings_are():
    sensors = (multi_ranger(), lidar(beams=8), time_of_flight(zones=2), optical_flow())
    env = make("hover", sensors=sensors, observation=[sensor.name for sensor in sensors])
    told = explain(env)
    assert len(told.observation) == 5 + 8 + 4 + 2 == env.observation_size
    assert {entry.quantity.unit for entry in told.observation} == {"m", "rad/s"}
    assert told.observation[0].quantity.name == "range along (1.00, 0.00, 0.00)"


def test_the_physics_says_what_was_asked_for():
    told = explain(
        make(
            "hover",
            effects=("drag",),
            rotors="lagging",
            integrator="rk4",
            control_hz=50,
            substeps=4,
            delay=0.02,
            randomize=(scaled("mass", 0.9, 1.1),),
            noise=sensor_noise(),
            disturbance=random_pushes(0.3),
            vehicle="racer",
        )
    )
    physics = told.physics
    assert physics["effects"] == "drag, external_force" and physics["rotors"] == "lagging_rotors"
    assert physics["integrator"] == "rk4" and physics["delay"] == "0.02 s between action and command"
    assert physics["rates"] == "50 control steps per second of 4 physics steps of 5 ms"
    drawn = f"mass times U(0.9, 1.1); start of: {physics['disturbance']}"
    assert physics["drawn per episode"] == drawn and "0.005 m" in physics["noise"]
    assert "0.3" in physics["disturbance"] and told.vehicle["name"] == "racer" and told.vehicle["mass"] == "0.83 kg"


@pytest.mark.needs("pybullet")
def test_the_physics_of_bullet_is_told_too():
    with make("hover", backend="bullet") as env:
        physics = explain(env).physics
    assert (physics["backend"], physics["integrator"]) == ("bullet", "Bullet")
    assert physics["rates"] == "100 control steps per second of 5 physics steps of 2 ms"


def test_a_term_of_a_user_is_shown_even_if_it_says_nothing_and_refused_if_it_says_too_little():
    silent = ObservationTerm(lambda task, world: world.drones.pos, 5.0)
    told = explain(make("hover", observation=(silent, "omega"))).observation
    assert [(entry.term, entry.quantity.unit) for entry in told[:3]] == [("term 0", "?")] * 3
    short = ObservationTerm(lambda task, world: world.drones.pos, 5.0, entries=(Quantity("height", "m"),))
    with pytest.raises(ValueError, match=r"line .* returns 3 numbers and has 1 in entries"):
        make("hover", observation=(short,))
    still = Action(2, lambda params, memory, state, action, setpoint, dt: (memory, params.hover_rpm * jnp.ones(4)))
    assert [entry.quantity.name for entry in explain(make("hover", action=still)).action] == ["number 0", "number 1"]
    with pytest.raises(ValueError, match="env is 'hover'; give an environment"):
        explain("hover")


def test_a_task_of_a_function_has_its_options():
    told = explain(make(hover, reach=0.5, drones=2))
    assert told.task["team"] == "2 x cf2x" and "+-0.5 m of the goal" in told.task["start"]
    assert "hover: fly to the goal" in str(told) and repr(told) == str(told)
