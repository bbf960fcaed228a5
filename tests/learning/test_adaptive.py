"""Policies for all vehicles fly like their own code, whatever the axes of the vehicle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones as jd
from jaxdrones import rotation
from jaxdrones.learning import adaptive, evaluate

pytestmark = [pytest.mark.needs("foundation_policy"), pytest.mark.float32]
KEY = jax.random.key(0)


def observations(env, steps):
    rng = np.random.default_rng(0)
    quat = rng.normal(size=(steps, 1, 4))
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    matrix = np.asarray(jax.vmap(jax.vmap(rotation.to_matrix))(jnp.asarray(quat)))
    away, vel, omega = rng.normal(size=(3, steps, 1, 3)) * 0.3
    rest = np.zeros((steps, 1, env.observation_size - 18))
    seen = np.concatenate([-away, matrix.reshape(steps, 1, 9), -vel, omega, rest], axis=-1)
    return seen.astype(np.float32), np.concatenate([away, matrix.reshape(steps, 1, 9), vel, omega], axis=-1)


def speeds(env, action):
    """Rotor speeds over the largest."""
    command = env.action.rpm(jax.tree.map(lambda x: x[0], env.params), None, None, action, None, env.dt)[1]
    return np.asarray(command / env.params.max_rpm[0])


def make(**options):
    return jd.make("hover", rotors="lagging", action="throttle", **options)


@pytest.mark.slow
def test_raptor_commands_the_rotor_speeds_of_its_own_code():
    """On cf2x, whose rotor at the front right turns as in RAPTOR's training, and whose rotors have its order."""
    from foundation_policy import Raptor

    env, own = make(), Raptor()
    own.reset()  # it has seen an example
    policy = jd.make_policy("raptor", env)
    hidden, last = policy.initial_hidden_state((1,)), np.zeros((1, 4))
    for obs, seen in zip(*observations(env, 20), strict=True):
        last = np.clip(own.evaluate_step(np.concatenate([seen, last], axis=-1).astype(np.float32)), -1, 1)
        hidden, action = policy.act(hidden, jnp.asarray(obs))
        np.testing.assert_allclose(speeds(env, action[0]), (last[0] + 1) / 2, atol=2e-6)


@pytest.mark.slow
def test_raptor_flies_a_vehicle_with_other_axes_like_its_turned_twin():
    """Rotors on the axes, not at the corners: the same vehicle, turned by 45 degrees."""
    cross = jd.load_params("cf2x")
    sin = np.sqrt(0.5)
    turn = np.array([[sin, -sin, 0], [sin, sin, 0], [0, 0, 1]])
    plus = cross.replace(rotor_pos=cross.rotor_pos @ jnp.asarray(turn.T, jnp.float32))
    envs = [make(vehicle=vehicle) for vehicle in (cross, plus)]
    policies = [jd.make_policy("raptor", env) for env in envs]
    hidden = [policy.initial_hidden_state((1,)) for policy in policies]
    for obs in observations(envs[0], 5)[0]:
        of_plus = obs.copy()
        of_plus[:, 3:12] = (obs[:, 3:12].reshape(3, 3) @ turn.T).reshape(1, 9)
        of_plus[:, 15:18] = obs[:, 15:18] @ turn.T
        actions = []
        for i, seen in enumerate((obs, of_plus)):
            hidden[i], action = policies[i].act(hidden[i], jnp.asarray(seen))
            actions.append(speeds(envs[i], action[0]))
        np.testing.assert_allclose(*actions, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["raptor", "any-vehicle"])
@pytest.mark.parametrize("vehicle", ["cf2x", "cf2p", "racer", "hummingbird"])
def test_a_policy_for_all_vehicles_hovers_30_to_1000_grams(vehicle, policy):
    env = make(vehicle=vehicle)
    assert evaluate(env, jd.make_policy(policy, env), KEY, 50).success > 0.85


@pytest.mark.slow
def test_the_policy_for_any_vehicle_hovers_drawn_ones_in_spite_of_delay_and_noise():
    env = jd.make("hover", realistic="any", action="throttle")
    assert evaluate(env, jd.make_policy("any-vehicle", env), KEY, 200).success > 0.93


@pytest.mark.slow
def test_the_policy_for_any_vehicle_has_less_weights_than_raptor_and_is_not_told_the_vehicle():
    """The same observations give the same throttle, whatever the mass and the largest speed of the vehicle."""
    weights = jd.make_policy("any-vehicle", make()).network.params
    assert sum(leaf.size for leaf in jax.tree.leaves(weights)) <= 2084
    heavy = jd.load_params("cf2x").replace(mass=0.05, max_rpm=40_000.0, kf=1e-9)
    actions = []
    for env in (make(), make(vehicle=heavy)):
        policy = jd.make_policy("any-vehicle", env)
        hidden = policy.initial_hidden_state((1,))
        for obs in observations(env, 5)[0]:
            hidden, action = policy.act(hidden, jnp.asarray(obs))
        actions.append(action)
    np.testing.assert_array_equal(*actions)


def test_an_environment_that_raptor_cannot_fly_is_named():
    for options in ({"action": "position"}, {"observation": ("velocity", "position_error")}):
        with pytest.raises(ValueError, match="raptor observes"):
            jd.make_policy("raptor", jd.make("hover", **options))
    with pytest.raises(ValueError, match="raptor"):
        jd.make_policy("eagle", jd.make("hover"))


def test_neighbors_that_turn_the_same_way_are_refused():
    """Only the spin of the front right rotor was compared."""
    params = jd.load_params("cf2x")
    for spin in ([-1.0, -1, 1, 1], [-1.0, 1, 1, -1]):
        with pytest.raises(ValueError, match="neighbors of opposite spins"):
            adaptive._placed("any-vehicle", params.replace(rotor_spin=np.array(spin)))
    for vehicle in ("cf2x", "cf2p", "hb", "x500", "racer"):
        assert sorted(adaptive._placed("any-vehicle", jd.load_params(vehicle))[1]) == [0, 1, 2, 3]
