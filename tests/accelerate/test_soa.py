"""Loops over many worlds, each number an array of its own: what `jax.vmap` computes, and how it is laid out."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import flying, tape

import jaxdrones as jd
from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.fitting import can_be_a_kernel, fits_number_by_number
from jaxdrones.accelerate.soa import over_last_axis

rng = np.random.default_rng(0)
start, pushes = rng.normal(size=(3, 5)), rng.normal(size=(4, 3, 5))  # worlds last
keys = jnp.moveaxis(jax.random.split(jax.random.key(1), 5), 0, -1)


def vmap_apart(function):
    """`jax.vmap(function, -1, -1)` in the form for kernels."""

    def many(*arguments):
        leaves, tree = jax.tree.flatten(arguments)
        of_one = [jax.ShapeDtypeStruct(x.shape[:-1], x.dtype) for x in leaves]
        program, consts, shape = compiler.trace(lambda *leaves: function(*tree.unflatten(leaves)), *of_one)
        varies, by_numbers = [True] * len(leaves), fits_number_by_number(program)
        results = over_last_axis(program, leaves, varies, by_numbers, consts)
        return jax.tree.structure(shape).unflatten(results)

    return many


def looped(advance):
    """Four passages of a loop that also gives what it had."""
    return lambda x, pushes: jax.lax.scan(lambda x, push: (advance(x) + push, x), x, pushes)


def counted(x):
    return jax.lax.fori_loop(0, 3, lambda i, x: x + jnp.arange(3.0)[i], x)


BODIES = {
    "elementwise": lambda x: jnp.where(x > 0, jnp.sin(x), x**2 / (1 + jnp.abs(x))),
    "sums and extremes": lambda x: jnp.stack([x.sum(), x.prod(), x.max() - x.min()]),
    "logic": lambda x: x * jnp.any(x > 1) + jnp.all(x > -1),
    "shapes": lambda x: jnp.flip(jnp.concatenate([x, 2 * x]).reshape(2, 3).T, 0)[:, 1] + jnp.pad(x[1:], (1, 0)),
    "parts": lambda x: jnp.stack([part[0] for part in jnp.split(x, 3)]) + sum(jnp.unstack(x)),
    "tiles and places": lambda x: jnp.tile(x, 2).at[1:3].get() @ jnp.ones(2) * x,
    "steps backwards": lambda x: x[::-2].sum() * x,
    "padding": lambda x: jax.lax.pad(x, 2.0, [(1, -3, 1)])[:3] * x,
    "matrix products": lambda x: jnp.outer(x, x) @ x / (1 + x @ x),
    "sorting, which has no rule": lambda x: jnp.sort(x)[::-1],
    "a choice of functions": lambda x: jax.lax.cond(x[0] > 0, jnp.sin, jnp.cos, x),
    "while": lambda x: jax.lax.while_loop(lambda x: jnp.any(jnp.abs(x) > 1), lambda x: x / 2, x),
    "a loop that counts": counted,
    "a gradient": jax.grad(lambda x: jnp.sum(jnp.tanh(x) ** 3)),
    "a jitted function": jax.jit(jnp.cumsum),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BODIES)
def test_a_loop_gives_what_vmap_gives(name):
    fly = looped(BODIES[name])
    assert_same(vmap_apart(fly)(start, pushes), jax.vmap(fly, -1, -1)(start, pushes))


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in BODIES if name != "while"])
def test_a_gradient_through_a_loop_gives_what_vmap_gives(name):
    gradient = jax.grad(lambda x, pushes: jnp.sum(looped(BODIES[name])(x, pushes)[0] ** 2), (0, 1))
    assert_same(vmap_apart(gradient)(start, pushes), jax.vmap(gradient, -1, -1)(start, pushes))


@pytest.mark.parametrize(
    "axes", ["ij,jk->ik", "ij,i->j", "i,i->", "i,j->ij", "bij,bj->bi", "bij,bkj->bki", "ijk,kjl->il"]
)
def test_products_of_small_arrays_give_what_vmap_gives(axes):
    sizes, (*inputs, _) = dict(zip("bijkl", (2, 3, 4, 2, 3), strict=True)), axes.replace("->", ",").split(",")
    arrays = [rng.normal(size=(*map(sizes.get, names), 5)) for names in inputs]
    product = functools.partial(jnp.einsum, axes)
    assert can_be_a_kernel(jax.make_jaxpr(product)(*(x[..., 0] for x in arrays)).jaxpr)
    assert_same(vmap_apart(product)(*arrays), jax.vmap(product, -1, -1)(*arrays))


def test_products_of_large_matrices_are_left_to_a_library():
    assert not can_be_a_kernel(jax.make_jaxpr(jnp.dot)(jnp.zeros((7, 7)), jnp.zeros(7)).jaxpr)


def test_random_numbers_are_those_of_vmap():
    def noisy(key, x):
        def advance(carry, _):
            key, x = carry
            key, draw = jax.random.split(key)
            return (key, x + jax.random.normal(draw, (3,))), None

        return jax.lax.scan(advance, (key, x), length=3)[0][1]

    assert_same(vmap_apart(noisy)(keys, start), jax.vmap(noisy, -1, -1)(keys, start))


def test_what_is_the_same_in_all_worlds_is_given_to_each():
    def told(x):
        return jax.lax.scan(lambda i, x: (i + 1, i), 0, x), jnp.ones(2)

    assert_same(vmap_apart(told)(start), jax.vmap(told, -1, -1)(start))


@pytest.mark.slow
def test_in_loops_of_a_flight_every_array_is_a_number_of_each_world():
    team = jd.repeat(jd.load_params("cf2x"), 1)
    step = jd.make_step((jd.drag, jd.ground_contact), rotors=jd.lagging_rotors)

    def miss(start, commands):
        return jnp.sum(jax.lax.scan(lambda s, rpm: (step(team, s, rpm), None), start, commands)[0].pos ** 2)

    worlds = jax.tree.map(lambda x: jnp.stack([x] * 5, -1), (flying(team), tape(team, 10)))
    loops = list(bodies(jax.make_jaxpr(vmap_apart(jax.grad(miss, 1)))(*worlds).jaxpr))
    assert len(loops) == 2
    for loop in loops:
        computed = [eqn for eqn in loop.eqns if eqn.primitive.name in ("add", "mul", "div", "sqrt", "select_n")]
        assert len(computed) > 100
        assert {v.aval.shape for eqn in computed for v in eqn.outvars} <= {(5,), ()}


def test_a_table_that_a_loop_looks_up_stays_whole():
    table = jnp.arange(300.0).reshape(100, 3)

    def looked_up(x):
        return jax.lax.fori_loop(0, 10, lambda i, x: x + jnp.sin(table[7 * i]) * table[i + 1, 0], x)

    assert_same(vmap_apart(looked_up)(start), jax.vmap(looked_up, -1, -1)(start))
    (loop,) = bodies(jax.make_jaxpr(vmap_apart(looked_up))(start).jaxpr)
    assert len(loop.eqns) < 100


def test_large_teams_stay_whole():
    (loop,) = repeated(lambda x: jnp.outer(x, x).sum(0), jnp.ones((7, 5)))
    assert any(v.aval.size == 7 * 7 * 5 for eqn in loop.eqns for v in eqn.outvars)


@pytest.mark.slow
@pytest.mark.parametrize(("operations", "axes"), [(100, {1}), (3_000, {2})], ids=["short", "long"])
def test_programs_too_long_to_compile_number_by_number_stay_whole(operations, axes):
    (loop,) = repeated(lambda x: functools.reduce(lambda y, _: y * x, range(operations), x), start)
    assert {v.aval.ndim for eqn in loop.eqns if eqn.primitive.name == "mul" for v in eqn.outvars} == axes


def repeated(advance, x):
    """The bodies of the loop that repeats it in all worlds."""
    return bodies(
        jax.make_jaxpr(vmap_apart(lambda x: jax.lax.scan(lambda x, _: (advance(x), None), x, length=2)))(x).jaxpr
    )


def bodies(jaxpr):
    """The bodies of its scans."""
    for eqn in jaxpr.eqns:
        for inner in compiler.held(eqn):
            if eqn.primitive.name == "scan":
                yield inner
            yield from bodies(inner)


def assert_same(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype)
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-13)
