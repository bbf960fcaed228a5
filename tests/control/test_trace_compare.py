"""The PID in closed loop at 500 Hz, as `compare.py` of gym-pybullet-drones (2021) flies it for 29 s."""

from typing import NamedTuple

import golden_data
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop import recorded_vehicle
from helpers import jit_unoptimized

from jaxdrones import State, rotation
from jaxdrones.control import Setpoint, pid

DAMPING = 0.03999999910593033  # 1/s, of Bullet in single precision


class Body(NamedTuple):
    """What Bullet moves, with the angular velocity in the world, and the attitude by which it turns forces."""

    pos: jax.Array
    quat: jax.Array
    vel: jax.Array
    omega: jax.Array
    before: jax.Array


def moved(constants, body, rpm, dt):
    """A step of Bullet without contact: its damping, and forces turned by the attitude of the step before."""
    inertia = jnp.array(constants["J_bullet"])
    thrust = constants["kf"] * rpm**2
    up = rotation.z_axis(body.before)
    arms = [rotation.rotate(body.quat, jnp.array(arm)) for arm in constants["rotor_positions"]]
    torque = sum(jnp.cross(arm, up * f) for arm, f in zip(arms, thrust, strict=True))
    torque = torque + up * constants["km"] * jnp.dot(jnp.array([-1.0, 1, -1, 1]), rpm**2)
    acc = up * jnp.sum(thrust) / constants["m"] - jnp.array([0, 0, constants["g"]])
    acc = acc - DAMPING * (1 + jnp.linalg.norm(body.vel)) * body.vel
    omega = rotation.rotate_inverse(body.quat, body.omega)
    turn = (rotation.rotate_inverse(body.quat, torque) - jnp.cross(omega, inertia * omega)) / inertia
    turn = turn - DAMPING * (1 + jnp.linalg.norm(omega)) * omega
    vel, world = body.vel + dt * acc, body.omega + dt * rotation.rotate(body.quat, turn)
    quat = rotation.normalize(rotation.multiply(rotation.exp(dt * world), body.quat))
    return Body(body.pos + dt * vel, quat, vel, world, body.quat)


@pytest.mark.parametrize("name", golden_data.names("trace_pos", variant="paper", physics="pyb"))
def test_the_pid_flies_the_trace_as_it_was_flown(name):
    """Rows are 25 steps apart; the x set-point is sin t, one period late, as in the trace."""
    case = golden_data.load(name)
    arrays, every = case.arrays, case.about["decimation"]
    dt, rows = 1 / case.about["control_freq_hz"], len(arrays["t"])
    params, gains = golden_data.unlimited(recorded_vehicle(case)), pid.gains("cf2x")
    z = arrays["target_pos"][0, 0, 2]

    def advance(carry, k):
        body, memory, rpm = carry
        body = moved(case.constants, body, rpm, dt)
        omega = rotation.rotate_inverse(body.quat, body.omega)
        pos = jnp.stack([jnp.sin(jnp.maximum((k - 1) * dt, 0)), 0.0, z])
        memory, command = pid.control(
            gains, params, memory, State(body.pos, body.quat, body.vel, omega, rpm), Setpoint.at(pos), dt=dt
        )
        return (body, memory, command), (body, rpm, pos)

    start = arrays["initial_state"][0]
    quat = jnp.array(start[3:7])
    still = Body(jnp.array(start[:3]), quat, jnp.zeros(3), jnp.zeros(3), quat)
    body, rpm, pos = jit_unoptimized(
        lambda: jax.lax.scan(advance, (still, pid.init(), jnp.zeros(4)), jnp.arange(rows * every))[1]
    )()
    body, rpm, pos = jax.tree.map(lambda x: np.asarray(x)[::every], (body, rpm, pos))
    np.testing.assert_allclose(pos, arrays["target_pos"][:, 0], rtol=0, atol=1e-9)
    flown = np.concatenate([body.pos, body.vel, body.omega], axis=1)
    expected = np.concatenate([arrays["state"][:, 0, :3], arrays["state"][:, 0, 7:]], axis=1)
    np.testing.assert_allclose(flown, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.abs(np.sum(body.quat * arrays["state"][:, 0, 3:7], axis=1)), 1, rtol=0, atol=1e-9)
    np.testing.assert_allclose(rpm, arrays["rpm_applied"][:, 0], rtol=0, atol=1e-6)
    rms = np.sqrt(np.mean((body.pos - arrays["trace_pos"])[:, 0] ** 2))
    np.testing.assert_allclose(rms, case.about["rmse_pos"][0], rtol=1e-2)  # of all rows there, of every 25th here
