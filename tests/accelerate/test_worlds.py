"""Many worlds in chunks, each chunk one kernel."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, flying, mostly_slow, mostly_slow_rows, tape

import jaxdrones as jd
from jaxdrones.accelerate import compiler, fitting, worlds
from jaxdrones.accelerate.worlds import in_chunks
from jaxdrones.control import for_team, pid, setpoint

team = jd.repeat(jd.load_params("cf2x"), 2)
step = jd.make_step((jd.drag,), rotors=jd.lagging_rotors)
starts = jax.vmap(lambda vz: flying(team).replace(vel=jnp.full((2, 3), vz)))(jnp.linspace(-1, 1, 5))
commands = jnp.stack([tape(team, 10) * (1 + 0.01 * i) for i in range(5)])


def fly(start, commands):
    return jax.lax.scan(lambda state, rpm: (step(team, state, rpm), None), start, commands)[0]


def miss(start, commands):
    return jnp.sum(fly(start, commands).pos ** 2)


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [2, 5, 100], ids=["with a rest", "all", "more than there are"])
def test_a_flight_in_chunks_is_the_flight_at_once(chunk):
    flown = in_chunks(fly, chunk)(starts, commands)
    assert_close(flown, jax.jit(jax.vmap(fly))(starts, commands), 1e-11)  # RPM of 10,000 to rounding


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [2, 5])
def test_commands_may_be_given_step_by_step(chunk):
    flown = in_chunks(fly, chunk, in_axes=(0, 1))(starts, commands.swapaxes(0, 1))
    assert_close(flown, jax.jit(jax.vmap(fly))(starts, commands), 1e-11)


@pytest.mark.parametrize(
    ("in_axes", "count", "says"),
    [
        (0, 4, "4, 5.*worlds"),
        ((0,), 5, "1 arguments, 2"),
        (-1, 5, "in_axes is -1"),
        ((0, "x"), 5, "in_axes is 'x'"),
        ((0, None), 5, "in_axes is None; close over an argument .* inside of a jax.jit of it if it changes"),
    ],
)
def test_arguments_that_do_not_fit_are_named(in_axes, count, says):
    with pytest.raises(ValueError, match=says):
        jd.over_worlds(fly, in_axes=in_axes)(starts, commands[:count])


def test_what_is_no_function_and_arguments_by_name_are_refused():
    with pytest.raises(ValueError, match="function: 3 is not a function"):
        jd.over_worlds(3)
    with pytest.raises(ValueError, match="start is given by name; give all arguments of many worlds by position"):
        jd.over_worlds(fly)(start=starts)


def test_a_number_of_devices_is_no_device():
    with pytest.raises(ValueError, match=r"devices is 2; give a sequence, for example \(\*jax.devices\(\),\)"):
        jd.over_worlds(fly, devices=2)


def test_a_number_for_all_worlds_is_no_argument():
    with pytest.raises(ValueError, match="no axis 0 over worlds"):
        jd.over_worlds(lambda start, gain: fly(start, commands[0] * gain))(starts, 1.01)


@pytest.mark.slow
def test_gradients_are_those_of_the_flight_at_once_inside_a_chunk_and_around_all():
    at_once = jax.jit(jax.vmap(jax.grad(miss, 1)))(starts, commands)
    inside = in_chunks(jax.grad(miss, 1), 2)(starts, commands)
    around = jax.jit(jax.grad(lambda c: jnp.sum(in_chunks(miss, 2)(starts, c))))(commands)
    assert_close(inside, at_once, 1e-12)
    assert_close(around, at_once, 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [300, 1000], ids=["with a rest", "all"])
def test_a_large_gradient_alone_is_one_kernel_too(chunk):
    many = jax.tree.map(lambda x: jnp.repeat(x, 200, axis=0), (starts, jnp.tile(commands, (1, 10, 1, 1))))
    twice = in_chunks(lambda start, commands: 2 * jax.grad(miss, 1)(start, commands), chunk)
    gradient = twice(*many)
    one = jax.jit(jax.grad(miss, 1))(*jax.tree.map(lambda x: x[999], many))
    assert_close(gradient[999], 2 * one, 1e-12)


@pytest.mark.slow
def test_an_argument_may_be_of_no_use():
    def reached(start, commands):
        return jnp.sum(fly(start, commands).pos)

    gradient = jax.grad(reached, 1)  # wherever it starts
    inside = in_chunks(gradient, 2)(starts, commands)
    assert_close(inside, jax.jit(jax.vmap(gradient))(starts, commands), 1e-12)


@pytest.mark.slow
def test_random_numbers_that_do_not_matter_prevent_no_kernel(monkeypatch):
    def reached(start, commands, key):
        _ = jax.random.normal(key)  # as in an environment without noise
        return fly(start, commands).pos

    many = in_chunks(reached, 2)
    keys = jax.random.split(jax.random.key(0), 5)
    monkeypatch.setattr(many, "_several_kernels", None)  # an error if called
    assert_close(many(starts, commands, keys), jax.vmap(reached)(starts, commands, keys), 1e-12)


@pytest.mark.parametrize("inside_jit", [False, True])
def test_results_may_depend_on_no_argument(inside_jit):
    many = in_chunks(lambda start: (jnp.arange(3.0), jnp.zeros(())), 2)
    same, nothing = (jax.jit(many) if inside_jit else many)(starts)
    np.testing.assert_array_equal(same, np.tile(np.arange(3.0), (5, 1)))
    assert nothing.shape == (5,)


@pytest.mark.slow
def test_with_our_options_gradients_through_contacts_and_downwash_are_one_kernel():
    meeting = jd.make_step((jd.drag, jd.ground_contact), (jd.downwash,))

    def sunk(start, commands):
        return jnp.sum(jax.lax.scan(lambda s, rpm: (meeting(team, s, rpm), None), start, commands)[0].pos ** 2)

    lower = jnp.array([[0.0, 0.0, 0.012], [0.05, 0.0, 0.4]])  # one touches the ground, below the other
    low = starts.replace(pos=jnp.broadcast_to(lower, (5, 2, 3)))
    inside = in_chunks(jax.grad(sunk, 1), 5)(low, commands)
    assert_close(inside, jax.jit(jax.vmap(jax.grad(sunk, 1)))(low, commands), 1e-12)
    assert jnp.all(jnp.abs(inside) > 0)


@pytest.mark.slow
def test_a_controlled_flight_is_one_kernel():
    gains, hold = pid.gains(), setpoint.Setpoint.at(jnp.array([[0.0, 0.0, 1.0]] * 2))

    def control(params, memory, state, target):
        return pid.control(gains, params, memory, state, target, dt=1 / 240)

    def held(start):
        return jd.rollout(
            step, lambda p, m, s, k: jax.vmap(control)(p, m, s, hold), team, start, for_team(pid.init(), 2), 10
        )[0]

    assert_close(in_chunks(held, 2)(starts), jax.jit(jax.vmap(held))(starts), 1e-10)


@pytest.mark.slow
def test_a_function_of_which_no_kernel_can_be_made_is_flown_by_many():
    def solved(start):
        return jnp.linalg.solve(jnp.eye(3) + start.pos.T @ start.pos, jnp.sort(start.vel).T)

    assert_close(in_chunks(solved, 2)(starts), jax.vmap(solved)(starts), 1e-12)


@pytest.mark.parametrize(
    ("numbers", "in_loop", "chunks"),
    mostly_slow_rows(
        [(0, True, True), (0, False, False), (3, True, False), (2_000, True, True)],
        [(0, True, True), (0, False, False)],
    ),
)
def test_several_kernels_are_for_chunks_where_these_save_more_than_they_cost(numbers, in_loop, chunks):
    def sorted_speeds(start, key):
        noise = jnp.sum(jax.random.normal(key, (numbers,))) if numbers else 0.0
        return jax.lax.fori_loop(0, 2 if in_loop else 1, lambda _, v: jnp.sort(-v, axis=0) + noise, start.vel)

    keys = jax.random.split(jax.random.key(0), 5)
    many = in_chunks(sorted_speeds, 2)
    assert_close(many(starts, keys), jax.vmap(sorted_speeds)(starts, keys), 1e-12)
    assert ("dynamic_slice" in str(jax.make_jaxpr(many)(starts, keys))) == chunks


def summed_squares(x):
    """2 + 3^2 and so on, by primitives that hold a program of their own."""
    return jax.lax.reduce_window(x, 0.0, lambda a, b: a + b * b, (2,), (1,), "SAME")


def test_programs_that_a_reduction_holds_are_no_calls():
    x = jnp.array([[1.0, 2.0, 3.0], [2.0, 0.0, 1.0]])
    looped = jd.over_worlds(lambda x: jax.lax.fori_loop(0, 1, lambda _, x: summed_squares(x), x))
    np.testing.assert_array_equal(jax.jit(looped)(x), jax.vmap(summed_squares)(x))
    np.testing.assert_array_equal(jd.over_worlds(summed_squares)(x)[0], [5, 13, 9])


DEGENERATE = {
    "no passage": (lambda x: jax.lax.scan(lambda x, _: (x + 1, x), x, length=0), jnp.ones((3, 2))),
    "no number": (lambda x: jax.lax.scan(lambda x, _: (x + 1, x), x, length=2), jnp.ones((3, 0))),
    "no world": (lambda x: jax.lax.scan(lambda x, _: (x + 1, x), x, length=2), jnp.ones((0, 2))),
    "nothing of a world": (lambda x: jnp.arange(3), jnp.ones((2, 2))),
    "no result": (lambda x: (), jnp.ones((2, 2))),
    "numbers that take the type of others": (lambda x: x * jnp.ones(2, jnp.float16), 2.0 * jnp.arange(3)[:, None]),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_where_there_is_nothing_to_do_it_is_done_as_vmap_does_it(name):
    function, x = DEGENERATE[name]
    found, expected = jd.over_worlds(function)(x), jax.vmap(function)(x)
    assert jax.tree.map(lambda y: (y.shape, y.dtype), found) == jax.tree.map(lambda y: (y.shape, y.dtype), expected)
    assert_close(found, expected, 0)


def lines(number, size):
    """Each of them uses the vector in two orders."""

    def function(x):
        for _ in range(number):
            x = jnp.sin(x) * 1.1 + x[::-1] * 0.1
        return x

    return function, jnp.linspace(0, 1, 2 * size).reshape(2, size)


@pytest.mark.parametrize("inside_jit", [False, True], ids=["compiles itself", "inside jit"])
@pytest.mark.parametrize("size", [3, 50], ids=["numbers apart", "whole"])
@pytest.mark.parametrize("looped", mostly_slow([False, True], [True]), ids=["straight", "in a loop"])
def test_a_line_does_not_double_the_program(looped, size, inside_jit):
    function, x = lines(24, size)
    if looped:
        flown = jd.over_worlds(lambda x: jax.lax.fori_loop(0, 2, lambda _, x: function(x), x))
    else:
        flown = jd.over_worlds(function)
    found = (jax.jit(flown) if inside_jit else flown)(x)  # or it takes hours
    np.testing.assert_allclose(found[0], function(x[0]) if not looped else function(function(x[0])), rtol=1e-12)


@pytest.mark.slow
def test_gradients_of_teams_are_one_kernel_inside_jit_too():
    meeting = jd.make_step((jd.drag, jd.ground_contact), (jd.downwash,))

    def sunk(start, rpm):
        return jnp.sum(jax.lax.scan(lambda s, rpm: (meeting(team, s, rpm), None), start, rpm)[0].pos ** 2)

    inside = jax.jit(jd.over_worlds(jax.grad(sunk, 1)))(starts, commands)
    assert_close(inside, jax.jit(jax.vmap(jax.grad(sunk, 1)))(starts, commands), 1e-12)


def test_without_the_interfaces_that_it_needs_it_is_vmap_and_says_so_once(monkeypatch):
    monkeypatch.setattr(compiler, "AVAILABLE", False)
    worlds._warn_of_version.cache_clear()
    with pytest.warns(RuntimeWarning, match="over_worlds uses jax.vmap") as caught:
        for _ in range(2):
            doubled = jd.over_worlds(lambda x: 2 * x)(commands)
    assert len(caught) == 1
    np.testing.assert_array_equal(doubled, 2 * commands)


@pytest.mark.slow
def test_an_equation_that_is_not_as_expected_makes_it_vmap_too(monkeypatch):
    def strange(equation):
        raise compiler.UnknownError("scan has x")

    monkeypatch.setattr(compiler, "scan_counts", strange)
    worlds._warn_of_version.cache_clear()
    with pytest.warns(RuntimeWarning, match="scan has x"):
        flown = jd.over_worlds(fly)(starts, commands)
    assert_close(flown, jax.vmap(fly)(starts, commands), 1e-11)


def test_it_is_traced_once_for_arguments_of_some_shapes():
    traced = []

    def double(x):
        traced.append(x.shape)
        return jax.lax.fori_loop(0, 2, lambda _, x: 2 * x, x)

    many = jd.over_worlds(double)
    for worlds_of_a_call in (2, 2, 3, 2):
        x = jnp.ones((worlds_of_a_call, 3))
        np.testing.assert_array_equal(many(x), 4 * x)
    assert traced == [(3,)] * len(traced) and len(traced) < 4  # some passages, not calls
    calls = len(traced)
    many(jnp.ones((2, 4)))
    assert traced[calls:] and set(traced[calls:]) == {(4,)}


WITHIN = {
    "a jitted function, of constants": lambda f, x: jax.jit(lambda: f(lambda x: jnp.sin(x) * x)(x))(),
    "a gradient": lambda f, x: jax.grad(lambda x: jnp.sum(f(lambda x: jnp.sin(x) * x)(x)))(x),
    "a gradient, of what it closes over": lambda f, x: jax.grad(lambda a: jnp.sum(f(lambda x: jnp.sin(a * x))(x)))(2.0),
    "a map": lambda f, x: jax.vmap(f(jnp.sin))(jnp.stack([x, -x])),
    "a map, of what it closes over": lambda f, x: jax.vmap(lambda a: f(lambda x: a * x)(x))(jnp.arange(3.0)),
    "a loop": lambda f, x: jax.lax.scan(lambda y, _: (f(jnp.sin)(y), None), x, length=3)[0],
    "a tangent": lambda f, x: jax.jvp(f(jnp.tanh), (x,), (x,)),
}


@pytest.mark.parametrize("name", WITHIN)
@pytest.mark.parametrize("looped", mostly_slow([False, True], [False]), ids=["straight", "in a loop"])
def test_within_a_transformation_it_is_what_vmap_is(name, looped):
    def along(vmap):
        repeated = (lambda g: lambda x: jax.lax.fori_loop(0, 2, lambda _, x: g(x), x)) if looped else lambda g: g
        return WITHIN[name](lambda g: vmap(repeated(g)), jnp.linspace(-1, 1, 6).reshape(3, 2))

    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), along(jd.over_worlds), along(jax.vmap))


def test_it_knows_a_trace_without_the_interface_that_tells(monkeypatch):
    with monkeypatch.context() as patched:
        patched.delattr(jax.extend.core, "unsafe_am_i_under_a_jit_DO_NOT_USE")
        found = importlib.util.module_from_spec(compiler.__spec__)
        compiler.__spec__.loader.exec_module(found)
    assert not found.is_inside_jit() and not compiler.is_inside_jit()
    told = []
    jax.jit(lambda: told.append((found.is_inside_jit(), compiler.is_inside_jit())))()
    assert told == [(True, True)]


def test_the_same_function_may_be_called_with_arrays_and_within_a_transformation():
    many, x = jd.over_worlds(lambda x: jax.lax.fori_loop(0, 2, lambda _, x: jnp.sin(x), x)), jnp.ones((3, 2))
    expected = jnp.sin(jnp.sin(x))
    for found in (many(x), jax.jit(many)(x), many(x), jax.jit(lambda: many(x))()):
        np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.slow
def test_a_kernel_that_does_not_compile_is_several_after_one_warning(monkeypatch):
    monkeypatch.setattr(fitting, "_ALLOWED", fitting._ALLOWED | {"sort"})  # calls a library

    def sorting(x):
        return jax.lax.fori_loop(0, 2, lambda _, x: jnp.sort(jnp.sin(3 * x)), x)

    many, x = jd.over_worlds(sorting), jnp.linspace(0, 1, 10).reshape(2, 5)
    with pytest.warns(RuntimeWarning, match="kernel of sorting does not compile") as caught:
        for compiled in (many, many, jax.jit(many)):
            np.testing.assert_allclose(compiled(x), jax.vmap(sorting)(x), rtol=1e-12)
    assert len(caught) == 1


def test_what_fails_while_it_flies_is_not_taken_for_a_compiler_that_fails(monkeypatch):
    many, x = jd.over_worlds(lambda x: jax.lax.fori_loop(0, 2, lambda _, x: 2 * x, x)), jnp.ones((3, 2))
    kernel = many._single_kernel

    def out_of_memory(*arguments):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED")

    out_of_memory.lower = kernel.lower
    many._single_kernel = out_of_memory
    with pytest.raises(jax.errors.JaxRuntimeError, match="RESOURCE"):
        many(x)


def test_options_are_those_that_the_compiler_knows():
    known = compiler._known(xla_cpu_prefer_vector_width=512, xla_of_another_version=True)
    assert known == {"xla_cpu_prefer_vector_width": 512}
    jax.jit(lambda x: x, compiler_options=compiler.kernel_options())(1.0)


@pytest.mark.parametrize("chunk", [0, 1.5])
def test_a_chunk_is_a_whole_number(chunk):
    with pytest.raises(ValueError, match="chunk"):
        in_chunks(fly, chunk)(starts, commands)


@pytest.mark.slow
def test_two_devices_fly_what_one_flies():
    script = """
import jax
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_enable_x64", True)
from test_worlds import *
flown = in_chunks(fly, 2, devices=jax.devices())
args = [jax.tree.map(lambda x: x[:4], x) for x in (starts, commands)]
assert len(flown(*args).pos.sharding.device_set) == 2
second = in_chunks(fly, 2, devices=jax.devices()[1:])(*args)
assert second.pos.sharding.device_set == set(jax.devices()[1:])
assert_close(second, jax.jit(jax.vmap(fly))(*args), 1e-11)
assert_close(flown(*args), jax.jit(jax.vmap(fly))(*args), 1e-11)
by_step = in_chunks(fly, 2, (0, 1), jax.devices())(args[0], args[1].swapaxes(0, 1))
assert_close(by_step, jax.jit(jax.vmap(fly))(*args), 1e-11)
with pytest.raises(ValueError, match="5 worlds.*2 devices"):
    flown(starts, commands)
"""
    folders = [Path(__file__).parent, Path(__file__).parent.parent]
    path = os.pathsep.join(map(str, folders))
    subprocess.run([sys.executable, "-c", script], check=True, env=os.environ | {"PYTHONPATH": path})
