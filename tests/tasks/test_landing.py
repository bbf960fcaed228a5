"""Landing: how fast a drone touches down is what it falls with, and a hard touch is no success."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

from jaxdrones import State, load_params, repeat
from jaxdrones.envs import TASKS, make
from jaxdrones.tasks import World

ENV = functools.cache(lambda: make("landing"))
OFF = -jnp.ones((1, 4))
RESTS = {"error": [0.0], "speed": [0.0], "upright": [1.0]}


@pytest.mark.parametrize(("touch_speed", "landed"), [(0.3, True), (0.8, False)])
def test_only_a_soft_touch_is_a_success(touch_speed, landed):
    metrics = {name: jnp.array([value]) for name, value in (RESTS | {"touch_speed": [touch_speed]}).items()}
    assert ENV().task.success(metrics, ENV().dt).tolist() == [landed]


def flown(task, variables, heights, climbs=(0.0,) * 3):
    """Variables after every step of a drone at these heights (m) with these vertical speeds (m/s)."""
    params = repeat(load_params("cf2x"), 1)
    for height, climb in zip(heights, climbs, strict=True):
        drones = State.at_rest([[0, 0, height]]).replace(vel=jnp.array([[0, 0, climb]]))
        world = World(params, drones, variables, None, jnp.zeros((1, 1, 4)), jnp.zeros(()), jnp.ones(1, bool), 0.01)
        variables = task.advance(task, world)
        world = world.replace(variables=variables)
    return world, variables


def test_the_touch_speed_is_that_of_the_last_step_in_the_air_and_the_largest():
    """The step that comes within 2 cm of rest may already have been slowed by the ground."""
    start = {"goal": jnp.array([[0, 0, 0.01]]), "sinking": jnp.zeros(1), "touch_speed": jnp.zeros(1)}
    _, after = flown(ENV().task, start, (0.06, 0.025, 0.01), (-1.0, -0.4, -0.1))
    assert after["touch_speed"].tolist() == [1.0]
    assert flown(ENV().task, start, (0.9, 0.8, 0.7), (-1.0, -2.0, -3.0))[1]["touch_speed"].tolist() == [0.0]


def test_the_altitude_lost_is_down_to_the_lowest_point():
    task = TASKS["recovery"]()
    start = {"goal": jnp.zeros((1, 3)), "lowest": jnp.full(1, 5.0), "start": jnp.full(1, 5.0)}
    world, _ = flown(task, start, (4.5, 3.5, 4.75))
    assert task.metrics["altitude_lost"](task, world).tolist() == [1.5]


@pytest.mark.slow
def test_a_drone_that_falls_touches_at_the_speed_of_its_fall():
    height, step = 0.4, jit_unoptimized(ENV().step)
    world = jit_unoptimized(ENV().reset)(jax.random.key(0))[1]
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
