"""Landing: how fast a drone touches down is what it falls with, and a hard touch is no success."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

from jaxdrones.envs import make

ENV = make("landing")
OFF = -jnp.ones((1, 4))
RESTS = {"error": [0.0], "speed": [0.0], "upright": [1.0]}


@pytest.mark.parametrize(("touch_speed", "landed"), [(0.3, True), (0.8, False)])
def test_only_a_soft_touch_is_a_success(touch_speed, landed):
    metrics = {name: jnp.array([value]) for name, value in (RESTS | {"touch_speed": [touch_speed]}).items()}
    assert ENV.task.success(metrics, ENV.dt).tolist() == [landed]


@pytest.mark.slow
def test_a_drone_that_falls_touches_at_the_speed_of_its_fall():
    height, step = 0.4, jit_unoptimized(ENV.step)
    world = jit_unoptimized(ENV.reset)(jax.random.key(0))[1]
    pad = world.variables["goal"]
    level = world.drones.replace(
        pos=pad.at[:, 2].add(height),
        quat=jnp.array([[0.0, 0, 0, 1]]),
        vel=jnp.zeros((1, 3)),
        omega=jnp.zeros((1, 3)),
        rpm=jnp.zeros((1, 4)),
    )
    world = world.replace(drones=level)
    speeds = []
    for k in range(60):
        _, world, *_ = step(jax.random.key(k), world, OFF)
        speeds.append(world.variables["touch_speed"].item())
    np.testing.assert_allclose(speeds[-1], np.sqrt(2 * 9.8 * height), rtol=0.05)
    assert speeds[20] == 0 and abs(world.drones.vel[0, 2]) < 0.5 * speeds[-1]  # in the air; on the ground
