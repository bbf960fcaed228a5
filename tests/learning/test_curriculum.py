"""The progress of training reaches the start of a task."""

import dataclasses

import jax
import numpy as np
import pytest
from double_integrator import SMALL
from helpers import jit_unoptimized

import jaxdrones as jd
from jaxdrones.learning import collect, ppo

KEY = jax.random.key(0)
HOVER = jd.make("hover").task


def rising(key, params, progress):
    """Starts at a height of 1 m plus the progress, with the progress as the task's variable."""
    state, variables = HOVER.start(key, params)
    pos = state.pos.at[:, 2].set(1 + progress)
    return state.replace(pos=pos), variables


@pytest.mark.slow
@pytest.mark.float32
def test_the_start_of_a_task_sees_the_progress_of_training_without_another_compilation():
    env = jd.make(dataclasses.replace(HOVER, start=rising, duration=0.02))  # an episode of two steps
    worlds = jit_unoptimized(lambda: [env.reset(KEY, *progress)[1] for progress in ((0.25,), ())])()
    np.testing.assert_allclose([world.drones.pos[0, 2] for world in worlds], [1.25, 2.0], rtol=1e-6)
    config, traced = dataclasses.replace(SMALL[ppo], updates=4, restart_fraction=0.0), []

    @jit_unoptimized
    def update(state):
        traced.append(state)
        return ppo.update(env, config, state)[0]

    state = jit_unoptimized(lambda: ppo.init(KEY, env, config))()
    for number in range(3):  # of two steps each, after which all worlds have been reset
        state = update(state)
        height = state.worlds.episodes.world.drones.pos[:, 0, 2]
        np.testing.assert_allclose(height, 1 + number / 4, atol=0.02)
    assert len(traced) == 1


def test_the_progress_of_training_is_the_share_of_the_updates_that_are_made():
    env = jd.make(dataclasses.replace(HOVER, start=rising))
    config = dataclasses.replace(SMALL[ppo], updates=4)
    assert [collect.progress_of(env, config, np.int32(step)) for step in range(4)] == [0, 0.25, 0.5, 0.75]
    assert collect.progress_of(jd.make(HOVER), config, np.int32(0)) is None


@pytest.mark.parametrize("progress", [-0.1, 1.5, "half"])
def test_a_progress_beyond_that_of_training_is_refused(progress):
    with pytest.raises(ValueError, match=f"progress is .*{progress}.*; give a number of at least 0 and at most 1"):
        jd.make(HOVER).reset(KEY, progress)
