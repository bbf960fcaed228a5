"""The law of motion by itself: what every integrator integrates."""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import INTEGRATORS, assert_close, flying, make_step, mostly_slow, name_of, tape

import jaxdrones as jd

TEAM = jd.repeat(jd.load_params("cf2x"), 2)
START = flying(TEAM)
COMMAND = tape(TEAM, 1)[0]
PHYSICS = dict(effects=(jd.drag,), pairs=(jd.downwash,), rotors=jd.lagging_rotors)


@pytest.mark.slow
def test_a_step_of_euler_is_the_derivative_times_its_length():
    rate = jax.jit(jd.make_derivative(**PHYSICS))(TEAM, START, COMMAND)
    after = make_step(**PHYSICS, integrator=jd.euler, dt=1e-3)(TEAM, START, COMMAND)
    moved = jax.tree.map(lambda x, k: x + 1e-3 * k, START, rate)
    length = jnp.linalg.norm(moved.quat, axis=1, keepdims=True)
    assert_close(after, moved.replace(quat=moved.quat / length), 1e-15, rtol=1e-12)


@pytest.mark.slow
def test_the_rate_of_a_step_is_its_derivative():
    step = make_step(**PHYSICS)
    assert_close(step.rate(TEAM, START, COMMAND), jd.make_derivative(**PHYSICS)(TEAM, START, COMMAND), 1e-9, rtol=1e-12)


def test_a_rate_begins_like_a_step_at_limited_rotor_speeds():
    """Of a state whose rotors turn too fast or backwards, as after a filter or an optimizer."""
    step = make_step(rotors=jd.lagging_rotors)
    beyond = START.replace(rpm=jnp.array([[1.5, -0.5, 1.0, 0.5]]) * TEAM.max_rpm[:, None])
    within = START.replace(rpm=jnp.array([[1.0, 0.0, 1.0, 0.5]]) * TEAM.max_rpm[:, None])
    assert_close(step(TEAM, beyond, COMMAND), step(TEAM, within, COMMAND), 0)
    assert_close(step.rate(TEAM, beyond, COMMAND), step.rate(TEAM, within, COMMAND), 0)


@pytest.mark.slow
def test_its_jacobian_about_hover_is_that_of_the_linearized_quadrotor():
    """A tilt about x accelerates along -g y, one about y along g x; thrust lifts by 2 k_F rpm / m."""
    team = jd.repeat(jd.load_params("cf2x"), 1)
    derivative, start = jd.make_derivative(), jd.State.at_rest(np.zeros((1, 3)))
    hover = jnp.full((1, 4), team.hover_rpm[0])

    def acceleration(tilt, rpm):
        quat = jd.rotation.exp(tilt)[None]
        return derivative(team, start.replace(quat=quat), hover + rpm).vel[0]

    by_tilt, by_rpm = jax.jacobian(acceleration, (0, 1))(jnp.zeros(3), jnp.zeros((1, 4)))
    g = float(team.gravity[0])
    np.testing.assert_allclose(by_tilt, [[0, g, 0], [-g, 0, 0], [0, 0, 0]], rtol=0, atol=1e-12)
    lift = 2 * team.kf[0] * team.hover_rpm[0] / team.mass[0]
    np.testing.assert_allclose(by_rpm[2, 0], np.full(4, lift), rtol=1e-12)


class Counted(jd.State):
    """A user's state with a field more."""

    label: jax.Array = flax.struct.field(default_factory=lambda: jnp.zeros((2, 1)))


@pytest.mark.parametrize("integrator", mostly_slow(INTEGRATORS, [jd.semi_implicit_euler]), ids=name_of)
@pytest.mark.slow
def test_a_further_field_of_a_subclass_stays_as_it_is(integrator):
    mine = Counted(**vars(START) | {"label": jnp.array([[3.0], [7.0]])})
    step = make_step(**PHYSICS, integrator=integrator)
    after, plain = step(TEAM, mine, COMMAND), step(TEAM, START, COMMAND)
    np.testing.assert_array_equal(after.label, mine.label)
    np.testing.assert_array_equal(after.pos, plain.pos)


@pytest.mark.parametrize("integrator", INTEGRATORS, ids=name_of)
def test_an_integrator_moves_a_further_field_by_its_rate(integrator):
    """A law of motion of a user's own: the label grows by 2 a second, the rest stands still."""

    def derivative(state):
        return jax.tree.map(jnp.zeros_like, state).replace(label=jnp.full((2, 1), 2.0))

    after = integrator(derivative, Counted(**vars(START)), 0.25)
    assert isinstance(after, Counted)
    np.testing.assert_allclose(after.label, 0.5, rtol=1e-14)


@pytest.mark.slow
def test_the_aux_of_no_model_stays_and_effects_read_it():
    def fan(params, state):
        return jd.Wrench.of_force(jd.vector.along_z(state.aux["fan"]["force"]))

    step = make_step((fan,), integrator=jd.rk4)
    blown = START.replace(aux={"fan": {"force": jnp.array([0.1, 0.0])}})
    after, plain = step(TEAM, blown, COMMAND), step(TEAM, START.replace(aux={"fan": {"force": jnp.zeros(2)}}), COMMAND)
    np.testing.assert_array_equal(after.aux["fan"]["force"], [0.1, 0.0])
    assert np.any(after.vel[0] != plain.vel[0]) and np.all(after.vel[1] == plain.vel[1])


@pytest.mark.parametrize(
    ("aux", "message"),
    [
        ({"charge": jnp.zeros(3)}, r"state\.aux\['charge'\] has shape \(3,\); give arrays with a leading axis over 2"),
        ({"charge": jnp.zeros(())}, r"state\.aux\['charge'\] has shape \(\)"),
        ({"charge": jnp.zeros(2, int)}, r"state\.aux\['charge'\] holds int64; give floating-point numbers"),
        ([1.0], r"state\.aux is \[.*; give a dictionary"),
    ],
)
def test_aux_that_is_not_of_the_team_is_named(aux, message):
    with pytest.raises(ValueError, match=message):
        make_step()(TEAM, START.replace(aux=aux), COMMAND)


def test_a_team_effect_acts_on_chosen_drones():
    """A spring from the first to the second drone: equal and opposite, along the line between them."""

    def spring(params, state):
        pull = 0.01 * (state.pos[1] - state.pos[0])
        force = jnp.stack([pull, -pull])
        return jd.Wrench(jax.vmap(jd.rotation.rotate_inverse)(state.quat, force), jnp.zeros((2, 3)))

    with_spring, without = (jd.make_derivative(team_effects=f)(TEAM, START, COMMAND).vel for f in ((spring,), ()))
    pull = 0.01 * (START.pos[1] - START.pos[0]) / TEAM.mass[0]
    np.testing.assert_allclose(with_spring - without, [pull, -pull], rtol=1e-10)


def test_a_team_effect_that_returns_the_wrench_of_one_drone_is_named():
    def one(params, state):
        return jd.Wrench(jnp.zeros(3), jnp.zeros(3))

    with pytest.raises(ValueError, match=r"team_effects: one: force has shape \(3,\); expected \(2, 3\)"):
        make_step(team_effects=(one,))(TEAM, START, COMMAND)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(models=(jd.drag,)), r"models: .* is not a model; give jaxdrones\.Model\(name, init, rate\)"),
        (dict(models=jd.Model("a", lambda p: 0, lambda p, s, c: 0)), "models is .*give a sequence"),
        (dict(models=(jd.Model("a", lambda p: 0, lambda p, s, c: 0),) * 2), "models are named a, a"),
        (
            dict(effects=(jd.drag, jd.ground_effect, jd.drag)),
            "effects are drag, ground_effect, drag, one of them twice",
        ),
        (dict(pairs=(jd.downwash,) * 2), "pairs are downwash, downwash, one of them twice"),
        (dict(team_effects=(jd.downwash,)), r"team_effects: downwash takes .*\(params, state\)"),
    ],
)
def test_wrong_models_and_effects_are_named(arguments, message):
    for build in jd.make_step, jd.make_derivative:
        with pytest.raises(ValueError, match=message):
            build(**arguments)
