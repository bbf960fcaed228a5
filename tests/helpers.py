"""Teams in flight, and comparisons that say which array differs."""

import dataclasses
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones
from jaxdrones import Params, State
from jaxdrones.accelerate import compiler

VEHICLES = ("cf2x", "cf2p", "hb", "racer")
"""The vehicles of gym-pybullet-drones; tests/test_vehicles.py flies all bundled ones."""
INTEGRATORS = (jaxdrones.euler, jaxdrones.semi_implicit_euler, jaxdrones.implicit_midpoint, jaxdrones.rk4)


STATE = [field.name for field in dataclasses.fields(State) if field.name != "aux"]
"""Names of the arrays of a state."""
CONSTANTS = [field.name for field in dataclasses.fields(Params) if field.name != "aux"]
"""Names of the arrays of parameters."""


SMALL_TRAINING = {"worlds": 4, "horizon": 4, "hidden_sizes": (8,), "duration": 0.2}
"""Settings of trainings to run quickly; where they are the same, another test finds the programs in the cache."""
SMALL_OPTIONS = [word for name, value in SMALL_TRAINING.items() for word in ("--set", f"{name}={value}")]
"""The same at the command line."""


def jit_unoptimized(function, **arguments):
    """`jax.jit` in a third of the time for large programs that run a few times and whose law is not about compiling."""
    options = compiler.training_options(large_arrays=False) | {"xla_backend_optimization_level": 0}
    return jax.jit(function, compiler_options=options, **arguments)


def jit_optimized(function, **arguments):
    """`jax.jit` with the options that users have, whatever XLA_FLAGS says; for laws about compiled programs."""
    options = compiler._known(xla_cpu_use_fusion_emitters=True, xla_backend_optimization_level=3)
    return jax.jit(function, compiler_options=options, **arguments)


make_step = lru_cache(jaxdrones.make_step)  # one compilation for all tests of a module that ask for the same step


def name_of(function) -> str:
    return function.__name__


def hover_rpm(params: Params) -> np.ndarray:
    """(n, 1), rotor speeds of a team in hover, RPM; by NumPy, as JAX compiles every operation for every size."""
    mass, gravity, kf = map(np.asarray, (params.mass, params.gravity, params.kf))
    return np.sqrt(mass * gravity / (4 * kf))[:, None]


def flying(params: Params, seed: int = 0, tilt: float = 1.0) -> State:
    """A team in full flight near (0, 0, 1) m; `tilt` 1 is any attitude, 0 is level."""
    rng = np.random.default_rng(seed)
    n = len(params.mass)
    quat = tilt * rng.normal(size=(n, 4)) + [0, 0, 0, 1 - tilt]
    return State(
        pos=jnp.asarray(rng.uniform([-0.4, -0.4, 0.6], [0.4, 0.4, 1.4], (n, 3))),
        quat=jnp.asarray(quat / np.linalg.norm(quat, axis=-1, keepdims=True)),
        vel=jnp.asarray(rng.uniform(-3, 3, (n, 3))),
        omega=jnp.asarray(rng.uniform(-5, 5, (n, 3))),
        rpm=jnp.asarray(rng.uniform(0.7, 1.1, (n, 4)) * hover_rpm(params)),
    )


def tape(params: Params, length: int, seed: int = 1) -> jax.Array:
    """Rotor speeds (length, n, 4) within a tenth of the hover speed."""
    shape = (length, len(params.mass), 4)
    return jnp.asarray(np.random.default_rng(seed).uniform(0.9, 1.1, shape) * hover_rpm(params))


@partial(jit_unoptimized, static_argnums=0)
def fly(step, params: Params, state: State, rpm: jax.Array) -> State:
    """The states after each row of a tape of rotor speeds."""
    return jaxdrones.rollout(step, lambda params, rpm, state, k: (rpm, rpm[k]), params, state, rpm, len(rpm))[1]


def to_world(function, q, x):
    """Apply a rotation function to arrays with any leading axes."""
    x = jnp.asarray(x)
    rows = x.reshape(-1, x.shape[-1])
    return jax.vmap(function, (None, 0))(q, rows).reshape(x.shape)


def assert_close(actual, expected, atol: float, rtol: float = 0.0) -> None:
    """Every array of two equal pytrees agrees."""
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=atol, err_msg=jax.tree_util.keystr(path))


def assert_same_motion(actual: State, expected: State, atol: float) -> None:
    """Two motions agree, quaternions up to sign."""
    sign = jnp.sign(jnp.sum(actual.quat * expected.quat, axis=-1, keepdims=True))
    assert_close(actual.replace(quat=sign * actual.quat), expected, atol)


def assert_same_kind(actual, expected) -> None:
    """Two pytrees have the same structure, shapes and dtypes, as a scan asks of what it carries."""
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(actual), jax.tree.leaves(expected), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype), jax.tree_util.keystr(path)


def assert_finite(tree) -> None:
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        assert np.all(np.isfinite(leaf)), f"{jax.tree_util.keystr(path)} is not finite: {leaf}"


def mostly_slow(names: Iterable[str], quick: Sequence[str]) -> list:
    """Parameters of a test: the `quick` ones run every time, the others only with the slow tests."""
    return [name if name in quick else pytest.param(name, marks=pytest.mark.slow) for name in names]


def mostly_slow_rows(rows: Iterable[tuple], quick: Sequence[tuple]) -> list:
    """The same for rows of several parameters."""
    return [row if row in quick else pytest.param(*row, marks=pytest.mark.slow) for row in rows]


class Keys:
    """The random keys, as bytes, that were drawn from, of which others were made, and that were made."""

    draws = ("uniform", "normal", "bernoulli", "randint")

    def __init__(self):
        self.drawn, self.parents, self.derived = Counter(), set(), Counter()

    def check(self, least):
        jax.effects_barrier()
        assert sum(self.drawn.values()) >= least
        assert max(self.drawn.values()) == 1, "a key is drawn from twice"
        assert max(self.derived.values()) == 1, "two keys that were made of others are the same"
        both = self.drawn.keys() & self.parents
        assert not both, "a key is drawn from, and others are made of it"
