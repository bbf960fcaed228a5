"""Numbers that several expressions share are stored once, and remain what they are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import flying, mostly_slow

import jaxdrones as jd
from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.shared import materialize_shared, store_shared

x = np.linspace(-1, 1, 5)
team = jd.repeat(jd.load_params("cf2x"), 2)
state = flying(team)
meeting = jd.make_step((jd.drag, jd.ground_contact), (jd.downwash,), rotors=jd.lagging_rotors)


def costly(x):
    return x / (1 + x * x) / (2 + x) - x * x


CASES = {
    "used twice": (lambda x: (jnp.sin(costly(x)), jnp.cos(costly(x))), 1),  # also: computed twice, found to be the same
    "used once": (lambda x: jnp.sin(costly(x)), 0),
    "cheap": (lambda x: (jnp.sin(x + 1), jnp.cos(x + 1)), 0),
    "not needed": (lambda x: (costly(x), [jnp.sin(costly(x)), 0][1]), 0),
    "a number": (lambda x: (jnp.sin(costly(x[0])), jnp.cos(costly(x[0]))), 0),
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_shared_and_worth_it_is_stored(name):
    function, stores = CASES[name]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-15), store_shared(function)(x), function(x))
    assert str(jax.make_jaxpr(store_shared(function))(x)).count("custom_jvp_call") == stores


def looping(x):
    return jax.lax.fori_loop(0, 3, lambda _, x: jnp.stack([x @ x, x[0] / x[1], jnp.sin(x[2])]), x)


MATERIALIZED = {name: (function, x) for name, (function, _) in CASES.items() if name != "not needed"} | {
    "a step of a team": (lambda pos: meeting(team, state.replace(pos=pos), state.rpm).pos, state.pos),
    "a loop": (looping, x[:3] + 2),
    "whole numbers and a key": (
        lambda x: x * (jnp.arange(5) // 2) + jax.random.normal(jax.random.key(0), (5,)) * costly(x),
        x,
    ),
    "its own derivative": (jax.grad(lambda x: jnp.sum(jnp.sin(costly(x)) * costly(x))), x),
}


@pytest.mark.parametrize("name", mostly_slow(MATERIALIZED, ["used twice"]))
def test_materializing_changes_neither_values_nor_derivatives(name):
    function, x = MATERIALIZED[name]
    xs = jnp.stack([jnp.asarray(x), 1.01 * x])
    for derived in (lambda f: f, jax.jacrev, jax.jacfwd):
        mine, plain = (jax.jit(jax.vmap(derived(f)))(xs) for f in (materialize_shared(function), function))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11), mine, plain)


def test_without_the_interfaces_that_it_needs_nothing_is_stored(monkeypatch):
    monkeypatch.setattr(compiler, "AVAILABLE", False)
    assert "custom_jvp_call" not in str(jax.make_jaxpr(materialize_shared(CASES["used twice"][0]))(x))


def test_what_acts_is_kept_though_nothing_uses_it(capfd):
    def told(x):
        jax.debug.print("told {}", x[0])
        return 2 * x

    jax.block_until_ready(jax.jit(materialize_shared(told))(jnp.arange(3.0)))
    jax.effects_barrier()
    assert "told 0.0" in capfd.readouterr().out


def test_numbers_that_differ_in_the_twelfth_digit_are_two():
    def both(x):
        return x * 1.000000000001, x * 1.000000000002

    a, b = store_shared(both)(x)
    assert np.all(a[x != 0] != b[x != 0])
