"""The symbolic twin is the law of motion that JAX simulates."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop import one, team_of
from jax.flatten_util import ravel_pytree

import jaxdrones as jd
from jaxdrones.dynamics import EFFECTS, PAIRS

pytestmark = pytest.mark.needs("casadi")

VEHICLES = ("cf2x", "cf2p", "hb", "racer")
STATES = 1000
BARE = jd.Scene()
FIELDS = {"pos": 3, "quat": 4, "vel": 3, "omega": 3, "rpm": 4}


def twin(*args, **options):
    from jaxdrones.optimal.twin import casadi_model

    return casadi_model(*args, **options)


def drawn(params, n=1):
    """States and commands in the air, near the ground and on it, in every attitude."""
    rng = np.random.default_rng(0)
    quat = rng.normal(size=(STATES, n, 4))
    pos = rng.uniform([-1, -1, -0.02], [1, 1, 0.5], (STATES, n, 3))
    vel, omega = 3 * rng.normal(size=(STATES, n, 3)), 5 * rng.normal(size=(STATES, n, 3))
    hover = np.reshape(params.hover_rpm, -1)[0]
    rpm, command = hover * rng.uniform(0.3, 1.4, (2, STATES, n, 4))
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    return jd.State(*map(jnp.asarray, (pos, quat, vel, omega, rpm))), jnp.asarray(command)


def check(params, n=1, scene=BARE, **physics):
    """The rate and its Jacobian agree to 1e-12 of the largest contribution to each of their vectors."""
    import casadi

    model = twin(params, scene=scene, **physics)
    team = jax.tree.map(lambda x: x[None], params) if n == 1 else params
    derivative = jd.make_derivative(**physics)
    unravel = ravel_pytree(jd.State.at_rest(jnp.zeros((n, 3))))[1]

    def rate(x, u):
        return ravel_pytree(derivative(team, unravel(x), u.reshape(n, 4), scene))[0]

    states, commands = drawn(params, n)
    x = np.asarray(jax.vmap(lambda s: ravel_pytree(s)[0])(states))
    u = np.asarray(commands.reshape(STATES, -1))
    expected, jacobians = jax.jit(lambda x, u: (jax.vmap(rate)(x, u), jax.vmap(jax.jacfwd(rate, (0, 1)))(x, u)))(x, u)
    found = np.asarray(model.function.map(STATES)(x.T, u.T)).T
    _agree(found[:, :, None], np.asarray(expected)[:, :, None], n)
    both = [casadi.densify(casadi.jacobian(model.xdot, symbol)) for symbol in (model.x, model.u)]
    function = casadi.Function("jacobians", [model.x, model.u], both).map(STATES)
    for scale, found, expected in zip((x, u), function(x.T, u.T), jacobians, strict=True):
        found = np.asarray(found).reshape(x.shape[1], STATES, -1).swapaxes(0, 1)
        # A column is per unit of its variable: of the size that the variable has.
        size = np.std(scale, axis=0)[None, None]
        _agree(found * size, np.asarray(expected) * size, n)


def _agree(found, expected, n):
    ends = np.cumsum([n * size for size in FIELDS.values()])[:-1]
    for name, a, b in zip(FIELDS, np.split(found, ends, 1), np.split(expected, ends, 1), strict=True):
        largest = np.max(np.abs(b), axis=(1, 2), keepdims=True)
        assert np.all(np.abs(a - b) <= 1e-12 * largest), (name, np.max(np.abs(a - b) / (largest + 1e-300)))


def windy(vehicle):
    params = jd.load_params(vehicle)
    return params.replace(
        wind=jnp.array([0.5, -1.0, 0.2]),
        external_force=0.1 * params.weight * jnp.array([1.0, -2, 1]),
        rotor_inertia=params.rotor_inertia + 1e-3 * params.inertia[2],
    )


@pytest.mark.slow
def test_the_twin_of_a_crazyflie_has_the_rates_and_jacobians_of_jax():
    check(windy("cf2x"), effects=[jd.drag], rotors=jd.lagging_rotors)


@pytest.mark.slow
@pytest.mark.parametrize("rotors", [jd.instant_rotors, jd.lagging_rotors])
@pytest.mark.parametrize("effect", [*EFFECTS.values()], ids=lambda effect: effect.__name__)
@pytest.mark.parametrize("vehicle", VEHICLES)
def test_every_vehicle_effect_and_rotor_model_has_a_twin(vehicle, effect, rotors):
    check(windy(vehicle), effects=[effect], rotors=rotors)


@pytest.mark.slow
@pytest.mark.parametrize("pair", [*PAIRS.values()], ids=lambda pair: pair.__name__)
def test_a_team_has_a_twin_with_the_effects_between_its_drones(pair):
    check(team_of("cf2x", "cf2x"), n=2, effects=[jd.drag], pairs=[pair])


@pytest.mark.slow
def test_a_state_is_a_vector_with_names_and_back():
    model = twin("cf2x")
    assert model.names[:5] == ("pos[0]", "pos[1]", "pos[2]", "quat[0]", "quat[1]") and len(model.names) == 17
    state = one(drawn(jd.load_params("cf2x"))[0])
    state = jax.tree.map(lambda x: x[0], state)
    again = model.state(model.vector(state))
    assert jax.tree.all(jax.tree.map(np.array_equal, again, state))
    with pytest.raises(ValueError, match="the state has shapes"):
        model.vector(jd.State.at_rest(jnp.zeros((2, 3))))
    assert model.function.name_in() == ["x", "u"] and model.function.name_out() == ["xdot"]


def test_constants_may_stay_symbols():
    model = twin("cf2x", [jd.drag], parameters=("wind", "mass"))
    assert model.parameter_names == ("mass", "wind[0]", "wind[1]", "wind[2]")
    params = windy("cf2x")
    x, u = np.arange(1.0, 18), np.full(4, 15000.0)
    x[3:7] /= np.linalg.norm(x[3:7])
    expected = np.asarray(twin(params, [jd.drag]).function(x, u))
    found = np.asarray(model.function(x, u, model.parameters(params)))
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-13)
    given = model.with_parameters(params.replace(mass=1.3 * params.mass, kf=2 * params.kf))
    np.testing.assert_allclose((given.mass, given.kf), (1.3 * model.params.mass, model.params.kf), rtol=1e-7)


def test_models_with_loops_branches_and_states_of_their_own_have_a_twin():
    def rate(params, state, command):
        swept, _ = jax.lax.scan(lambda sum, w: (sum + w * state.aux["gust"], None), jnp.zeros(3), jnp.ones((2, 3)))
        return jax.lax.cond(state.pos[2] > 0, lambda: -swept, lambda: swept + jnp.cumsum(state.vel))

    gust = jd.Model("gust", lambda params: jnp.ones(3), rate)
    model = twin("cf2x", models=[gust])
    assert model.names[-3:] == ("aux.gust[0]", "aux.gust[1]", "aux.gust[2]")
    x = np.concatenate([[0, 0, 1, 0, 0, 0, 1], np.arange(1.0, 4), np.zeros(7), np.arange(1.0, 4)])
    np.testing.assert_allclose(np.asarray(model.function(x, np.zeros(4)))[-3:, 0], [-2, -4, -6], rtol=1e-14)
    x[2] = -1
    np.testing.assert_allclose(np.asarray(model.function(x, np.zeros(4)))[-3:, 0], [3, 7, 12], rtol=1e-14)


def test_what_has_no_counterpart_is_named():
    def sorting(params, state):
        return jd.Wrench.of_force(jnp.sort(state.vel))

    def bits(params, state):
        return jd.Wrench.of_force(state.vel * (state.vel.astype(int) & 1))

    with pytest.raises(NotImplementedError, match=r"primitive 'sort'.*write the effect or model without it"):
        twin("cf2x", [sorting])
    with pytest.raises(NotImplementedError, match=r"primitive 'and'.*write the effect or model without it"):
        twin("cf2x", [bits])
    with pytest.raises(ValueError, match=r"unknown field of Params 'winds'; did you mean 'wind'"):
        twin("cf2x", parameters=["winds"])
    with pytest.raises(ValueError, match=r"pairs or team_effects are given and the constants are of one drone"):
        twin("cf2x", pairs=[jd.downwash])


def test_a_library_that_is_not_installed_is_named_with_its_extra(monkeypatch):
    for name in "twin", "mpc", "interpreter", "primitives":
        monkeypatch.delitem(sys.modules, f"jaxdrones.optimal.{name}", raising=False)
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(ImportError, match=r"casadi is not installed; pip install "):
        twin("cf2x")


def test_conversions_and_rounding_on_symbols_are_those_of_jax():
    """Truncation to integers, zero or not, halves to even numbers or away from zero, and division of integers."""
    from jaxdrones.optimal.interpreter import on_symbols
    from jaxdrones.optimal.primitives import casadi

    def function(x):
        whole = x.astype(int)
        away = jax.lax.round(x, jax.lax.RoundingMethod.AWAY_FROM_ZERO)
        return (
            whole,
            jnp.where(x.astype(bool), 3.0, 4.0),
            jnp.round(x),
            away,
            jax.lax.div(whole, jnp.full_like(whole, 2)),
        )

    x = np.array([-3.7, -2.5, -1.5, -0.5, -0.2, 0.0, 0.4, 0.5, 1.5, 2.5, 3.5, 5.9])
    (symbols,), result = on_symbols(function, x=jnp.asarray(x))
    found = casadi.Function("f", [symbols], [result])(x.tolist()).full().ravel()
    np.testing.assert_array_equal(found, np.concatenate([np.asarray(y, float) for y in jax.jit(function)(x)]))


def test_sums_along_a_vector_and_entries_beyond_it_are_those_of_jax():
    from jaxdrones.optimal.interpreter import on_symbols
    from jaxdrones.optimal.primitives import casadi

    def function(x):
        filled = jnp.take(x, np.array([1, 7]), mode="fill", fill_value=3.0)
        return jnp.cumsum(x), jax.lax.cumprod(x, reverse=True), filled, x.at[np.array([0, 9])].get(mode="fill")

    x = np.array([2.0, -1.0, 0.5, 4.0, 3.0])
    (symbols,), result = on_symbols(function, x=jnp.asarray(x))
    found = casadi.Function("f", [symbols], [result])(x.tolist()).full().ravel()
    np.testing.assert_array_equal(found, np.concatenate(jax.jit(function)(x)))
