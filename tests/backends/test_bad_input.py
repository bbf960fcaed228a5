"""Every wrong shape and every wrong choice is a ValueError that says what, what was given and what to do."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones
from jaxdrones import State, downwash, drag

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


@pytest.mark.parametrize("name", vars(start))
def test_wrong_states(name):
    leaf = getattr(start, name)
    for wrong in leaf[0], leaf[:, :2], leaf[None], jnp.zeros((0, leaf.shape[1])):
        with pytest.raises(ValueError, match=r"state\.pos|state\." + name + " has shape.*expected"):
            step(team, start.replace(**{name: wrong}), rpm)


def test_a_state_with_fewer_velocities_than_positions_names_the_velocities():
    with pytest.raises(ValueError, match=r"state\.vel has shape \(1, 3\); expected \(2, 3\): state\.pos has 2 drones"):
        step(team, start.replace(vel=jnp.zeros((1, 3))), rpm)


@pytest.mark.parametrize("name", vars(team))
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


@pytest.mark.parametrize("dt", [0, -0.01, np.nan, np.inf])
def test_time_goes_forward(dt):
    with pytest.raises(ValueError, match=f"dt is {dt}; give a positive number"):
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
