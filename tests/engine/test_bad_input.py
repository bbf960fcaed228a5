"""Every wrong shape and every wrong choice is a ValueError that says what, what was given and what to do."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import CONSTANTS, STATE

import jaxdrones
from jaxdrones import State, Wrench, downwash, drag
from jaxdrones.checks import POSITIVE

team = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 2)
start = State.at_rest([[0.0, 0, 1], [1, 0, 1]])
rpm = jnp.full((2, 4), 14e3)
step = jaxdrones.make_step((drag,), (downwash,))


def shape(array):
    return str(np.shape(array)).replace("(", r"\(").replace(")", r"\)")


@pytest.mark.parametrize(
    "wrong", [np.zeros(4), np.zeros((2, 3)), np.zeros((3, 4)), np.zeros((1, 2, 4)), 14e3], ids=shape
)
def test_wrong_rotor_speeds(wrong):
    with pytest.raises(ValueError, match=rf"rpm has shape {shape(wrong)}; expected \(2, 4\).*each of 2 drones"):
        step(team, start, wrong)


@pytest.mark.parametrize("name", STATE)
def test_wrong_states(name):
    leaf = getattr(start, name)
    for wrong in leaf[0], leaf[:, :2], leaf[None], jnp.zeros((0, leaf.shape[1])):
        with pytest.raises(ValueError, match=r"state\.pos|state\." + name + " has shape.*expected"):
            step(team, start.replace(**{name: wrong}), rpm)


def test_a_state_with_fewer_velocities_than_positions_names_the_velocities():
    with pytest.raises(ValueError, match=r"state\.vel has shape \(1, 3\); expected \(2, 3\): state\.pos has 2 drones"):
        step(team, start.replace(vel=jnp.zeros((1, 3))), rpm)


@pytest.mark.parametrize("name", CONSTANTS)
def test_wrong_constants(name):
    leaf = getattr(team, name)
    for wrong in leaf[0], leaf[:1], leaf[None], leaf[..., None]:
        with pytest.raises(
            ValueError, match=rf"params\.{name} has shape {shape(wrong)}; expected.*2 drones.*repeat or.*stack"
        ):
            step(team.replace(**{name: wrong}), start, rpm)


def test_one_drones_constants_are_not_a_team():
    with pytest.raises(ValueError, match=r"params\.mass has shape \(\); expected \(2,\).*repeat or jaxdrones\.stack"):
        step(jaxdrones.load_params("cf2x"), start, rpm)


def test_zero_drones_are_no_world():
    nobody = State(*(jnp.zeros((0, n)) for n in (3, 4, 3, 3, 4)))
    with pytest.raises(ValueError, match=r"state\.pos has shape \(0, 3\); expected \(n, 3\).*at least one drone"):
        step(team, nobody, rpm)


def test_many_worlds_need_vmap():
    with pytest.raises(ValueError, match=r"state\.pos has shape \(5, 2, 3\).*jax\.vmap"):
        step(team, start.replace(pos=jnp.zeros((5, 2, 3))), rpm)


@pytest.mark.parametrize("dt", [0, -0.01, np.nan, np.inf, 4])
def test_time_goes_forward(dt):
    with pytest.raises(ValueError, match=f"dt is {dt}; give a number above 0 and at most 1"):
        jaxdrones.make_step(dt=dt)


@pytest.mark.parametrize("substeps", [0, -1, 2.0, "5", None])
def test_substeps_are_counted(substeps):
    with pytest.raises(ValueError, match=f"substeps is {substeps!r}; give a whole number of at least 1"):
        jaxdrones.make_step(substeps=substeps)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"effects": ("drag",)}, r"effects: 'drag' is not a function.*jaxdrones\.drag"),
        ({"effects": (drag, None)}, r"effects: None is not a function"),
        ({"effects": drag}, r"effects is a single function.*give a sequence.*\(jaxdrones\.drag,\)"),
        ({"pairs": ("downwash",)}, r"pairs: 'downwash' is not a function.*jaxdrones\.downwash"),
        ({"pairs": downwash}, r"pairs is a single function.*\(jaxdrones\.downwash,\)"),
        ({"rotors": "lagging"}, r"rotors: 'lagging' is not a function.*jaxdrones\.instant_rotors"),
        ({"integrator": "rk4"}, r"integrator: 'rk4' is not a function.*jaxdrones\.rk4"),
    ],
)
def test_choices_are_functions(arguments, message):
    with pytest.raises(ValueError, match=message):
        jaxdrones.make_step(**arguments)


def array_effect(params, state):
    return jnp.zeros(3)


def flat_effect(params, state):
    return Wrench(jnp.zeros(2), jnp.zeros(3))


def nothing(params, state):
    return None


def array_pair(params, state, other, other_state):
    return jnp.zeros(6)


@pytest.mark.parametrize(
    ("effects", "pairs", "message"),
    [
        ((array_effect,), (), r"effects: array_effect returned an array of shape \(3,\); return jaxdrones\.Wrench\("),
        ((flat_effect,), (), r"effects: flat_effect: force has shape \(2,\); expected \(3,\)"),
        ((nothing,), (), r"effects: nothing returned None; return jaxdrones\.Wrench\("),
        ((), (array_pair,), r"pairs: array_pair returned an array of shape \(6,\); return jaxdrones\.Wrench\("),
    ],
)
def test_an_effect_that_returns_no_wrench_is_named(effects, pairs, message):
    with pytest.raises(ValueError, match=message):
        jaxdrones.make_step(effects, pairs)(team, start, rpm)


@pytest.mark.parametrize(
    ("returned", "shape"),
    [
        (lambda rpm: rpm, r"\(4,\)"),
        (lambda rpm: (rpm[0], rpm), r"\(\(\), \(4,\)\)"),
        (lambda rpm: (rpm,), r"\(\(4,\),\)"),
    ],
)
def test_rotors_that_return_no_speeds_and_rates_are_named(returned, shape):
    def mine(params, state, command):
        return returned(command)

    with pytest.raises(
        ValueError, match=rf"rotors: mine returned arrays of shape {shape}; return a tuple of the speeds"
    ):
        jaxdrones.make_step(rotors=mine)(team, start, rpm)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"effects": (downwash,)},
            r"effects: downwash takes .*give a function of \(params, state\); .*belong to pairs",
        ),
        ({"pairs": (drag,)}, r"pairs: drag takes .*\(params, state, other, other_state\); .*belong to effects"),
        ({"rotors": drag}, r"rotors: drag takes .*give a function of \(params, state, command\)"),
        ({"integrator": drag}, r"integrator: drag takes .*give a function of \(derivative, state, dt\)"),
    ],
)
def test_a_function_of_other_arguments_is_named_when_the_step_is_built(arguments, message):
    with pytest.raises(ValueError, match=message):
        jaxdrones.make_step(**arguments)


def test_functions_without_a_signature_and_with_defaults_are_taken():
    def gust(params, state, force=0.0):
        return Wrench.of_force(jnp.full(3, force))

    effects = (functools.partial(gust, force=1.0), gust, jax.jit(gust), lambda *arguments: gust(*arguments))
    assert np.isfinite(jaxdrones.make_step(effects)(team, start, rpm).vel).all()


OFF = {
    "zero": np.zeros(4),
    "not a number": np.full(4, np.nan),
    "two": np.array([0, 0, 0, 2.0]),
    "almost": [0, 0, 0.1, 1],
}


def flown_once(params, state):
    return jaxdrones.rollout(step, lambda params, memory, state, k: (memory, rpm), params, state, None, 1)


@pytest.mark.parametrize("off", OFF)
@pytest.mark.parametrize("look", [lambda state: step(team, state, rpm), lambda state: flown_once(team, state)])
def test_a_quaternion_that_is_no_attitude_is_an_error_where_it_can_be_looked_at(look, off):
    broken = start.replace(quat=start.quat.at[1].set(jnp.asarray(OFF[off])))
    with pytest.raises(
        ValueError, match=r"state\.quat (has length .*give a unit quaternion \(x, y, z, w\)|is not finite)"
    ):
        look(broken)
    jax.eval_shape(look, broken)


def test_quaternions_that_are_off_by_rounding_are_taken_with_either_sign():
    for factor in (-1, 1 + 1e-4, 1 - 1e-4):
        assert np.isfinite(step(team, start.replace(quat=factor * start.quat), rpm).pos).all()


CONSTANTS = [(name, value) for name in POSITIVE for value in (0, -1)] + [
    ("km", -1),
    ("gravity", -9.8),
    ("collision_radius", -0.1),
]


@pytest.mark.parametrize(("name", "value"), CONSTANTS)
def test_constants_with_which_nothing_flies_are_named_where_they_can_be_looked_at(name, value):
    broken = team.replace(**{name: jnp.full_like(getattr(team, name), value)})
    for look in (lambda: step(broken, start, rpm), lambda: flown_once(broken, start)):
        with pytest.raises(ValueError, match=rf"params\.{name} is \[.*; give (positive )?numbers"):
            look()
    with pytest.raises(ValueError, match=rf"params\.{name} is"):  # closed over, they have values in `jit`, too
        jax.jit(lambda state: step(broken, state, rpm))(start)
    jax.eval_shape(lambda params: flown_once(params, start), broken)


@pytest.mark.slow
def test_rotors_without_a_limit_are_no_mistake():
    unlimited = team.replace(max_rpm=jnp.full(2, jnp.inf))
    assert np.isfinite(step(unlimited, start, rpm).pos).all()
    flown_once(unlimited, start)


@pytest.mark.parametrize("name", ["inertia", "rotor_pos", "mass"])
def test_a_list_in_place_of_an_array_is_named(name):
    broken = team.replace(**{name: np.asarray(getattr(team, name)).tolist()})
    for look in (
        lambda: step(broken, start, rpm),
        lambda: flown_once(broken, start),
        lambda: jaxdrones.repeat(broken, 2),
    ):
        with pytest.raises(ValueError, match=rf"params\.{name} is \[.*; give an array"):
            look()
    with pytest.raises(ValueError, match=r"state\.vel is \[\[.*; give an array"):
        step(team, start.replace(vel=np.asarray(start.vel).tolist()), rpm)
    with pytest.raises(ValueError, match=rf"params\.{name} is .*; give an array"):
        jax.jit(lambda state: step(broken, state, rpm))(start)


def test_parameters_that_are_none_are_refused_in_a_team():
    for wrong in ("cf2x", 0.03, None):
        with pytest.raises(ValueError, match=r"is given; repeat takes the parameters of a single drone"):
            jaxdrones.repeat(wrong, 2)
        with pytest.raises(ValueError, match=r"is given; stack takes the parameters of single drones"):
            jaxdrones.stack([wrong])


@pytest.mark.parametrize("dt", ["a", None, True, [0.1], 1e-50])
def test_time_is_a_number(dt):
    for control_step in (
        lambda: jaxdrones.make_step(dt=dt),
        lambda: jaxdrones.envs.make("hover", control_hz=dt or "a"),
    ):
        with pytest.raises(ValueError, match=r"is .*; give a (positive number|number above 0)"):
            control_step()


def _cell(params, state, *_):
    return jaxdrones.Wrench.of_force(params.aux["cell"] * state.pos)


def _ones(params, *_):
    return params.aux["cell"] * jnp.ones(4)


ZERO = jaxdrones.Model("flap", lambda params: jnp.zeros(4), _ones)
NEEDS_CONSTANT = {
    "effect": ("_cell", dict(effects=(drag, _cell))),
    "pair": ("_cell", dict(pairs=(_cell,))),
    "team effect": ("_cell", dict(team_effects=(_cell,))),
    "rotors": ("_ones", dict(rotors=_ones)),
    "rate": ("_ones", dict(models=(ZERO,))),
    "init": ("_ones", dict(models=(jaxdrones.Model("flap", _ones, ZERO.rate),))),
}


@pytest.mark.parametrize("where", NEEDS_CONSTANT)
def test_a_missing_constant_is_named_with_the_function_that_reads_it_and_the_remedy(where):
    name, options = NEEDS_CONSTANT[where]
    own = jaxdrones.make_step(**options)
    has = team.replace(aux={"tether": jnp.ones(2)})
    line = {"_cell": _cell, "_ones": _ones}[name].__code__.co_firstlineno + 1
    with pytest.raises(jaxdrones.errors.UserError) as error:
        own(has, own.init(has, start), rpm)
    assert str(error.value).startswith(f"{name} (test_bad_input.py, line {line}) raises KeyError: 'cell'")
    for part in "params.aux has tether", "params.aux | {'cell': ...}":
        assert part in str(error.value)


def test_a_key_error_of_a_function_with_its_entry_in_both_is_its_own():
    def own(params, state):
        raise KeyError("flap")

    both = {"flap": jnp.ones((2, 4))}
    with pytest.raises(KeyError, match="flap"):
        jaxdrones.make_step((own,))(team.replace(aux=both), start.replace(aux=both), rpm)
