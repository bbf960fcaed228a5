"""A result that is needed in few worlds is that of `vmap` where it is needed, however many they are.

Elsewhere it is zero or a given value. Derivatives are those of a choice between the two.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import mostly_slow

from jaxdrones.accelerate.where_needed import where_needed

X = jnp.arange(1.0, 65.0)
each_derivative = pytest.mark.parametrize("derivative", mostly_slow([jax.grad, jax.jacfwd], [jax.grad]))


def double(x, shared):
    return {"double": 2 * x, "sum": x + shared}


def test_what_is_needed_equals_vmap_and_the_rest_is_zero():
    computed = jax.jit(jax.vmap(where_needed(double, one_in=8), (0, 0, None)))
    expected = jax.vmap(double, (0, None))(X, 3.0)
    for count in 0, 1, 8, 9, 16, 17, 64:
        needed = np.random.default_rng(count).permutation(64) < count
        found = computed(needed, X, 3.0)
        for name in expected:
            np.testing.assert_array_equal(found[name], jnp.where(needed, expected[name], 0))


@each_derivative
def test_derivatives_are_those_of_the_function_where_it_is_needed_and_zero_elsewhere(derivative):
    """Once and twice."""
    cube = where_needed(lambda x: x**3, one_in=8)
    slope = derivative(lambda x, needed: cube(needed, x))
    for f, expected in (slope, 3 * X**2), (derivative(slope), 6 * X):
        of_worlds = jax.jit(jax.vmap(f))
        for needed in (np.arange(64) < count for count in (0, 9, 64)):
            np.testing.assert_allclose(of_worlds(X, needed), np.where(needed, expected, 0), rtol=1e-12)


@each_derivative
def test_derivatives_elsewhere_are_those_of_the_given_value(derivative):
    """Of one world with a number of Python and of many, once and twice."""
    cube = where_needed(lambda x: x**3, one_in=8)

    def chosen(x, needed):
        return cube(needed, x, otherwise=5 * x**2)

    slope = derivative(chosen)
    assert (slope(2.0, True), slope(2.0, False)) == (12.0, 20.0)
    for f, here, elsewhere in (slope, 3 * X**2, 10 * X), (derivative(slope), 6 * X, np.full(64, 10.0)):
        found = jax.jit(jax.vmap(f))(X, X > 3)
        np.testing.assert_allclose(found, np.where(X > 3, here, elsewhere), rtol=1e-12)


def test_a_given_value_may_be_all_that_is_differentiated():
    slope = jax.grad(lambda before, needed: where_needed(jnp.sin)(needed, 2.0, otherwise=before**2))
    np.testing.assert_allclose(jax.vmap(slope)(X, X > 3), jnp.where(X > 3, 0, 2 * X), rtol=1e-12)


@pytest.mark.slow
def test_worlds_with_one_key_get_one_result():
    key = jax.random.key(0)
    found = jax.vmap(where_needed(jax.random.normal), (0, None))(X > 3, key)
    np.testing.assert_array_equal(found, jnp.where(X > 3, jax.random.normal(key), 0))


def test_closed_over_values_are_inputs_too():
    def loss(factors):
        scaled = where_needed(lambda x: jnp.sum(factors * x**2), one_in=8)
        return jnp.sum(jax.vmap(scaled)(X > 3, X))

    np.testing.assert_allclose(jax.grad(loss)(jnp.ones(2)), np.sum(np.asarray(X[3:]) ** 2), rtol=1e-12)


WORLDS, CHUNK, STEPS = 7, 3, 5
RNG = np.random.default_rng(0)
DUE = jnp.array([1, 0, 1, 1, 0, 1, 1], bool)
SIGNAL = jnp.array(RNG.normal(size=(WORLDS, 4)))
TAPE = jnp.array(RNG.integers(0, 2, (WORLDS, STEPS)), bool)
GAIN = jnp.array([1.0, 2.0, 0.5])
LABEL = jnp.array(1)
BEFORE = {"depth": jnp.array(RNG.normal(size=(WORLDS, 4, 3))), "label": jnp.ones((WORLDS, 4), jnp.int32)}


def draw(signal, gain, label):
    return {
        "depth": jnp.outer(jnp.sin(signal), gain),
        "label": (10 * signal).astype(jnp.int32) + label.astype(jnp.int32),
    }


def chosen(due, before, *args):
    return jax.tree.map(lambda new, old: jnp.where(due, new, old), draw(*args), before)


def due_only(due, before, *args):
    return where_needed(draw, chunk=CHUNK)(due, *args, otherwise=before)


@pytest.mark.parametrize(
    "axes",
    mostly_slow([(0, 0, 0, None, None), (None, 0, 0, None, None), (0, None, 0, None, None)], [(0, 0, 0, None, None)]),
)
def test_images_and_their_gradients_are_those_of_a_choice(axes):
    args = [DUE, BEFORE, SIGNAL, GAIN, LABEL]
    args[:3] = (x if axis == 0 else jax.tree.map(lambda y: y[0], x) for x, axis in zip(args[:3], axes[:3], strict=True))

    def loss(function, depth, signal, gain):
        before = {"depth": depth, "label": args[1]["label"]}
        images = jax.vmap(function, in_axes=axes)(args[0], before, signal, gain, LABEL)
        return jnp.sum(images["depth"] ** 3), images

    results = [
        jax.jit(jax.value_and_grad(functools.partial(loss, f), argnums=(0, 1, 2), has_aux=True))(
            args[1]["depth"], args[2], GAIN
        )
        for f in (due_only, chosen)
    ]
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-12, atol=1e-12), *results)


def held(function, signal, tape):
    """Sum over time of a function of images that change where the tape says so."""

    def control_step(carry, due):
        signal, images = carry
        signal = 1.1 * signal
        images = function(due, images, signal, GAIN, LABEL)
        return (signal, images), jnp.sum(images["depth"] ** 2)

    start = jax.tree.map(lambda x: jnp.zeros_like(x[0]), BEFORE)
    return jnp.sum(jax.lax.scan(control_step, (signal, start), tape)[1])


def held_of_many(function, signal, tape):
    """The same of many worlds, which are mapped within the loop over time."""

    def control_step(carry, due):
        signal, images = carry
        signal = 1.1 * signal
        images = jax.vmap(lambda *args: function(*args, GAIN, LABEL))(due, images, signal)
        return (signal, images), jnp.sum(images["depth"] ** 2)

    return jnp.sum(jax.lax.scan(control_step, (signal, jax.tree.map(jnp.zeros_like, BEFORE)), tape.T)[1])


@pytest.mark.slow
def test_the_order_of_gradient_map_and_loop_does_not_matter():
    many = jax.vmap(functools.partial(held, due_only))
    gradients = (
        lambda s: jax.vmap(jax.grad(functools.partial(held, chosen)))(s, TAPE),
        lambda s: jax.vmap(jax.grad(functools.partial(held, due_only)))(s, TAPE),
        lambda s: jax.grad(lambda s: jnp.sum(many(s, TAPE)))(s),
        lambda s: jax.grad(lambda s: jnp.sum(jax.checkpoint(many)(s, TAPE)))(s),
        lambda s: jax.grad(functools.partial(held_of_many, due_only))(s, TAPE),
    )
    expected, *results = jax.jit(lambda s: [gradient(s) for gradient in gradients])(SIGNAL)
    for result in results:
        np.testing.assert_allclose(result, expected, rtol=1e-12)


@pytest.mark.parametrize("due", [0, 1, 3, 4, 7])
@pytest.mark.slow
def test_no_more_is_drawn_than_the_chunks_that_are_due(due):
    drawn = []

    def counted(x):
        jax.debug.callback(lambda _: drawn.append(1), x)
        return x

    mask = jnp.arange(WORLDS) < due
    out = jax.vmap(where_needed(counted, chunk=CHUNK))(mask, jnp.arange(1.0, 1 + WORLDS))
    np.testing.assert_array_equal(out, jnp.where(mask, jnp.arange(1.0, 1 + WORLDS), 0))
    jax.effects_barrier()
    assert len(drawn) == CHUNK * -(-due // CHUNK)
