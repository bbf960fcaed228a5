"""Derivatives of whole flights against central differences, and finite ones where formulas tend to break."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import INTEGRATORS, assert_close, assert_finite, fly, mostly_slow, name_of, tape
from helpers import jit_unoptimized as jit

import jaxdrones
from jaxdrones import (
    State,
    downwash,
    downwash_2021,
    drag,
    drag_world_axes,
    ground_effect,
    ground_effect_2021,
    lagging_rotors,
    rk4,
)

LENGTH = 100
SMOOTH = (drag, ground_effect), (downwash,)
PAPER = (drag_world_axes, ground_effect_2021), (downwash_2021,)
FLIGHTS = {
    "default": jaxdrones.make_step((drag, ground_effect), (downwash, downwash_2021)),
    "lagging": jaxdrones.make_step((drag,), rotors=lagging_rotors, integrator=rk4),
}
BODY = {"mass", "inertia", "rotor_pos", "rotor_spin", "kf", "km", "gravity", "wind", "drag_coeff", "rotor_inertia"}
FELT = {  # what the flights must feel of `Params`; the rest of it describes limits and the collision shape
    "default": BODY | {"ground_effect_coeff", "downwash_coeff", "inflow_loss", "air_density", "prop_radius"},
    "lagging": BODY | {"rotor_rise_time", "rotor_fall_time"},
}


def flight():
    """Params, start and commands of a cf2p just above the ground with a cf2x half a metre above it, in wind."""
    team = jaxdrones.stack([jaxdrones.load_params("cf2p"), jaxdrones.load_params("cf2x")])
    team = team.replace(rotor_inertia=jnp.full(2, 5e-8), wind=jnp.array([[0.5, -0.3, 0.2], [-0.4, 0.6, 0.1]]))
    start = State.at_rest([[0, 0, 0.08], [0.06, 0.05, 0.5]], [0.4, -1.0]).replace(
        vel=jnp.array([[0.1, 0.2, 0.1], [-0.1, 0.1, 0.0]]),
        omega=jnp.array([[0.3, -0.2, 0.5], [-0.4, 0.1, 0.2]]),
        rpm=jnp.full((2, 4), 14e3),
    )
    return team, start, 1.05 * tape(team, LENGTH)


@lru_cache
def cost(step):
    """(params, start, commands) -> a number that feels every entry of the last state about equally."""
    rng = np.random.default_rng(5)
    sizes = {"pos": 1.0, "quat": 1.0, "vel": 1.0, "omega": 10.0, "rpm": 1e4}
    weights = {key: rng.normal(size=(2, {"quat": 4, "rpm": 4}.get(key, 3))) / size for key, size in sizes.items()}

    def cost(params, start, commands):
        trajectory = fly.__wrapped__(step, params, start, commands)
        return sum(jnp.sum(getattr(trajectory, key)[-1] * jnp.array(weight)) for key, weight in weights.items())

    return cost


def slope(step):
    """The gradient in all three arguments."""
    return jax.grad(cost(step), argnums=(0, 1, 2))


@lru_cache
def compiled_slope(step):
    return jit(slope(step))


def directions(arguments):
    """A random direction in each array of the arguments, every entry of its size: leaf name -> pytree."""
    rng = np.random.default_rng(6)
    leaves, structure = jax.tree_util.tree_flatten_with_path(arguments)
    zeros = [jnp.zeros_like(leaf) for _, leaf in leaves]
    for i, (path, leaf) in enumerate(leaves):
        size = np.where(leaf == 0, np.max(np.abs(leaf)) or 1.0, np.abs(leaf))
        chosen = list(zeros)
        chosen[i] = jnp.asarray(rng.uniform(-1, 1, leaf.shape) * size)
        yield jax.tree_util.keystr(path), jax.tree_util.tree_unflatten(structure, chosen)


def inner(gradient, direction):
    return sum(jnp.vdot(g, d) for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", FLIGHTS)
def test_gradients_of_a_hundred_steps_agree_with_central_differences(name):
    """In the commands, the start and every array of `Params`.

    With steps h = 1e-5 of the size of each entry the differences err by h^2 = 1e-10 of the third derivative and by
    1e-16 / h = 1e-11 of round-off; a hundred steps make 1.3e-7 of them.
    """
    h = 1e-5
    arguments = flight()
    gradient = compiled_slope(FLIGHTS[name])(*arguments)
    value = jit(cost(FLIGHTS[name]))
    felt = set()
    for path, direction in directions(arguments):
        ahead, behind = (jax.tree.map(lambda x, d, s=s: x + s * h * d, arguments, direction) for s in (1, -1))
        measured = (value(*ahead) - value(*behind)) / (2 * h)
        predicted = inner(gradient, direction)
        np.testing.assert_allclose(predicted, measured, rtol=1e-6, atol=1e-8, err_msg=path)
        felt |= {path} if abs(measured) > 1e-4 else set()
    assert felt >= {f"[0].{key}" for key in FELT[name]} | {"[1].pos", "[1].quat", "[1].vel", "[1].omega", "[2]"}


@pytest.mark.slow
def test_forward_and_reverse_mode_agree():
    """To round-off through a hundred steps."""
    arguments = flight()
    tangent = jax.tree.map(lambda *d: sum(d), *(direction for _, direction in directions(arguments)))
    _, forward = jit(lambda x, t: jax.jvp(cost(FLIGHTS["default"]), x, t))(arguments, tangent)
    np.testing.assert_allclose(inner(compiled_slope(FLIGHTS["default"])(*arguments), tangent), forward, rtol=1e-10)


@pytest.mark.slow
def test_gradients_of_many_worlds_are_those_of_each():
    step = jaxdrones.make_step()
    params, start, commands = flight()
    batch = jnp.stack([commands, 1.01 * commands, 0.98 * commands])
    together = jit(jax.vmap(slope(step), (None, None, 0)))(params, start, batch)
    for i, alone in enumerate(batch):
        one = jax.tree.map(lambda x, i=i: x[i], together)
        assert_close(one, compiled_slope(step)(params, start, alone), atol=1e-12, rtol=1e-8)


LEVEL, UPSIDE_DOWN = (0.0, 0, 0, 1), (1.0, 0, 0, 0)
PLACES = {
    "at rest": ((0, 0, 1), (1, 0, 1), LEVEL),
    "exactly above": ((0, 0, 1), (0, 0, 1.5), LEVEL),
    "exactly above where the paper's downwash has no width": ((0, 0, 1), (0, 0, 1.6875), LEVEL),
    "in the same place": ((0, 0, 1), (0, 0, 1), LEVEL),
    "on the ground": ((0, 0, 0), (1, 0, 0), LEVEL),
    "upside down on the ground": ((0, 0, 0), (0, 0, 0.5), UPSIDE_DOWN),
    "on the side": ((0, 0, 0.1), (0, 0, 0.5), (2**-0.5, 0, 0, 2**-0.5)),
    "nose up": ((0, 0, 0.1), (0, 0, 0.5), (0, -(2**-0.5), 0, 2**-0.5)),
}


def assert_finite_everywhere(step):
    """With standing and with turning rotors; and not because there is no gradient."""

    def total(params, start, command):
        return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(step(params, start, command)))

    gradient = jit(jax.grad(total, argnums=(0, 1, 2)))
    team = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 2)
    for name, (first, second, quat) in PLACES.items():
        start = State.at_rest([first, second]).replace(quat=jnp.array([quat, quat]))
        for rpm in 0.0, 14e3:
            gradients = gradient(team, start.replace(rpm=jnp.full((2, 4), rpm)), jnp.full((2, 4), rpm))
            assert_finite({f"{name}, {rpm} RPM": gradients})
            assert np.all(gradients[1].vel != 0)


@pytest.mark.slow
@pytest.mark.parametrize("effects", [SMOOTH, PAPER], ids=["smooth", "paper"])
def test_gradients_are_finite_where_formulas_tend_to_break(effects):
    assert_finite_everywhere(jaxdrones.make_step(*effects))


@pytest.mark.float32
@pytest.mark.slow
@pytest.mark.parametrize("effects", [SMOOTH, PAPER], ids=["smooth", "paper"])
def test_gradients_are_finite_in_float32_too(effects):
    assert_finite_everywhere(jaxdrones.make_step(*effects))


@pytest.mark.parametrize("integrator", mostly_slow(INTEGRATORS, [jaxdrones.semi_implicit_euler]), ids=name_of)
def test_integrators_and_lagging_rotors_have_finite_gradients(integrator):
    assert_finite_everywhere(jaxdrones.make_step(rotors=lagging_rotors, integrator=integrator))


def test_mass_has_the_gradient_of_free_fall_and_thrust():
    """One step from rest: dv/dm = -dt F/m^2."""
    team, start = jaxdrones.repeat(jaxdrones.load_params("hb"), 1), State.at_rest([[0.0, 0, 1]])
    command = jnp.full((1, 4), team.hover_rpm[0])
    step = jaxdrones.make_step(dt=0.01)
    slope = jax.jit(jax.grad(lambda p: step(p, start, command).vel[0, 2]))(team)
    np.testing.assert_allclose(slope.mass, [-0.01 * 9.8 / 0.5], rtol=1e-12)
    np.testing.assert_allclose(slope.gravity, [-0.01], rtol=1e-12)
