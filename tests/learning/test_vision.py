"""Policies that see: what they promise, and that one learns to look."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones as jd
from jaxdrones import rotation
from jaxdrones.control import Setpoint
from jaxdrones.control.allocation import rpm_from_wrench
from jaxdrones.envs import Action
from jaxdrones.envs.vision import Vision
from jaxdrones.learning import bptt, checkpoint, compilation, evaluate, evaluation, ppo, result, shac
from jaxdrones.learning.layers import IMAGE_CHANNELS
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.normalize import map_state_vector
from jaxdrones.sensing import Scene, Sphere
from jaxdrones.tasks.starts import hovering
from jaxdrones.tasks.task import Task

BALL = (1.0, 0.0, 6.0)  # m; so high that no episode reaches the ground
REACH, TURN = 0.5, 0.5  # m, rad; from all starts the ball is in the picture
NEAR = 0.1  # m and rad
KEY = jax.random.key(0)


def look_at_the_ball() -> Task:
    """Climb and turn until a ball, 1 m away, is in the middle of the picture, which alone shows where it is."""

    def start(key, params):
        up, turn = jax.random.uniform(key, (2, 1), params.mass.dtype, -1, 1)
        state = hovering(params, jnp.array([[0.0, 0.0, BALL[2]]], up.dtype).at[:, 2].add(REACH * up))
        rpy = TURN * turn * jnp.array([0, 0, 1], up.dtype)
        return state.replace(quat=rotation.from_rpy(rpy)[None]), None

    def height(task, world):
        """Above or below the ball, m."""
        return jnp.abs(world.drones.pos[:, 2] - BALL[2])

    def bearing(task, world):
        """From the nose to the ball, rad."""
        return jnp.abs(jax.vmap(rotation.to_rpy)(world.drones.quat)[:, 2])

    def success(metrics, dt):
        last = slice(-round(1 / dt), None)
        return jnp.all((metrics["height"][last] < NEAR) & (metrics["bearing"][last] < NEAR), axis=0)

    return Task(
        name="look-at-the-ball",
        summary="have the ball in the middle of the picture",
        drones=1,
        duration=3.0,
        start=start,
        target=lambda variables, t: Setpoint.at(jnp.array([[0.0, 0.0, BALL[2]]])),
        rewards={"height": (-1 / REACH, height), "bearing": (-1 / TURN, bearing)},
        metrics={"height": height, "bearing": bearing},
        success=success,
        scene=Scene.of(Sphere(pos=BALL, radius=0.2, color=(0.9, 0.1, 0.1, 1.0))),
        observation=("velocity", "omega"),
        control_hz=10.0,
        substeps=1,
    )


def climb_and_turn() -> Action:
    """Thrust of 0.9 to 1.1 weights, yaw torque for up to 2 rad/s^2."""

    def command(params, memory, state, action, setpoint, dt):
        torque = jnp.array([0, 0, 2.0], action.dtype) * params.inertia * action[1]
        return memory, rpm_from_wrench(params, params.weight * (1 + 0.1 * action[0]), torque)

    return Action(2, command)


class Blindfold(Vision):
    """Black pictures."""

    def look(self, params, drones, scene):
        return jax.tree.map(jnp.zeros_like, super().look(params, drones, scene))


def learn(image: str, seeing: bool = True, key: jax.Array = KEY):
    """Reports on 200 episodes before and after training."""
    with jd.make(look_at_the_ball(), backend="bullet", vision=(image,), action=climb_and_turn()) as env:
        if not seeing:
            env = dataclasses.replace(env, vision=Blindfold(**vars(env.vision)))
        rates = dict(epochs=4, learning_rate=2e-3, max_learning_rate=5e-3)
        config = ppo.Config(updates=30, worlds=64, horizon=15, gamma=0.95, gae_lambda=0.95, **rates)
        trained = ppo.train(key, env, config).policy
        untrained = Policy.init(key, env, config.hidden_sizes)
        return [evaluate(env, policy, jax.random.key(1), episodes=200) for policy in (untrained, trained)]


@pytest.fixture(scope="module")
def team():
    with jd.make("hover", drones=2, backend="bullet", vision=("rgb", "depth")) as env:
        yield env


def seen(env, *batch: int):
    """Random observations."""
    rng = np.random.default_rng(0)
    shape = (*batch, env.drones)
    return {
        "state": jnp.asarray(rng.normal(size=(*shape, env.observation_size))),
        "rgb": jnp.asarray(rng.integers(0, 256, (*shape, 48, 64, 4)), jnp.uint8),
        "depth": jnp.asarray(rng.uniform(0, 10, (*shape, 48, 64)), jnp.float32),
    }


@pytest.mark.slow
@pytest.mark.needs("pybullet")
@pytest.mark.parametrize("image", ["rgb", "depth"])
def test_what_a_policy_does_depends_on_what_it_sees(team, image):
    policy, obs = Policy.init(KEY, team, (8,)), seen(team)
    other = obs | {image: jnp.flip(obs[image], axis=2)}
    assert jnp.all(policy(obs) != policy(other))


def test_colors_are_scaled_to_one_and_opacity_is_dropped():
    rgb = jnp.array([[[[0, 51, 255, 255]]]], jnp.uint8)
    np.testing.assert_allclose(IMAGE_CHANNELS["rgb"](rgb, 3.0)[0, 0, 0], [0, 0.2, 1], rtol=1e-6)


@pytest.mark.needs("pybullet")
def test_normalizing_leaves_images_as_they_are(team):
    obs = seen(team)
    twice = map_state_vector(lambda x: 2 * x, obs)
    np.testing.assert_array_equal(twice["state"], 2 * obs["state"])
    assert twice["rgb"] is obs["rgb"] and twice["depth"] is obs["depth"]


@pytest.mark.needs("pybullet")
def test_images_without_a_scale_such_as_labels_are_refused():
    with jd.make("hover", backend="bullet", vision=("depth", "segmentation")) as env:
        with pytest.raises(ValueError, match=r"unknown image for a policy 'segmentation' \(known: depth, rgb\)"):
            Policy.init(KEY, env, (8,))


@pytest.mark.slow
@pytest.mark.needs("pybullet")
@pytest.mark.parametrize("per_agent", [False, True])
def test_drones_that_see_the_same_do_the_same_unless_each_has_its_own_eyes(team, per_agent):
    policy = Policy.init(KEY, team, (8,), per_agent)
    same = jax.tree.map(lambda x: jnp.stack([x[0], x[0]]), seen(team))
    action = policy(same)
    assert jnp.all(action[0] == action[1]) == (not per_agent)


@pytest.mark.slow
@pytest.mark.needs("pybullet")
@pytest.mark.parametrize("per_agent", [False, True])
def test_a_policy_of_many_worlds_is_that_of_each(team, per_agent):
    policy, obs = Policy.init(KEY, team, (8,), per_agent), seen(team, 3, 2)
    action = policy(obs)
    assert action.shape == (3, 2, 2, 4)
    alone = policy(jax.tree.map(lambda x: x[1, 1], obs))
    np.testing.assert_allclose(action[1, 1], alone, rtol=1e-5, atol=1e-9)  # pictures are in single precision


@pytest.mark.slow
@pytest.mark.needs("pybullet")
def test_a_policy_that_sees_flies_on_as_it_was_saved(team, tmp_path):
    policy, obs = Policy.init(KEY, team, (8,), per_agent=True), seen(team)
    checkpoint.save(tmp_path / "policy", policy)
    loaded = checkpoint.load(tmp_path / "policy")
    np.testing.assert_array_equal(loaded(obs), policy(obs))
    assert jax.tree.structure(loaded) == jax.tree.structure(policy)


@pytest.mark.needs("pybullet")
@pytest.mark.slow
def test_a_central_critic_sees_every_vector_and_its_own_pictures(team):
    config = ppo.Config(
        updates=1, worlds=8, horizon=2, per_agent=True, centralized_critic=True, critic_hidden_sizes=(8,)
    )
    state = jax.eval_shape(lambda key: ppo.init(key, team, config), KEY)
    d, a, found = team.observation_size, team.action_size, state.policy.network.features
    assert state.critic["params"]["MLP_0"]["Dense_0"]["kernel"].shape == (2, 2 * d + a + found, 8)
    after, _ = jax.eval_shape(lambda state: ppo.update(team, config, state), state)
    assert jax.tree.map(jnp.shape, after) == jax.tree.map(jnp.shape, state)


@pytest.mark.slow
@pytest.mark.needs("pybullet")
def test_a_compiled_program_sees_what_is_seen_without_one(team):
    drones = jax.vmap(team.reset)(jax.random.split(KEY, 3))[1].drones
    together = jax.jit(jax.vmap(lambda drones: team.physics.camera(team.params, drones)))(drones)
    for i in range(3):
        alone = team.physics.camera(team.params, jax.tree.map(lambda x, i=i: np.asarray(x[i]), drones))
        jax.tree.map(lambda a, b, i=i: np.testing.assert_array_equal(a[i], b), together, alone)


@pytest.mark.parametrize("task", ["forest", "hover"])
@pytest.mark.parametrize("learner", [bptt, shac, ppo])
def test_programs_with_images_are_compiled_for_large_arrays(task, learner, monkeypatch):
    """With the options for small arrays, updates and evaluations of the forest take several times as long."""
    env, chosen = jd.make(task), []
    monkeypatch.setattr(compilation, "training_options", lambda large_arrays: chosen.append(large_arrays) or {})
    result._cached_programs.__wrapped__(learner.init, learner.update, env, learner.Config())
    evaluation._compiled_outcomes.__wrapped__(env)
    sees = task == "forest"
    assert chosen == [sees, sees or learner is ppo, sees]  # the start, the updates, an evaluation


@pytest.mark.needs("pybullet")
@pytest.mark.slow
@pytest.mark.float32
def test_ppo_learns_where_to_look_and_that_is_due_to_the_picture():
    before, after = learn("depth")
    _, blindfolded = learn("depth", seeing=False)
    # Who cannot see can at best stay where it starts, for 4 % of the starts near enough; below 10 % at the upper end of
    # the interval of 200 episodes. Three seeds that saw came to 96 to 100 %.
    assert before.success_interval[1] < 0.1 and blindfolded.success_interval[1] < 0.1
    assert after.success_interval[0] > 0.7
    assert after.mean_return > 0.5 * max(before.mean_return, blindfolded.mean_return)  # at most half the cost
