"""A function whose numbers are apart under `vmap` is what `vmap` computes, and so are all of its derivatives."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import flying, mostly_slow, mostly_slow_rows, tape

import jaxdrones as jd
from jaxdrones.accelerate.apart import apart_under_vmap

rng = np.random.default_rng(0)
X, PUSH = jnp.asarray(rng.normal(size=(5, 3))), jnp.asarray(rng.normal(size=(5, 3)))


@jax.custom_jvp
def softened(x):
    """Three times its slope is told to whoever differentiates it."""
    return jnp.tanh(x)


softened.defjvp(lambda x, change: (softened(*x), 3 * change[0] * (1 - jnp.tanh(x[0]) ** 2)))


def swung(x, push, soft=softened):
    """A loop with a carried array, a product, a rule of its own for derivatives, and a number of steps."""
    arm = jnp.array([[0.0, 1.0, 0.5], [-1.0, 0.0, 2.0], [0.3, 0.2, 1.0]])

    def advance(carry, k):
        x, count = carry
        return (x + 0.1 * soft(arm @ x + push) * jnp.cos(k), count + (x[0] > 0)), x[1]

    (x, count), seen = jax.lax.scan(advance, (x, 0), jnp.arange(4.0))
    return {"end": x, "seen": seen, "count": count}


smooth = functools.partial(swung, soft=jnp.tanh)


def total(function, x, push):
    out = function(x, push)
    return jnp.sum(out["end"] ** 2) + jnp.sum(jnp.sin(out["seen"]))


def same(found, expected):
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)


MANY = {
    "both vary": (lambda f: jax.vmap(f), (X, PUSH)),
    "one varies": (lambda f: jax.vmap(f, (0, None)), (X, PUSH[0])),
    "along the last axis": (lambda f: jax.vmap(f, (-1, 0)), (X.T, PUSH)),
    "worlds of worlds": (lambda f: jax.vmap(jax.vmap(f, (None, 0)), (0, None)), (X, PUSH)),
    "worlds of worlds, both": (lambda f: jax.vmap(jax.vmap(f, (0, None)), (0, 0)), (jnp.stack([X, 2 * X]), PUSH[:2])),
    "one world": (lambda f: f, (X[0], PUSH[0])),
}


@pytest.mark.parametrize("name", mostly_slow(MANY, ["one varies", "worlds of worlds, both", "one world"]))
def test_results_are_those_of_vmap(name):
    many, arguments = MANY[name]
    same(jax.jit(many(apart_under_vmap(swung)))(*arguments), many(swung)(*arguments))


DERIVATIVES = {
    "grad": (swung, lambda f: jax.grad(f, (0, 1))),
    "of one argument": (swung, lambda f: jax.grad(f, 1)),
    "jacfwd": (swung, jax.jacfwd),
    "recomputed": (swung, lambda f: jax.grad(jax.checkpoint(f))),
    "hessian": (smooth, jax.hessian),
    "grad of grad": (smooth, lambda f: jax.grad(lambda x, push: jnp.sum(jax.grad(f)(x, push) * push))),
}


QUICK = [("grad", "both vary"), ("jacfwd", "one varies"), ("grad of grad", "one world")]
EVERY = itertools.product(DERIVATIVES, ("both vary", "one varies", "one world"))


@pytest.mark.parametrize(("name", "of"), mostly_slow_rows(EVERY, QUICK))
def test_derivatives_are_those_of_vmap(name, of):
    """Also where a function has a rule of its own, which second derivatives follow in two ways."""
    many, arguments = MANY[of]
    function, derivative = DERIVATIVES[name]
    ours, theirs = (many(derivative(functools.partial(total, f))) for f in (apart_under_vmap(function), function))
    same(jax.jit(ours)(*arguments), jax.jit(theirs)(*arguments))


def test_a_derivative_around_all_worlds_sums_over_those_that_share_an_argument():
    def of_all(function, x, push):
        return jnp.sum(jax.vmap(functools.partial(total, function), (0, None))(x, push))

    ours, theirs = (jax.jit(jax.grad(functools.partial(of_all, f), (0, 1))) for f in (apart_under_vmap(swung), swung))
    same(ours(X, PUSH[0]), theirs(X, PUSH[0]))


def test_what_it_closes_over_may_be_traced():
    def scaled(function, scale):
        inner = apart_under_vmap(lambda x: {"end": scale * x**3, "seen": x}) if function else None
        return jnp.sum(jax.vmap(inner or (lambda x: {"end": scale * x**3, "seen": x}))(X)["end"])

    slope = jax.jit(jax.grad(functools.partial(scaled, True)))(2.0)
    np.testing.assert_allclose(slope, jnp.sum(X**3), rtol=1e-12)


@pytest.mark.parametrize(
    ("size", "length", "each", "kernel"),
    [(3, 3, jnp.sort, False), (50, 3, jnp.negative, True), (36, 400, jnp.negative, True)],
    ids=["sorting", "large arrays", "many arrays, which would compile for long number by number"],
)
def test_what_is_not_computed_number_by_number_is_as_vmap_computes_it(size, length, each, kernel):
    """Sorting by several kernels; large and many arrays in one kernel, array by array."""
    x = jnp.asarray(rng.normal(size=(4, size)))

    def function(x):
        if length > 3:
            return functools.reduce(lambda x, _: each(x), range(length), x)
        return jax.lax.scan(lambda x, _: (each(x), None), x, length=length)[0]

    ours = jax.jit(jax.vmap(apart_under_vmap(function)))
    assert ("small_call" in ours.lower(x).as_text()) == kernel
    np.testing.assert_array_equal(ours(x), jax.vmap(function)(x))


@jax.custom_vjp
def slowed(x):
    """Its gradient is three times its slope."""
    return jnp.tanh(x)


slowed.defvjp(lambda x: (jnp.tanh(x), x), lambda x, back: (3 * back * (1 - jnp.tanh(x) ** 2),))

OF_EACH = {
    "sort": lambda x: jnp.sort(jnp.sin(3 * x)) * 0.9,
    "order": lambda x: 1.1 * x + 0.2 * x[jnp.argsort(jnp.cos(x))],
    "top_k": lambda x: 1.1 * x + jnp.sum(jax.lax.top_k(jnp.cos(x), 2)[0]),
    "custom_vjp": lambda x: slowed(1.2 * x) + 0.1 * x,
}
TAKEN = {
    "jvp": lambda f: lambda x, along: jax.jvp(f, (x,), (along,)),
    "grad": lambda f: lambda x, along: jax.grad(lambda x: jnp.sum(f(x) * along))(x),
    "jvp of grad": lambda f: lambda x, along: jax.jvp(jax.grad(lambda x: jnp.sum(f(x) ** 3)), (x,), (along,)),
}
HOW = {
    "apart": lambda derivative, f: jax.jit(jax.vmap(derivative(apart_under_vmap(f)))),
    "over_worlds": lambda derivative, f: jd.over_worlds(derivative(f)),
}
QUICK_WAYS = [("custom_vjp", "jvp of grad", "apart"), ("top_k", "jvp", "over_worlds"), ("sort", "grad", "apart")]


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize(("name", "taken", "how"), mostly_slow_rows(itertools.product(OF_EACH, TAKEN, HOW), QUICK_WAYS))
def test_derivatives_of_sorting_and_of_rules_for_the_reverse_mode_are_those_of_vmap(name, taken, how, dtype):
    """In one, 131 and 1,024 worlds; the reverse-mode rule has no forward mode, neither here nor there."""
    function, derivative = OF_EACH[name], TAKEN[taken]

    def flown(x):
        return jax.lax.scan(lambda x, _: (function(x), None), x, length=3)[0]

    for worlds in (1, 131, 1024):
        x, along = (jnp.asarray(rng.normal(size=(worlds, 4)), dtype) for _ in range(2))
        ours, theirs = HOW[how](derivative, flown), jax.jit(jax.vmap(derivative(flown)))
        if (name, taken) == ("custom_vjp", "jvp"):
            for each in ours, theirs:
                with pytest.raises(TypeError, match="forward-mode autodiff"):
                    each(x, along)
            continue
        for found, expected in zip(*map(jax.tree.leaves, (ours(x, along), theirs(x, along))), strict=True):
            assert found.dtype == expected.dtype == dtype
            rounding = 20 * jnp.finfo(dtype).eps * max(1.0, float(np.max(np.abs(expected))))
            np.testing.assert_allclose(found, expected, rtol=0, atol=rounding)


def test_a_place_that_differs_between_worlds_is_as_vmap_computes_it():
    def written(x, i):
        return jax.lax.dynamic_update_slice(x, 2 * x[:1], (i,))

    places = jnp.arange(5) % 3
    found = jax.jit(jax.vmap(apart_under_vmap(written)))(X, places)
    np.testing.assert_array_equal(found, jax.vmap(written)(X, places))


def test_no_worlds_are_none():
    assert jax.vmap(apart_under_vmap(lambda x: 2 * x))(X[:0]).shape == (0, 3)


def test_many_worlds_are_one_kernel_and_one_world_is_none():
    function = apart_under_vmap(swung)
    assert jax.jit(jax.vmap(function)).lower(X, PUSH).as_text().count("small_call") == 1
    assert "small_call" not in jax.jit(function).lower(X[0], PUSH[0]).as_text()


def test_a_mesh_of_devices_leaves_the_kernel():
    """Where a mesh is set, as in trainings, JAX notes at a choice how its result is shared by devices."""
    chosen = apart_under_vmap(lambda x, push: {"end": jnp.where(x > 0, x, 0) + push, "seen": x})
    with jax.set_mesh(jax.make_mesh((1,), ("worlds",), axis_types=(jax.sharding.AxisType.Auto,))):
        program = jax.jit(jax.vmap(chosen)).lower(X, PUSH).as_text()
    assert program.count("small_call") == 1


@pytest.mark.parametrize("across", [None, pytest.param(0, marks=pytest.mark.slow)])
def test_derivatives_of_large_arrays_are_those_of_vmap(across):
    """Array by array, with a product, a sum over an axis and an argument that all worlds may share."""
    arm = jnp.array([[0.0, 1.0, 0.5], [-1.0, 0.0, 2.0], [0.3, 0.2, 1.0]])

    def function(x, push):
        def advance(x, _):
            return jnp.tanh(x * (push @ arm) + jnp.sum(x, axis=0, keepdims=True)), x[1]

        end, seen = jax.lax.scan(advance, x, length=3)
        return {"end": end, "seen": seen}

    x, push = jnp.asarray(rng.normal(size=(4, 20, 3))), jnp.asarray(rng.normal(size=(4, 1, 3)))
    push = push[0] if across is None else push
    ours, theirs = (
        jax.jit(jax.vmap(jax.grad(functools.partial(total, f), (0, 1)), (0, across)))
        for f in (apart_under_vmap(function), function)
    )
    assert "small_call" in ours.lower(x, push).as_text()
    same(ours(x, push), theirs(x, push))


@pytest.mark.slow
def test_the_gradient_of_a_flight_in_vmap_is_that_of_one_world_at_a_time():
    """With parameters of its own in every world, and a command between that depends on the state."""
    params = jd.repeat(jd.load_params("cf2x"), 2)
    step = jd.make_step((jd.drag, jd.ground_effect), pairs=(jd.downwash,), rotors=jd.lagging_rotors, substeps=3)

    def miss(mass, start, commands):
        own = params.replace(mass=mass)

        def advance(state, command):
            return step(own, state, command - 100 * state.vel[:, 2:]), None

        return jnp.sum(jax.lax.scan(advance, start, commands)[0].pos ** 2)

    starts = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(flying(params, seed) for seed in range(3)))
    masses = params.mass[None] * jnp.array([[1.0], [1.1], [0.9]])
    commands = jnp.stack([tape(params, 4, seed) for seed in range(3)])
    gradient = jax.value_and_grad(miss, (0, 1, 2))
    at_once = jax.jit(jax.vmap(gradient))(masses, starts, commands)
    one = jax.jit(gradient)
    for i in range(3):
        alone = one(*jax.tree.map(lambda x, i=i: x[i], (masses, starts, commands)))
        for ours, theirs in zip(jax.tree.leaves(at_once), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(ours[i], theirs, rtol=0, atol=1e-12 * max(1, np.abs(theirs).max()))
