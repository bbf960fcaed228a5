"""Compiled functions of the simulator can be saved by `jax.export` and run in another process."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import jaxdrones as jd
from jaxdrones.pytree import PyTreeNode

pytestmark = [pytest.mark.float32, pytest.mark.needs("flatbuffers")]

OTHER_PROCESS = """
import sys, jax, numpy as np, jaxdrones as jd
from jax import export
saved = export.deserialize(open(sys.argv[1], "rb").read())
params = jd.repeat(jd.load_params("cf2x"), 2)
state = jd.State.at_rest(jax.numpy.array([[0.0, 0, 1], [1.0, 0, 1]]))
after = saved.call(params, state, jax.numpy.full((2, 4), 15000.0))
np.save(sys.argv[2], np.concatenate([x.ravel() for x in jax.tree.leaves(after)]))
"""


@pytest.mark.slow
def test_a_step_is_the_same_in_another_process(tmp_path):
    params = jd.repeat(jd.load_params("cf2x"), 2)
    state = jd.State.at_rest(jnp.array([[0.0, 0, 1], [1.0, 0, 1]]))
    rpm = jnp.full((2, 4), 15000.0)
    step = jax.jit(jd.make_step(dt=0.01))
    (tmp_path / "step").write_bytes(export.export(step)(params, state, rpm).serialize())
    files = [str(tmp_path / name) for name in ("step", "after.npy")]
    subprocess.run([sys.executable, "-c", OTHER_PROCESS, *files], check=True)
    expected = np.concatenate([np.ravel(x) for x in jax.tree.leaves(step(params, state, rpm))])
    np.testing.assert_array_equal(np.load(files[1]), expected)


@pytest.mark.parametrize("task", ["hover", pytest.param("forest", marks=pytest.mark.slow)])
def test_worlds_episodes_and_scenes_are_arguments_and_results_that_can_be_saved(task):
    episodes = jd.envs.AutoReset(jd.make(task))
    key = jax.random.PRNGKey(0)
    _, episode = jax.eval_shape(episodes.reset, key)
    action = jnp.zeros((1, episodes.env.action_size))
    exported = export.export(jax.jit(episodes.step))(key, episode, action)
    again = export.deserialize(exported.serialize())
    assert again.in_tree == exported.in_tree and again.out_tree == exported.out_tree


def test_a_class_that_is_defined_again_replaces_the_first_without_an_error():
    def define():
        class Twice(PyTreeNode):
            x: jax.Array

        return Twice

    define()
    assert jax.tree.leaves(define()(x=jnp.ones(()))) == [1]
