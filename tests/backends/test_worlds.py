"""Many worlds in chunks, each chunk one kernel."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from helpers import assert_close, flying, tape

import jaxdrones as jd
from jaxdrones.control import pid, setpoint

team = jd.repeat(jd.load_params("cf2x"), 2)
step = jd.make_step((jd.drag,), rotors=jd.lagging_rotors)
starts = jax.vmap(lambda vz: flying(team).replace(vel=jnp.full((2, 3), vz)))(jnp.linspace(-1, 1, 5))
commands = jnp.stack([tape(team, 10) * (1 + 0.01 * i) for i in range(5)])


def fly(start, commands):
    return jax.lax.scan(lambda state, rpm: (step(team, state, rpm), None), start, commands)[0]


def miss(start, commands):
    return jnp.sum(fly(start, commands).pos ** 2)


@pytest.mark.parametrize("chunk", [2, 5, 100], ids=["with a rest", "all", "more than there are"])
def test_a_flight_in_chunks_is_the_flight_at_once(chunk):
    flown = jax.jit(jd.over_worlds(fly, chunk))(starts, commands)
    assert_close(flown, jax.jit(jax.vmap(fly))(starts, commands), 1e-11)  # RPM of 10,000 to rounding


@pytest.mark.parametrize("chunk", [2, 5])
def test_commands_may_be_given_step_by_step(chunk):
    flown = jax.jit(jd.over_worlds(fly, chunk, in_axes=(0, 1)))(starts, commands.swapaxes(0, 1))
    assert_close(flown, jax.jit(jax.vmap(fly))(starts, commands), 1e-11)


@pytest.mark.parametrize(
    ("in_axes", "count", "says"),
    [(0, 4, "4, 5.*worlds"), ((0,), 5, "1 arguments, 2"), (-1, 5, "in_axes is -1"), ((0, "x"), 5, "in_axes is 'x'")],
)
def test_arguments_that_do_not_fit_are_named(in_axes, count, says):
    with pytest.raises(ValueError, match=says):
        jd.over_worlds(fly, in_axes=in_axes)(starts, commands[:count])


def test_a_number_for_all_worlds_is_no_argument():
    with pytest.raises(ValueError, match="no axis 0 over worlds"):
        jd.over_worlds(lambda start, gain: fly(start, commands[0] * gain))(starts, 1.01)


def test_gradients_are_those_of_the_flight_at_once_inside_a_chunk_and_around_all():
    at_once = jax.jit(jax.vmap(jax.grad(miss, 1)))(starts, commands)
    inside = jax.jit(jd.over_worlds(jax.grad(miss, 1), 2))(starts, commands)
    around = jax.jit(jax.grad(lambda c: jnp.sum(jd.over_worlds(miss, 2)(starts, c))))(commands)
    assert_close(inside, at_once, 1e-12)
    assert_close(around, at_once, 1e-12)


@pytest.mark.parametrize("chunk", [300, 1000], ids=["with a rest", "all"])
def test_a_large_gradient_alone_is_one_kernel_too(chunk):
    many = jax.tree.map(lambda x: jnp.repeat(x, 200, axis=0), (starts, jnp.tile(commands, (1, 10, 1, 1))))
    twice = jd.over_worlds(lambda start, commands: 2 * jax.grad(miss, 1)(start, commands), chunk)
    gradient = jax.jit(twice, compiler_options=jd.KERNEL_OPTIONS)(*many)
    one = jax.jit(jax.grad(miss, 1))(*jax.tree.map(lambda x: x[999], many))
    assert_close(gradient[999], 2 * one, 1e-12)


def test_an_argument_may_be_of_no_use():
    def reached(start, commands):
        return jnp.sum(fly(start, commands).pos)

    gradient = jax.grad(reached, 1)  # wherever it starts
    inside = jax.jit(jd.over_worlds(gradient, 2), compiler_options=jd.KERNEL_OPTIONS)(starts, commands)
    assert_close(inside, jax.jit(jax.vmap(gradient))(starts, commands), 1e-12)


def test_with_our_options_gradients_through_contacts_and_downwash_are_one_kernel():
    meeting = jd.make_step((jd.drag, jd.ground_contact), (jd.downwash,))

    def sunk(start, commands):
        return jnp.sum(jax.lax.scan(lambda s, rpm: (meeting(team, s, rpm), None), start, commands)[0].pos ** 2)

    lower = jnp.array([[0.0, 0.0, 0.012], [0.05, 0.0, 0.4]])  # one touches the ground, below the other
    low = starts.replace(pos=jnp.broadcast_to(lower, (5, 2, 3)))
    inside = jax.jit(jd.over_worlds(jax.grad(sunk, 1), 5), compiler_options=jd.KERNEL_OPTIONS)(low, commands)
    assert_close(inside, jax.jit(jax.vmap(jax.grad(sunk, 1)))(low, commands), 1e-12)
    assert jnp.all(jnp.abs(inside) > 0)


def test_a_controlled_flight_is_one_kernel():
    gains, hold = pid.gains(), setpoint.Setpoint.at(jnp.array([[0.0, 0.0, 1.0]] * 2))

    def control(params, memory, state, target):
        return pid.control(gains, params, memory, state, target, dt=1 / 240)

    def held(start):
        return jd.rollout(step, lambda p, m, s, k: jax.vmap(control)(p, m, s, hold), team, start, pid.init(2), 10)[0]

    assert_close(jax.jit(jd.over_worlds(held, 2))(starts), jax.jit(jax.vmap(held))(starts), 1e-10)


def test_a_function_with_a_solver_is_flown_without_the_single_kernel():
    def solved(start):
        return jnp.linalg.solve(jnp.eye(3) + start.pos.T @ start.pos, start.vel.T)

    assert_close(jax.jit(jd.over_worlds(solved, 2, one_kernel=False))(starts), jax.vmap(solved)(starts), 1e-12)


@pytest.mark.parametrize("chunk", [0, 1.5])
def test_a_chunk_is_a_whole_number(chunk):
    with pytest.raises(ValueError, match="chunk"):
        jd.over_worlds(fly, chunk)


def test_two_devices_fly_what_one_flies():
    script = """
import jax
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_enable_x64", True)
from test_worlds import *
flown = jax.jit(jd.over_worlds(fly, 2, devices=jax.devices()))
args = [jax.tree.map(lambda x: x[:4], x) for x in (starts, commands)]
assert len(flown(*args).pos.sharding.device_set) == 2
assert_close(flown(*args), jax.jit(jax.vmap(fly))(*args), 1e-11)
by_step = jax.jit(jd.over_worlds(fly, 2, in_axes=(0, 1), devices=jax.devices()))(args[0], args[1].swapaxes(0, 1))
assert_close(by_step, jax.jit(jax.vmap(fly))(*args), 1e-11)
with pytest.raises(ValueError, match="5 worlds.*2 devices"):
    flown(starts, commands)
"""
    folders = [Path(__file__).parent, Path(__file__).parent.parent]
    path = os.pathsep.join(map(str, folders))
    subprocess.run([sys.executable, "-c", script], check=True, env=os.environ | {"PYTHONPATH": path})
