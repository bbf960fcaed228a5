"""Functions of a task that return what an environment cannot use: `make` refuses them and names the function."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import pytest

import jaxdrones as jd
from jaxdrones.control import Setpoint
from jaxdrones.envs.explanation import explain
from jaxdrones.envs.randomize import shifted
from jaxdrones.errors import UserError
from jaxdrones.tasks import ObservationTerm, Quantity, Task

N = 2
calls = itertools.count(1)


def start(key, params):
    return jd.State.at_rest(jnp.ones((N, 3))), jnp.zeros(N)


def height(task, world):
    return world.drones.pos[:, 2:]


def low(task, world):
    return world.drones.pos[:, 2] < 0


TASK = Task(
    name="mine",
    summary="a task",
    drones=N,
    duration=1.0,
    start=start,
    target=lambda variables, time: Setpoint.at(jnp.ones((N, 3))),
    rewards={"high": (1.0, lambda task, world: world.drones.pos[:, 2])},
    terminations={"low": low},
    observation=(ObservationTerm(height, 5.0),),
)


def of_whole_numbers(key, params):
    state, variables = start(key, params)
    return state.replace(pos=jnp.ones((N, 3), int)), variables


def turned(length):
    """Start with a quaternion that has this length for every other key."""

    def of_a_length(key, params):
        state, variables = start(key, params)
        return state.replace(quat=state.quat * jnp.where(jax.random.bernoulli(key), length, 1.0)), variables

    return of_a_length


def light(key, params):
    return params.replace(mass=params.mass * (0.9 - jax.random.uniform(key)))


MISTAKES = [
    (dict(start=turned(1.01)), "start returns values that cannot fly: state.quat has length 1.01: .*; give a unit"),
    (dict(start=turned(jnp.nan)), r"start returns values that cannot fly: state.quat is not finite: "),
    (dict(randomize=(light,)), r"a randomization returns values that cannot fly: params.mass is -.*; give positive"),
    (dict(start=of_whole_numbers), "start returns a state whose pos is .*int.*; give an array .* of float"),
    (dict(equip=lambda params: None), "equip returns None; return params.replace"),
    (dict(equip=lambda params: params.replace(mass=jnp.ones(7))), r"equip returns .* mass is an array \(7,\)"),
    (dict(equip=lambda params: params.replace(mass=-params.mass)), "params.mass is .*; give positive numbers"),
    (
        dict(equip=lambda params: params.replace(aux={"load": jnp.ones(())})),
        r"equip returns parameters whose aux has an array \(\) of .*; give an array \(2, ...\)",
    ),
    (
        dict(observation=(ObservationTerm(lambda task, world: height(task, world) > 1, 5.0),)),
        r"returns an array \(2, 1\) of bool; return real numbers",
    ),
    (
        dict(observation=(ObservationTerm(lambda task, world: jnp.zeros((N, next(calls))), 5.0),)),
        r"returns an array \(2, \d\) of .*, and an array \(2, \d\) of .* when called again; keep its shape",
    ),
    (dict(observation=(ObservationTerm(height, 5.0, rows=2),)), "returns 1 numbers in 2 rows; give rows of equal"),
]


@pytest.mark.parametrize(("change", "said"), MISTAKES, ids=[said for _, said in MISTAKES])
def test_what_a_function_of_a_task_returns_is_refused_where_nothing_can_be_flown_with_it(change, said):
    with pytest.raises(UserError, match=said):
        jd.make(dataclasses.replace(TASK, **change))


@pytest.mark.parametrize(
    ("option", "function", "said"),
    [
        ("noise", lambda key, state: None, r"noise returns None; return state\.replace\(\.\.\.\)"),
        (
            "noise",
            lambda key, state: state.replace(pos=state.pos[0]),
            r"a state whose pos is .*; give an array \(2, 3\)",
        ),
        ("noise", lambda key: None, r"noise: <lambda> takes \(key\); give a function of \(key, state\)"),
        ("disturbance", lambda key, params, dt: None, r"disturbance returns None; return params\.replace\(\.\.\.\)"),
        (
            "disturbance",
            lambda key, params, dt: params.replace(wind=jnp.zeros(3)),
            r"parameters whose wind is .*\(2, 3\)",
        ),
        ("disturbance", lambda key, params: params, r"takes \(key, params\); give a function of \(key, params, dt\)"),
    ],
    ids=range(6),
)
def test_noise_and_a_disturbance_are_of_a_team(option, function, said):
    """A position of one drone would be broadcast to all of the team."""
    with pytest.raises(UserError, match=said):
        jd.make("hover", drones=2, **{option: function})


@pytest.mark.parametrize("steps", [-1, 2.5, True, "a"])
def test_a_number_of_steps_that_makes_no_sense_is_refused(steps):
    with pytest.raises(UserError, match=f"^steps is {steps!r}; give a whole number of at least 0"):
        dataclasses.replace(jd.make("hover"), steps=steps)


@pytest.mark.parametrize(
    ("randomization", "said"),
    [
        (light, r"test_functions.py, line \d+: a randomization returns values that cannot fly: params.mass is -"),
        (lambda key, params: params.mass, r"a randomization returns .*; return params.replace"),
        (
            shifted("inertia", -2e-5, 1e-5),
            "the lower bound of inertia, which is 1.4e-05, is -2e-05; give more than -1.4e-05",
        ),
        (shifted("km", -1e-11, 0.0), "of km, which is 7.94e-12, is -1e-11; give at least -7.94e-12"),
    ],
)
def test_randomizations_given_to_make_are_checked_like_those_of_a_task(randomization, said):
    with pytest.raises(UserError, match=said):
        jd.make("hover", randomize=(randomization,))


def test_functions_of_a_task_that_are_first_seen_in_a_program_are_traced_with_it():
    env = dataclasses.replace(jd.make(TASK), task=dataclasses.replace(TASK, start=turned(1.0)))
    assert jax.jit(lambda key: env.reset(key)[0])(jax.random.key(0)).shape == (N, 1)


def test_a_reward_of_whole_numbers_is_one_of_real_numbers():
    """Learners take the types of their weights from it, which would be rounded to zero."""
    env = jd.make(dataclasses.replace(TASK, rewards={"low": (1, low), "fast": (2, lambda task, world: jnp.arange(N))}))

    def step(key):
        _, world = env.reset(key)
        return env.step(key, world, jnp.zeros((N, 4)))

    _, _, reward, _, _, info = jax.eval_shape(step, jax.random.key(0))
    assert {x.dtype for x in (reward, *info["rewards"].values())} == {jnp.zeros(()).dtype}


@pytest.mark.slow
def test_a_task_may_keep_a_random_key_in_its_variables():
    def drawn(key, params):
        return start(key, params)[0], key

    task = dataclasses.replace(TASK, start=drawn, advance=lambda task, world: jax.random.fold_in(world.variables, 1))
    jd.envs.check_env(jd.make(task), steps=1)


def test_a_duration_and_a_rate_may_be_arrays():
    env = jd.make(dataclasses.replace(TASK, duration=jnp.array(1.5)), control_hz=jnp.array(50.0))
    assert type(env.steps) is int and env.steps == 75 and type(env.dt) is float


@pytest.mark.parametrize("name", ["low", "time"])
def test_the_ends_of_an_episode_have_different_names(name):
    with pytest.raises(UserError, match=f"truncations has '{name}', the name of another end"):
        dataclasses.replace(TASK, truncations={name: low})


@pytest.mark.parametrize("entries", [("height",), 3, [Quantity("height")]])
def test_entries_of_an_observation_are_a_tuple_of_quantities(entries):
    with pytest.raises(UserError, match=r"entries of an ObservationTerm is .*; give a tuple"):
        ObservationTerm(height, 5.0, entries=entries)
    term = ObservationTerm(height, 5.0, entries=lambda drones, action: entries)
    with pytest.raises(UserError, match=r"entries of the observation term .* is .*; give a tuple"):
        explain(jd.make(dataclasses.replace(TASK, observation=(term,))))


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (
            lambda params, memory: memory,
            r"takes \(params, memory\); give a function of \(params, memory, state, action",
        ),
        (lambda params, memory, state, action, setpoint, dt: action, r"returns an array \(4,\) .*; return the memory"),
        (
            lambda params, memory, state, action, setpoint, dt: (memory, action[:3]),
            r"an array \(3,\) .*; return the mem",
        ),
        (
            lambda params, memory, state, action, setpoint, dt: (state.pos, action),
            r"with an array \(3,\) .*keep its sh",
        ),
    ],
)
def test_an_action_type_returns_its_memory_and_four_rotor_speeds(command, message):
    with pytest.raises(UserError, match=message):
        jd.make(TASK, action=jd.envs.Action(4, command, init=lambda: jnp.zeros(4)))
