"""The shapes in annotations are checked while the tests run."""

import jax
import jax.numpy as jnp
import jaxtyping
import pytest

import jaxdrones as jd
from jaxdrones import vector
from jaxdrones.control import pid, velocity


def test_a_function_that_takes_another_shape_than_it_says_is_found():
    with pytest.raises(jaxtyping.TypeCheckError, match=r"vector\.cross"):
        vector.cross(jnp.ones((3, 1)), jnp.ones((3, 1)))


def test_an_error_of_the_function_itself_comes_first():
    state = jax.tree.map(lambda x: x[0], jd.State.at_rest(jnp.zeros((1, 3))))
    with pytest.raises(ValueError, match=r"use jax\.vmap for a team"):
        velocity.control(pid.gains(), jd.load_params("cf2x"), pid.init(), state, jnp.zeros((2, 4)), dt=0.01)
