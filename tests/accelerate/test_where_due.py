"""What is drawn only where it is due is what a choice among drawings of all would be, however it is transformed."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones.accelerate.where_needed import where_due

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


due_only = where_due(draw, CHUNK)


@pytest.mark.parametrize("axes", [(0, 0, 0, None, None), (None, 0, 0, None, None), (0, None, 0, None, None)])
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
    out = jax.vmap(where_due(counted, CHUNK))(mask, jnp.zeros(WORLDS), jnp.arange(1.0, 1 + WORLDS))
    np.testing.assert_array_equal(out, jnp.where(mask, jnp.arange(1.0, 1 + WORLDS), 0))
    jax.effects_barrier()
    assert len(drawn) == CHUNK * -(-due // CHUNK)
