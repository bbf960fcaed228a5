"""Environments are known by the arguments they were made with."""

import copy
import functools
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones as jd
from jaxdrones.envs import make


def test_environments_are_equal_if_they_were_made_alike():
    params = jd.load_params("hb")
    env = make("hover", vehicle=params, height=2.0)
    same = make("hover", height=2.0, vehicle=jax.tree.map(jnp.array, params))
    assert env == same and hash(env) == hash(same)
    assert env != make("hover", vehicle=params.replace(mass=0.6), height=2.0) and env != make("hover", vehicle=params)
    other = copy.copy(env)
    assert other == env
    other.steps = 3
    assert other != env


def test_equal_environments_share_one_compiled_program():
    traced = []

    @functools.partial(jax.jit, static_argnums=0)
    def start(env, key):
        traced.append(env)
        return env.reset(key)[0]

    first, second = (start(make("hover", duration=1.0), jax.random.key(0)) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert len(traced) == 1


def test_a_pickled_environment_is_made_again_with_what_was_set_of_it():
    env = make("hover", vehicle=jd.load_params("hb"), duration=1.0)
    env.steps = 3
    again = pickle.loads(pickle.dumps(env))
    assert again == env and again.steps == 3
    np.testing.assert_array_equal(again.reset(jax.random.key(0))[0], env.reset(jax.random.key(0))[0])


def test_a_function_that_has_no_name_cannot_be_pickled_and_is_named():
    env = make("hover", noise=lambda key, state: state)
    with pytest.raises((pickle.PicklingError, AttributeError), match="lambda"):
        pickle.dumps(env)
