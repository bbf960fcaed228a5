"""What is printed of the large objects is one line that says what they are."""

import functools

import jax
import jax.numpy as jnp
import pytest

import jaxdrones as jd
from jaxdrones.envs import AutoReset, make
from jaxdrones.flights import read_log
from jaxdrones.learning import Result
from jaxdrones.learning.networks import Policy


def two_gusts(params, state):
    return jd.Wrench.of_force(2 * params.external_force)


@functools.cache
def hover():
    return make("hover", drones=2, vehicle="hb")


@functools.cache
def policy():
    return Policy.init(jax.random.key(0), hover(), (32, 16))


LINES = {  # what makes an object, and what is printed of it
    "environment": (hover, "<Env hover: 2 x hb, dt 0.01 s, 500 steps, 4 actions and 22 observations a drone, explicit"),
    "own vehicle": (
        lambda: make("hover", vehicle=jd.load_params("hb")),
        "<Env hover: 1 x drones of own parameters, dt 0.01",
    ),
    "autoreset": (lambda: AutoReset(hover()), "<AutoReset of <Env hover: 2 x hb, "),
    "policy": (policy, "<Policy 22 -> 32 -> 16 -> 4, tanh, 1,332 parameters, statistics of 0 observations>"),
    "policies": (
        lambda: Policy.init(jax.random.key(0), hover(), (8,), True),
        "440 parameters, one network per drone, statistics",
    ),
    "result": (lambda: Result(policy(), None, {"reward": jnp.zeros(3)}), "<Result: <Policy 22 -> 32 -> 16 -> 4, "),
    "step": (
        lambda: jd.make_step((jd.drag, two_gusts), (jd.downwash,), jd.lagging_rotors, jd.rk4, dt=0.002, substeps=5),
        "<step: rk4 at 100 Hz x 5, lagging_rotors, effects: drag, two_gusts, pairs: downwash>",
    ),
    "log": (
        lambda: read_log("B10_lissajous_slow_rep1"),
        "<FlightLog B10_lissajous_slow_rep1.npz: 1 drone, ",
    ),
    "plain step": (
        jd.make_step,
        "<step: semi_implicit_euler at 240 Hz x 1, instant_rotors, effects: none, pairs: none>",
    ),
}


@pytest.mark.parametrize(
    ("make_thing", "line"),
    [
        pytest.param(*case, id=name, marks=pytest.mark.slow if name in ("policy", "policies") else ())
        for name, case in LINES.items()
    ],
)
def test_one_line_says_what_it_is(make_thing, line):
    thing = make_thing()
    assert line in repr(thing) == str(thing)
    assert "\n" not in repr(thing) and len(repr(thing)) < 200


def test_a_policy_can_be_printed_while_it_is_traced_mapped_and_rebuilt():
    lines = []
    jax.jit(jax.vmap(lambda policy: lines.append(repr(policy))))(jax.tree.map(lambda x: jnp.stack([x, x]), policy()))
    lines.append(repr(jax.tree.map(lambda x: None, policy())))
    lines.append(repr(jax.eval_shape(policy)))
    assert all("32 -> 16 -> 4, tanh" in line and "statistics" not in line for line in lines)


def test_a_step_and_an_environment_of_bullet_say_so():
    pytest.importorskip("pybullet")
    with make("hover", backend="bullet", vision=("rgb",)) as env:
        assert repr(env.physics) == "<step: Bullet at 100 Hz x 5>"
        assert "22 observations and rgb of 64 x 48 pixels a drone, bullet backend>" in repr(env)
