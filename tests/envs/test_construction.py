"""An environment is immutable; it hashes by identity and pickles by value."""

import dataclasses
import functools
import os
import subprocess
import sys

import jax
import numpy as np
import pytest

import jaxdrones as jd
from jaxdrones.envs import make
from jaxdrones.envs.disturbances import random_pushes

PICKLE = """
import sys
sys.modules["gymnasium"] = None  # importing it raises ImportError
import dataclasses, pickle, jax, jaxdrones
env = jaxdrones.make("hover", vehicle=jaxdrones.load_params("hb"), realistic=True, noise=lambda key, state: state)
env = dataclasses.replace(env, steps=3)
again = pickle.loads(pickle.dumps(env))
assert again.steps == 3
key = jax.random.key(0)
assert (again.reset(key)[0] == env.reset(key)[0]).all()
"""


@pytest.mark.slow
def test_an_environment_pickles_and_needs_no_gymnasium():
    """In a process of its own: types are not checked there, and what checks them does not pickle."""
    environ = {name: value for name, value in os.environ.items() if name != "JAX_ENABLE_X64"}
    done = subprocess.run([sys.executable, "-c", PICKLE], capture_output=True, text=True, env=environ, check=False)
    assert done.returncode == 0, done.stderr


def test_an_environment_is_immutable():
    env = make("hover")
    with pytest.raises(dataclasses.FrozenInstanceError):
        env.steps = 3
    assert hash(env) == hash(env) and env != dataclasses.replace(env, steps=3)


@pytest.mark.slow
def test_replacing_a_field_keeps_what_is_drawn():
    env = make("hover", effects=("drag",), delay=(0.0, 0.04), disturbance=jd.dryden(7.7))
    other = dataclasses.replace(env, steps=3)
    assert len(other.draws) == len(env.draws) == 2
    for a, b in zip(*(jax.tree.leaves(e.reset(jax.random.key(1))) for e in (env, other)), strict=True):
        np.testing.assert_array_equal(a, b) if not jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key) else None


@pytest.mark.parametrize(
    ("task", "kind", "given"),
    [
        ("landing", "effects", ("drag", "ground_contact")),
        ("landing", "effects", (functools.partial(jd.ground_contact),)),
        ("meetup", "pairs", ("drone_contact",)),
        ("hover", "effects", (jd.external_force,)),
    ],
)
def test_what_a_task_or_a_disturbance_brings_acts_once_where_it_is_given_too(task, kind, given):
    contact = tuple(f for f in (jd.ground_contact, jd.drone_contact) if f.needs.contact in make(task).task.contact)
    physics = make(task, disturbance=random_pushes(0.3), **{kind: given}).physics.physics
    functions = [f.func if isinstance(f, functools.partial) else f for f in (*physics.effects, *physics.pairs)]
    for brought in (*contact, jd.external_force):
        assert functions.count(brought) == 1
