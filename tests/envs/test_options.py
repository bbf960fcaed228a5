"""Options of `make` and of tasks: nonsense is refused with what was given and what to give."""

import inspect
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones as jd
from jaxdrones import vehicles
from jaxdrones.dynamics import EFFECTS, INTEGRATORS, PAIRS, ROTORS
from jaxdrones.envs import TASKS, AutoReset, make
from jaxdrones.envs.disturbances import random_pushes
from jaxdrones.envs.randomize import AnyVehicle, constant_wind, scaled, sensor_noise, shifted
from jaxdrones.learning import evaluate
from jaxdrones.sensing import Box, Scene
from jaxdrones.tasks.curves import circle
from jaxdrones.tasks.hover import hover
from jaxdrones.tasks.task import ObservationTerm

CF2X = jd.load_params("cf2x")
KEY = jax.random.key(0)
NO_NUMBER = (np.nan, np.inf, -np.inf, "a", None, [1.0], True)


def test_what_make_knows_by_name_is_in_the_package():
    for table in EFFECTS, PAIRS, ROTORS, INTEGRATORS:
        assert {function.__name__ for function in table.values()} <= set(jd.__all__)


def refused(name, option, values):
    for value in values:
        with pytest.raises(ValueError, match=rf"{option}.* is .*; give"):
            make(name, **{option: value})


@pytest.mark.parametrize("option", ["reach", "speed", "omega", "tilt", "height", "duration"])
def test_numbers_of_a_hover_are_refused_where_they_make_no_sense(option):
    refused("hover", option, (-1, 1e9, *NO_NUMBER) if option != "duration" else (-1, 0, 1e12, 1e-9, *NO_NUMBER))


@pytest.mark.parametrize("name", TASKS)
def test_every_option_of_every_task_is_refused_where_it_makes_no_sense(name):
    options = TASKS[name].__annotations__.keys() - {"return"}
    assert "drones" in options
    for option in options - {"reach", "speed", "omega", "tilt"}:
        values = ("no", None, -1, np.nan) if option != "random_start" else ("no", None, 2)
        with_unit = "number of drones" if option == "drones" else option
        left_out = inspect.signature(TASKS[name]).parameters[option].default
        for value in values:
            if value is None and left_out is None:
                continue
            with pytest.raises(ValueError, match=rf"{with_unit}.*{'unknown' if option == 'curve' else 'give'}|unknown"):
                make(name, **{option: value})
    for drones in (0, 2.5, True):
        with pytest.raises(ValueError, match=r"number of drones .*is .*; give a whole number of at least [12]"):
            make(name, drones=drones)


def test_starts_from_which_a_drone_is_lost_at_once_are_refused():
    with pytest.raises(ValueError, match="number of drones of gates is 6; give a number of at most 5"):
        make("gates", drones=6)
    with pytest.raises(ValueError, match=r"reach is 6.0; give a number of at least 0 and at most 5 \(m\)"):
        make("hover", reach=6.0)
    with pytest.raises(ValueError, match="period is 1e-05"):
        make("tracking", period=1e-5)


@pytest.mark.parametrize(
    ("task", "option", "most"),
    [("room", "size", 1e3), ("wake", "spacing", 1e3), ("wake", "amplitude", 1e3), ("race", "laps", 100)],
)
def test_sizes_at_which_rewards_are_not_finite_or_compiling_does_not_end_are_refused(task, option, most):
    assert TASKS[task](**{option: most})
    with pytest.raises(ValueError, match=rf"^{option} is {10 * most}; give .*at most {most:g}"):
        TASKS[task](**{option: 10 * most})


@pytest.mark.parametrize("task", ["race", "gates", "swap-goals", "forest", "follow"])
def test_drones_that_would_start_in_each_other_are_refused(task):
    options = {"race": {}, "swap-goals": {}, "follow": {"distance": 0.3}}.get(task, {"drones": 2})
    assert make(task, **options)
    with pytest.raises(ValueError, match=r"drones of this vehicle are 0\.76 m wide and would start in each other"):
        make(task, vehicle="x500", **options)


def test_followers_start_apart_however_short_their_distance():
    env = make("follow", drones=3, distance=0.3)
    _, worlds = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 200))
    pos = worlds.drones.pos
    apart = jnp.linalg.norm(pos[:, 1:] - pos[:, :-1], axis=-1)
    assert 0.3 - 2 * math.sqrt(2) * 0.03 < apart.min() < apart.max() < 0.4


def test_a_scene_in_which_every_start_is_inside_an_obstacle_is_refused():
    def cube(x, half):
        return Scene.of(Box(pos=jnp.array([x, 0.0, 2.0]), size=jnp.full(3, 2 * half)))

    assert make("hover", scene=cube(0.0, 0.2)) and make("hover", scene=cube(2.0, 0.5))
    with pytest.raises(ValueError, match=r"^scene: in each of 16 starts of hover a drone is inside an obstacle; move"):
        make("hover", scene=cube(0.0, 1.01))


@pytest.mark.parametrize("option", ["control_hz", "substeps", "delay", "realistic"])
def test_numbers_of_make_are_refused_where_they_make_no_sense(option):
    optional = ("control_hz", "substeps", "delay")
    for value in (-1, 0, *NO_NUMBER, 1e12):
        fine = (value is None and option in optional) or (value == 0 and option == "delay")
        fine = fine or (option == "realistic" and isinstance(value, bool))
        if not fine:
            with pytest.raises(ValueError, match=r"is .*; give"):
                make("hover", **{option: value})


@pytest.mark.parametrize("task", ["sling", "transport"])
def test_loads_are_not_for_random_vehicles(task):
    """A load of 30 % of the median vehicle is 3.2 times as heavy as the lightest ones."""
    with pytest.raises(ValueError, match=f"{task} has loads for one vehicle, .* give a vehicle"):
        make(task, realistic="any")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            dict(observation="position"),
            r"observation is 'position'; give a sequence, for example \('position_error',\)",
        ),
        (dict(effects="drag"), r"effects is 'drag'; give a sequence, for example \('drag',\)"),
        (dict(pairs="downwash"), r"pairs is 'downwash'; give a sequence"),
        (dict(vision="rgb"), r"vision is 'rgb'; give a sequence, for example \('depth',\)"),
        (dict(randomize=scaled("mass", 0.9, 1.1)), r"randomize is .*; give a sequence"),
        (
            dict(vehicle="hb", effects=("drag",), randomize=(scaled("drag_coeff", 0.5, 1.5),)),
            r"drag_coeff of the vehicle is zero, .*; leave it out",
        ),
        (dict(randomize=("mass",)), r"randomize: 'mass' is not a function"),
        (dict(randomize=(lambda params: params,)), r"randomize: <lambda> takes .*; give a function of \(key, params\)"),
        (dict(scene=lambda: 3), r"scene: <lambda> takes \(\); give a function of \(key\)"),
        (dict(action=lambda obs: obs), r"action is <function .*; give an object of Action"),
        (dict(noise=0.1), r"noise: 0.1 is not a function; give for example sensor_noise\(\)"),
        (dict(disturbance=0.1), r"disturbance: 0.1 is not a function; give for example random_pushes\(0.3\)"),
        (dict(observation=(3,)), r"observation: 3 is not an observation term"),
        (dict(action=3), r"action is 3; give an object of Action"),
        (dict(effects=("downwash",)), r"'downwash' is given as one of effects; .* give pairs=\('downwash',\)"),
        (dict(pairs=("drag",)), r"'drag' is given as one of pairs; .* give effects=\('drag',\)"),
        (dict(effects=(jd.downwash,)), r"effects: downwash takes .*; give a function of \(params, state\)"),
        (dict(rotors=jd.failing(jd.pwm_rotors)), r"rotors take PWM, and the action type 'rpm' commands rotor speeds"),
        (dict(vehicle=5), r"vehicle is 5; give"),
        (dict(vehicle=jd.repeat(CF2X, 2)), r"vehicle.mass has shape \(2,\); expected \(\): vehicle is a single drone"),
        (dict(vehicle=CF2X.replace(mass=-1)), r"params\.mass is -1; give positive numbers"),
        (dict(vehicle=CF2X.replace(mass=jnp.array(0.0))), r"params\.mass is 0.0; give positive numbers"),
        (dict(vehicle=CF2X.replace(inertia=[1e-5, 1e-5, 2e-5])), r"params\.inertia is \[1e-05.*; give an array"),
        (dict(vehicle=CF2X.replace(kf=jnp.nan)), r"params\.kf is not finite"),
    ],
    ids=range(24),
)
def test_a_mistake_in_an_option_is_named(options, message):
    with pytest.raises(ValueError, match=message):
        make("hover", **options)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: make("hover", vehicel="hb"), r"'vehicel'; did you mean 'vehicle'\? \(known: action, backend"),
        (lambda: make("hover", drone=2), r"'drone'; did you mean 'drones'\?"),
        (
            lambda: make(hover(), vehicel="hb"),
            r"'vehicel' beside a task; did you mean 'vehicle'\?; give options of the",
        ),
    ],
    ids=["make", "task by name", "task"],
)
def test_an_unknown_option_is_pythons_error_and_names_the_closest(call, message):
    with pytest.raises(TypeError, match=f"got an unexpected keyword argument .*{message}"):
        call()


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        (lambda: sensor_noise(pos=-1), "pos of the noise is -1"),
        (lambda: sensor_noise(omega=np.nan), "omega of the noise is nan"),
        (lambda: random_pushes(-0.1), "force of a push is -0.1"),
        (lambda: random_pushes(0.1, interval=0), "interval is 0"),
        (lambda: random_pushes(0.1, duration=np.nan), "duration is nan"),
        (lambda: constant_wind(-1), "speed of the wind is -1"),
        (lambda: scaled("mass", -1, 1), "lower bound of mass is -1"),
        (lambda: scaled("km", -1, 1), "lower bound of km is -1; give a number of at least 0"),
        (lambda: shifted("mass", 0, np.inf), "upper bound of mass is inf"),
        (lambda: ObservationTerm(lambda task, world: world.drones.pos, np.nan), "bound of an observation is nan"),
        (lambda: circle(radius=np.nan), r"circle\['radius'\] is not finite"),
    ],
)
def test_a_mistake_in_a_part_is_named(mistake, message):
    with pytest.raises(ValueError, match=message):
        mistake()


def test_a_key_is_one_random_key_typed_or_raw():
    env = make("hover")
    obs, world = env.reset(KEY)
    raw = jax.random.key_data(KEY)
    np.testing.assert_array_equal(env.reset(raw)[0], obs)
    action = jnp.zeros((1, 4))
    takers = (
        env.reset,
        AutoReset(env).reset,
        lambda key: env.step(key, world, action),
        lambda key: evaluate(env, lambda obs: action, key, 2),
    )
    for take in takers:
        for wrong in (0, None, 1.5, "key", np.uint32(3), jnp.zeros(2), jnp.zeros(4, jnp.uint32)):
            with pytest.raises(ValueError, match=r"key is .*; give a random key, for example jax\.random\.key\(0\)"):
                take(wrong)
        for many in (jax.random.split(KEY, 3), jax.random.split(raw, 3)):
            with pytest.raises(ValueError, match=r"key has shape \(3.*; give one key, and use jax\.vmap for many"):
                take(many)
    assert jax.eval_shape(jax.vmap(env.reset), jax.random.split(raw, 3))[0].shape[0] == 3


def test_a_world_with_a_quaternion_that_is_no_attitude_is_refused():
    env = make("hover")
    _, world = env.reset(KEY)
    broken = world.replace(drones=world.drones.replace(quat=jnp.zeros((1, 4))))
    with pytest.raises(ValueError, match=r"state\.quat has length 0: .*give a unit quaternion"):
        env.step(KEY, broken, jnp.zeros((1, 4)))


@pytest.mark.parametrize(("task", "remedy"), [("race", "a single drone"), ("swap-goals", "fewer drones")])
def test_random_vehicles_that_would_start_in_each_other_are_refused(task, remedy):
    """40 % of the races of vehicles of up to 3 kg began with drones in each other."""
    with pytest.raises(ValueError, match=rf"with AnyVehicle\(heaviest=3\) drones .* 1\.23 m wide .* or {remedy}"):
        make(task, realistic="any")
    assert make(task, randomize=[AnyVehicle(heaviest=0.1)])


def test_no_random_vehicle_is_larger_than_the_largest():
    """Every parameter at the upper limit of its law."""
    largest = vehicles._vehicle(CF2X, jnp.asarray(3.0), lambda name, median, low, high: high)
    np.testing.assert_allclose(largest.collision_radius, vehicles.largest_radius(3.0), rtol=1e-6)


def test_a_team_that_would_start_in_itself_above_a_load_is_refused():
    with pytest.raises(ValueError, match=r"0\.76 m wide .* 0\.497 m apart; give longer cables"):
        make("transport", vehicle="x500")
    assert make("transport", vehicle="x500", length=0.8)
