"""Environments in other processes: spawned ones fly, forked ones say why they cannot."""

import functools
import os

import gymnasium
import numpy as np
import pytest

from jaxdrones.adapters.gymnasium import GymnasiumEnv, VectorEnv
from jaxdrones.envs import make

pytestmark = pytest.mark.float32


hover = functools.partial(GymnasiumEnv, "hover", duration=0.05)


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_process_is_told_what_to_do(env_of):
    env = env_of("hover", duration=0.05)
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        messages = []
        for use in (lambda: make("hover"), lambda: env.compiled(type(env).reset)):
            try:
                use()
            except Exception as error:
                messages.append(f"{type(error).__name__}: {error}")
        os.write(write, "\n".join(messages).encode())
        os._exit(0)
    os.close(write)
    with open(read) as pipe:
        lines = pipe.read().splitlines()
    os.waitpid(child, 0)
    assert len(lines) == 2
    assert all("RuntimeError" in line and "context='spawn'" in line for line in lines)


@pytest.mark.slow
def test_environments_fly_in_spawned_processes():
    envs = gymnasium.vector.AsyncVectorEnv([hover, hover], context="spawn", shared_memory=False)
    try:
        obs, _ = envs.reset(seed=3)
        alone = hover()
        np.testing.assert_allclose(obs[1], alone.reset(seed=4)[0], rtol=1e-4, atol=1e-5)
        for _ in range(6):
            obs, *_ = envs.step(np.zeros((2, 4), np.float32))
        assert obs in envs.observation_space
    finally:
        envs.close()


@pytest.mark.slow
@pytest.mark.needs("pybullet")
def test_worlds_of_bullet_fly_in_processes_as_in_one():
    options = dict(backend="bullet", duration=0.05)
    make_one = functools.partial(GymnasiumEnv, "hover", **options)
    mode = gymnasium.vector.AutoresetMode.SAME_STEP
    apart = gymnasium.vector.AsyncVectorEnv([make_one] * 2, context="spawn", autoreset_mode=mode)
    together = VectorEnv("hover", 2, **options)
    try:
        assert apart.single_observation_space == together.single_observation_space
        found, expected = apart.reset(seed=3)[0], together.reset(seed=3)[0]
        actions = np.random.default_rng(0).uniform(-0.1, 0.1, (4, *apart.action_space.shape)).astype(np.float32)
        for action in actions:
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
            (found, *outcome), (expected, *others) = apart.step(action)[:4], together.step(action)[:4]
            for x, y in zip(outcome, others, strict=True):
                np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-5)
    finally:
        apart.close()
        together.close()
