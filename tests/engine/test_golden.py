"""The explicit backend against recorded flights of gym-pybullet-drones' explicit model, whose equations are ours."""

from functools import lru_cache

import golden_data
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, assert_same_motion, fly

import jaxdrones
from jaxdrones import State

ATOL = 1e-9  # SI units; both sides are float64 and round differently over up to 1000 steps (measured: 4e-13)

make_step = lru_cache(lambda dt, substeps=1: jaxdrones.make_step(dt=dt, substeps=substeps))


@pytest.mark.parametrize("name", golden_data.names(kind="open_loop_rollout", physics="dyn", variant="main"))
def test_whole_rollouts_agree(name):
    case = golden_data.load(name)
    pos, quat, vel, omega = (jnp.asarray(case.arrays[key]) for key in ("pos", "quat", "vel", "body_rates"))
    start = State(pos[0], quat[0], vel[0], omega[0], jnp.zeros((len(pos[0]), 4)))
    params, rpm = golden_data.flown(case, golden_data.explicit_params(case))
    step = make_step(1 / case.about["physics_freq_hz"], case.about["physics_steps_per_record"])
    flown = fly(step, jaxdrones.repeat(params, len(pos[0])), start, jnp.asarray(rpm))
    applied = jnp.asarray(case.arrays["rpm_applied"])
    assert_same_motion(flown, State(pos[1:], quat[1:], vel[1:], omega[1:], applied), ATOL)


@pytest.mark.parametrize("name", golden_data.names("pos_in", physics="dyn", variant="main"))
def test_single_steps_agree(name):
    case = golden_data.load(name)
    pos, quat, vel, omega = (
        jnp.asarray(case.arrays[key]) for key in ("pos_out", "quat_out", "vel_out", "body_rates_out")
    )
    assert_same_motion(_one_step(case), State(pos, quat, vel, omega, jnp.asarray(case.arrays["rpm"])), ATOL)


@pytest.mark.parametrize("name", golden_data.names("pos_in", physics="dyn", variant="paper"))
def test_single_steps_of_the_paper_agree_in_velocity_and_body_rates(name):
    """Its attitudes take body rates for rates of Euler angles and are not ours."""
    case = golden_data.load(name)
    stepped = _one_step(case)
    assert_close(stepped.vel, jnp.asarray(case.arrays["vel_out"]), ATOL)
    assert_close(stepped.omega, jnp.asarray(case.arrays["body_rates_out"]), ATOL)


@pytest.mark.float32
@pytest.mark.slow
@pytest.mark.parametrize("name", golden_data.names("pos_in", physics="dyn", variant="main"))
def test_single_steps_agree_in_float32(name):
    case = golden_data.load(name)
    stepped = _one_step(case)
    for key, actual in ("pos", stepped.pos), ("vel", stepped.vel), ("body_rates", stepped.omega):
        expected = case.arrays[f"{key}_out"]
        error = np.linalg.norm(actual - expected, axis=-1)
        # A few roundings of 6e-8 in each of ten sums; small numbers arise from larger ones, hence the floor of 1.
        assert np.all(error <= 1e-5 * np.maximum(np.linalg.norm(expected, axis=-1), 1)), key


def _one_step(case):
    """All samples at once: a team of drones that do not feel each other."""
    inputs = (jnp.asarray(case.arrays[f"{key}_in"]) for key in ("pos", "quat", "vel", "body_rates"))
    rpm = jnp.asarray(case.arrays["rpm"])
    team = jaxdrones.repeat(golden_data.unlimited(golden_data.explicit_params(case)), len(rpm))
    return make_step(case.about["dt"])(team, State(*inputs, jnp.zeros_like(rpm)), rpm)
