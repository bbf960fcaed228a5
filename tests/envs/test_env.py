"""The contract of environments, on every task, action type and observation, and its errors."""

import dataclasses
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, jit_unoptimized, mostly_slow

import jaxdrones as jd
from jaxdrones.envs import ACTIONS, OBSERVATIONS, TASKS, ContractError, check_env, make
from jaxdrones.tasks.starts import standing_height

KEY = jax.random.key(3)
OTHER = jax.random.key(4)
make_env = lru_cache(make)


def zeros(env):
    return jnp.zeros((env.drones, env.action_size))


@pytest.mark.parametrize("task", mostly_slow(TASKS, ("hover",)))
def test_every_task_keeps_the_contract(task):
    check_env(make_env(task))


@pytest.mark.parametrize("action", mostly_slow(ACTIONS, ("rpm",)))
@pytest.mark.slow
def test_every_action_type_keeps_the_contract(action):
    check_env(make("hover", drones=2, action=action), steps=2)


@pytest.mark.slow
def test_all_observations_together_keep_the_contract():
    env = make("hover", drones=3, observation=tuple(OBSERVATIONS))
    check_env(env)
    assert env.observation_size > 100


@pytest.mark.float32
@pytest.mark.parametrize("task", mostly_slow(["hover", "tracking", "gates"], []))
def test_the_contract_holds_in_single_precision_and_realistic(task):
    check_env(make(task, realistic=True))


def test_the_check_sees_a_broken_contract():
    env = make("hover")
    broken = dataclasses.replace(env.task, rewards={"nan": (1.0, lambda task, world: world.drones.pos[:, 0] * jnp.nan)})
    with pytest.raises(ContractError, match="reward is not finite"):
        check_env(make(broken))


@pytest.mark.parametrize("task", mostly_slow(TASKS, ("recovery", "meetup")))
def test_starts_are_valid(task):
    """No drone below the ground or in another one."""
    env = make_env(task)
    worlds = jit_unoptimized(jax.vmap(env.reset))(jax.random.split(KEY, 256))[1]
    pos, radius = np.asarray(worlds.drones.pos), float(env.params.collision_radius[0])
    assert np.all(pos[..., 2] >= standing_height(env.params)[0] - 1e-9)
    for i in range(env.drones):
        for j in range(i):
            assert np.min(np.linalg.norm(pos[:, i] - pos[:, j], axis=-1)) > 2 * radius


@pytest.mark.parametrize("task", mostly_slow(TASKS, ("hover",)))
def test_no_array_of_a_new_world_is_weakly_typed(task):
    """None is after an automatic reset, so that the first step would need a program of its own."""
    world = jax.eval_shape(make_env(task).reset, KEY)[1]
    assert [x for x in jax.tree.leaves(world) if x.weak_type] == []


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_different_keys_start_differently_or_the_task_has_one_start(task):
    env = make_env(task)
    same = all(
        np.array_equal(a, b)
        for a, b in zip(*(jax.tree.leaves(env.reset(key)[1].drones) for key in (KEY, OTHER)), strict=True)
    )
    assert same == (
        env.task.name
        in {
            "hover-2021",
            "takeoff",
            "fly-through-gate",
            "tune",
            "leader-follower",
            "flock",
            "meetup",
            "hover-2x",
            "multi-hover",
            "gates",
        }
    )


FAR = jnp.array([[0.0, 0.0, 50.0]])


def with_target_far_up(task):
    def target(variables, t):
        setpoint = task.target(variables, t)
        return setpoint.replace(pos=setpoint.pos + FAR)

    return dataclasses.replace(task, target=target)


@pytest.mark.parametrize("name", mostly_slow(["hover", "recovery", "landing", "tracking", "swap-goals"], ["hover"]))
def test_rewards_terminations_and_the_error_follow_the_target_that_a_task_was_given(name):
    """A team that is moved with its target by 50 m is rewarded as before, and not lost."""
    plain, moved = make_env(name), make(with_target_far_up(TASKS[name]()))
    _, world = plain.reset(KEY)
    away = world.replace(drones=world.drones.replace(pos=world.drones.pos + FAR))
    *_, expected = plain.step(KEY, world, zeros(plain))
    *_, terminated, truncated, found = moved.step(KEY, away, zeros(moved))
    assert not terminated and not truncated
    assert_close(found["rewards"], expected["rewards"], 1e-9)
    assert_close(found["metrics"]["error"], expected["metrics"]["error"], 1e-9)
    assert moved.step(KEY, world, zeros(moved))[3], "50 m from its target a drone is lost"


@pytest.mark.parametrize("name", mostly_slow(sorted(set(TASKS) - {"takeoff", "meetup", "race"}), ("hover",)))
def test_every_reward_that_is_about_the_target_is_about_that_of_the_task(name):
    """That of takeoff is about the height alone, that of meetup about the partner, that of race about the track."""
    plain = make_env(name)
    _, world = plain.reset(KEY)
    world = world.replace(step=world.step + 1)
    world = world.replace(drones=world.drones.replace(pos=world.drones.pos + 0.1))

    def reward(task):
        now = world.replace(variables=task.advance(task, world))
        return sum(scale * term(task, now) for scale, term in task.rewards.values())

    assert jnp.all(reward(plain.task)[:1] != reward(with_target_far_up(plain.task))[:1])


def test_a_replaced_field_acts_on_the_new_environment_alone():
    env = make("hover")
    _, world = env.reset(KEY)
    env.step(KEY, world, zeros(env))
    task = dataclasses.replace(env.task, rewards={"one": (1.0, lambda task, world: jnp.ones(1))})
    other = dataclasses.replace(env, task=task, steps=1)
    for changed, env_ in (True, other), (False, env):
        *_, truncated, info = env_.step(KEY, world, zeros(env))
        assert truncated == changed and (info["rewards"].keys() == {"one"}) == changed


def test_an_action_type_is_fitted_to_the_vehicle_of_its_environment():
    """Also where one of the two is replaced: the PID has the gains of the Crazyflie, not of a vehicle of 0.5 kg."""
    small, large = make_env("hover", action="position"), make_env("hover", action="position", vehicle="hb")
    assert small.action.init is not large.action.init
    other = dataclasses.replace(make_env("hover", vehicle="hb"), action=ACTIONS["position"]())
    assert other.action.init is dataclasses.replace(small, params=large.params).action.init is large.action.init


def test_an_episode_is_as_long_as_the_task_unless_its_steps_are_given():
    """Also where another task replaces that of an environment."""
    env = make_env("hover")
    short = dataclasses.replace(env.task, duration=1.0)
    assert dataclasses.replace(env, task=short).steps == 100 and env.steps == 500
    assert dataclasses.replace(dataclasses.replace(env, steps=7), task=short).steps == 7
    assert dataclasses.replace(dataclasses.replace(env, task=short), noise=None, task=env.task).steps == 500


def test_a_control_period_is_that_of_the_physics():
    with pytest.raises(ValueError, match=r"dt is 0.02 s, and a step of the physics takes 0.01 s; .* control_hz=50"):
        dataclasses.replace(make_env("hover"), dt=0.02)


@pytest.mark.parametrize("other", ["tracking", dataclasses.replace(jd.make("hover").task, control_hz=50.0)])
def test_a_world_of_another_task_or_control_period_is_refused(other):
    """Also where the worlds have the same arrays, as at another control period."""
    env = make_env("hover")
    world = make(other).reset(KEY)[1]
    with pytest.raises(ValueError, match=r"world is .*; the environment has the task 'hover', dt 0.01 s"):
        env.step(KEY, world, zeros(env))


def test_an_episode_is_cut_after_its_duration_and_not_before():
    env = make("hover", duration=0.05)
    _, world = env.reset(KEY)
    flags = []
    for _ in range(5):
        _, world, _, terminated, truncated, _ = env.step(KEY, world, zeros(env))
        flags.append(bool(truncated))
        assert not terminated
    assert flags == [False] * 4 + [True]


def test_a_drone_that_is_lost_ends_the_episode_for_good():
    env = make_env("hover")
    _, world = env.reset(KEY)
    world = world.replace(drones=world.drones.replace(pos=world.drones.pos + 100.0))
    *_, terminated, truncated, info = env.step(KEY, world, zeros(env))
    assert terminated and not truncated and info["terminations"]["lost"]


def test_a_drone_that_spins_ends_the_episode_for_good():
    env = make_env("hover")
    _, world = env.reset(KEY)
    world = world.replace(drones=world.drones.replace(omega=jnp.array([[0.0, 0.0, 200.0]])))
    *_, terminated, truncated, info = env.step(KEY, world, zeros(env))
    assert terminated and not truncated and info["terminations"]["spinning"]


def test_a_state_that_is_not_a_number_ends_the_episode():
    env = make_env("hover")
    _, world = env.reset(KEY)
    world = world.replace(drones=world.drones.replace(vel=world.drones.vel * jnp.nan))
    assert env.step(KEY, world, zeros(env))[3]


@pytest.mark.slow
@pytest.mark.parametrize("task", sorted(set(TASKS) - {"gates"}))
def test_gradients_of_the_return_equal_central_differences(task):
    """In the actions, ten steps from a random start, for every task (that of gates below)."""
    env = make_env(task)
    check_gradient(env, env.reset(KEY)[1])


@pytest.mark.slow
def test_gradients_of_the_return_equal_central_differences_before_a_gate():
    env = make_env("gates")
    world = env.reset(KEY)[1]
    up = world.drones.pos.at[:, 2].add(0.5)
    check_gradient(env, world.replace(drones=world.drones.replace(pos=up), variables=world.variables | {"pos": up}))


def check_gradient(env, world, steps=10, eps=1e-6):
    rng = np.random.default_rng(0)
    actions = jnp.asarray(rng.uniform(-0.4, 0.4, (steps, env.drones, env.action_size)))
    direction = jnp.asarray(rng.normal(size=actions.shape))

    @jax.jit
    def returned(actions):
        def advance(world, action):
            _, world, reward, *_ = env.step(KEY, world, action)
            return world, jnp.sum(reward)

        return jnp.sum(jax.lax.scan(advance, world, actions)[1])

    slope = jnp.sum(jit_unoptimized(jax.grad(returned))(actions) * direction)
    difference = (returned(actions + eps * direction) - returned(actions - eps * direction)) / (2 * eps)
    np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=1e-7)
    assert np.isfinite(slope)


MISTAKES = [
    (dict(task="hoover"), "unknown task 'hoover'; did you mean 'hover'"),
    (dict(task="hover", action="rpms"), "unknown action 'rpms'; did you mean 'rpm'"),
    (dict(task="hover", observation=("omeg",)), "unknown observation 'omeg'; did you mean 'omega'"),
    (dict(task="hover", observation=()), "observation is empty"),
    (dict(task="hover", backend="mujoco"), "unknown backend 'mujoco'"),
    (dict(task="hover", delay=-0.1), "delay is -0.1; give a number of at least 0"),
    (dict(task="hover", control_hz=0), "control_hz is 0; give a positive number"),
    (dict(task="hover", substeps=2.5), "substeps is 2.5; give a whole number"),
    (dict(task="hover", vision=("rgb",), camera=3), r"camera is 3; give for example jaxdrones\.Camera"),
    (dict(task="hover", camera=jd.Camera()), r"camera is given without vision; give .*vision="),
    (
        dict(task="hover", vision=("rgb",), camera=jd.Camera(rate=200.0)),
        r"rate of the camera is 200 images/s; give at most the control rate, 100",
    ),
    (
        dict(task="hover", vision=("rgb",), camera=jd.Camera(latency=30.0)),  # milliseconds
        "latency of the camera is 30.0; give a number below 5",
    ),
    (dict(task="hover", vision=("grey",)), "unknown image 'grey'"),
    (dict(task="hover", effects=("drga",)), "unknown effect 'drga'; did you mean 'drag'"),
    (
        dict(task="leader-follower", drones=1),
        "number of drones of leader-follower is 1; give a whole number of at least 2",
    ),
    (dict(task="gates", level=4), "level is 4; give one of 0, 1, 2, 3"),
    (dict(task="tracking", curve="square"), "unknown curve 'square'"),
]


@pytest.mark.parametrize(("options", "message"), MISTAKES, ids=[m[1][:30] for m in MISTAKES])
def test_a_mistake_is_named(options, message):
    with pytest.raises(ValueError, match=message):
        make(options.pop("task"), **options) if (options := dict(options)) else None


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros((1, 3)), r"action has shape \(1, 3\); expected \(1, 4\)"),
        (np.zeros(4), r"action has shape \(4,\); expected \(1, 4\)"),
        (np.full((1, 4), np.nan), "action is not finite"),
    ],
)
def test_a_wrong_action_is_refused(action, message):
    env = make_env("hover")
    _, world = env.reset(KEY)
    with pytest.raises(ValueError, match=message):
        env.step(KEY, world, action)


def test_actions_beyond_one_are_cut():
    env = make_env("hover")
    _, world = env.reset(KEY)
    assert_close(env.step(KEY, world, zeros(env) + 5)[1].drones, env.step(KEY, world, zeros(env) + 1)[1].drones, 0)


def test_no_random_key_is_used_twice_where_an_environment_is_made_reset_and_flown():
    with jax.debug_key_reuse(True):
        env = make("hover", realistic=True)
        world = jax.eval_shape(env.reset, KEY)[1]
        jax.eval_shape(env.step, KEY, world, jnp.zeros((1, 4)))
