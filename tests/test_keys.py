"""No two draws share a random key: every key is either drawn from, once, or made others of, which all differ."""

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from double_integrator import Untasked, outcome
from helpers import Keys, mostly_slow

import jaxdrones as jd
from jaxdrones.envs import AutoReset, make
from jaxdrones.envs import episode as environment
from jaxdrones.envs.disturbances import random_pushes
from jaxdrones.envs.randomize import scaled, sensor_noise, shifted
from jaxdrones.learning import bptt, ppo, shac
from jaxdrones.learning.networks import Policy
from jaxdrones.sensing import Scene, Sensor, Sphere
from jaxdrones.training import plan

KEY = jax.random.key(3)
EVERYTHING = dict(
    randomize=(scaled("mass", 0.9, 1.1), scaled("kf", 0.9, 1.1), shifted("wind", -1, 1)),
    noise=sensor_noise(),
    disturbance=random_pushes(0.3),
    sensors=(
        Sensor(
            "noisy",
            lambda key, params, state, rate, scene, memory: (memory, memory + jax.random.normal(key)),
            lambda key, params: jax.random.normal(key),
        ),
    ),
    scene=lambda key: Scene.of(Sphere(pos=jax.random.uniform(key, (3,)) + 50.0, radius=0.1)),
    effects=(jd.drag, jd.external_force, lambda params, state, scene: jd.Wrench.of_force(0 * scene.spheres.pos[0])),
)
SMALL = dict(updates=2, worlds=3, horizon=2, hidden_sizes=(2,))
CRITIC = dict(critic_hidden_sizes=(2,))
LEARNERS = {
    "bptt": (bptt, bptt.Config(**SMALL)),
    "shac": (shac, shac.Config(**SMALL, **CRITIC, critic_steps=2)),
    "ppo": (ppo, ppo.Config(**SMALL, **CRITIC, epochs=2, minibatches=3)),
}


@pytest.fixture
def keys(monkeypatch):
    keys = Keys()

    def seen(key):
        return jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key

    def note_draw(key):
        keys.drawn[np.asarray(key).tobytes()] += 1

    def note_family(parent, children):
        keys.parents.add(np.asarray(parent).tobytes())
        for child in np.asarray(children).reshape(-1, 2):
            keys.derived[child.tobytes()] += 1

    def drawing(function):
        def draw(key, *args, **kwargs):
            jax.debug.callback(note_draw, seen(key))
            return function(key, *args, **kwargs)

        return draw

    def making(function):
        def make(key, *args, **kwargs):
            children = function(key, *args, **kwargs)
            jax.debug.callback(note_family, seen(key), seen(children))
            return children

        return make

    for name in Keys.draws:
        monkeypatch.setattr(jax.random, name, drawing(getattr(jax.random, name)))
    for name in ("split", "fold_in"):
        monkeypatch.setattr(jax.random, name, making(getattr(jax.random, name)))
    return keys


@pytest.mark.parametrize("task", mostly_slow(["hover", "tracking", "swap-goals"], ["hover"]))
@pytest.mark.slow
def test_the_draws_of_an_episode_have_keys_of_their_own(keys, task):
    """Start, parameters, scene, sensors, noise, pushes, and those of the next episode: in one step that ends one."""
    env = make(task, **EVERYTHING)
    _, episode = AutoReset(env).reset(jax.random.key(2))
    episode = episode.replace(world=episode.world.replace(step=env.steps - 1))
    AutoReset(env).step(KEY, episode, jnp.zeros((env.drones, 4)))
    keys.check(least=2 * 8 + 3)


def test_no_key_of_a_start_is_made_twice(keys):
    """`fold_in(key, 1)` is the second of the keys that `split(key)` makes."""
    env = make("swap-goals", drones=3, random_places=True)
    jax.jit(env.task.start)(KEY, env.params)
    keys.check(least=8)


def test_the_streams_of_an_environment_have_numbers_of_their_own():
    streams = {name: number for name, number in vars(environment).items() if name.isupper() and type(number) is int}
    assert {"DISTURBANCE", "NOISE", "START", "RANDOMIZE", "RESET", "SENSORS", "SCENE", "VISION"} <= set(streams)
    assert len(set(streams.values())) == len(streams)


@pytest.mark.slow
def test_every_stream_of_an_environment_sees_a_key_that_no_other_sees(monkeypatch):
    """Fake noise, pushes, randomizations, starts and resets record the key they saw, even if all get the same one."""
    seen = {}

    def tell(stream, key):
        def note(data):
            seen.setdefault(stream, set()).add(np.asarray(data).tobytes())

        jax.debug.callback(note, jax.random.key_data(key))

    def noise(key, state):
        tell("noise", key)
        return state

    def disturbance(key, params, dt):
        tell("disturbance", key)
        return params

    def draw(randomize, key, params):
        tell("randomize", key)
        return params

    plain = make("hover").task

    def start(key, params):
        tell("start", key)
        return plain.start(key, params)

    monkeypatch.setattr("jaxdrones.envs.randomize.draw", draw)
    env = make(dataclasses.replace(plain, start=start), noise=noise, disturbance=disturbance)
    jax.effects_barrier()
    seen.clear()  # of the starts with which the environment was checked
    begin = env.begin
    object.__setattr__(env, "begin", lambda key, *progress: (tell("reset", key), begin(key, *progress))[1])
    _, episode = AutoReset(env).reset(KEY)
    episode = episode.replace(world=episode.world.replace(step=env.steps - 1))
    AutoReset(env).step(KEY, episode, jnp.zeros((1, 4)))
    jax.effects_barrier()
    counts = {stream: len(found) for stream, found in seen.items()}
    assert counts == dict(reset=2, randomize=2, start=2, noise=2, disturbance=1)
    assert len(set().union(*seen.values())) == sum(counts.values())


def test_noise_and_pushes_of_a_step_have_keys_of_their_own():
    seen = {}

    def noise(key, state):
        seen["noise"] = jax.random.key_data(key)
        return state

    def disturbance(key, params, dt):
        seen["disturbance"] = jax.random.key_data(key)
        return params

    env = make("hover", noise=noise, disturbance=disturbance)
    world = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(env.reset, KEY)[1])
    world = world.replace(params=env.params)
    world, _ = environment.command(env, KEY, world, jnp.zeros((1, 4)))
    environment.outcome(env, KEY, world, None)
    assert not np.array_equal(seen["noise"], seen["disturbance"])


class Toss(Untasked):
    """A world that draws in every step; all that a learner needs."""

    drones, action_size, observation_size, dt, steps, constant_fields, vision = 1, 1, 2, 0.1, 2, (), None

    def reset(self, key):
        x = jax.random.uniform(jax.random.fold_in(key, 0), (1, 2))
        return x, TossWorld(Place(x), jnp.zeros((), jnp.int32))

    begin = reset

    def step(self, key, world, action):
        x = world.drones.pos + jax.random.normal(jax.random.fold_in(key, 0), (1, 2)) + action
        world = TossWorld(Place(x), world.step + 1)
        return x, world, -(x[:, 0] ** 2), *outcome(self, jnp.zeros((), bool), world, jnp.abs(x[:, 0]))


class Place(flax.struct.PyTreeNode):
    pos: jax.Array


class TossWorld(flax.struct.PyTreeNode):
    drones: Place
    step: jax.Array
    images: None = None
    poses: None = None


@pytest.mark.float32
@pytest.mark.parametrize("name", mostly_slow(LEARNERS, ["bptt"]))
@pytest.mark.slow
def test_the_draws_of_a_learner_and_of_its_evaluations_have_keys_of_their_own(keys, name, monkeypatch):
    learner, config = LEARNERS[name]
    env = Toss()

    def init(key, *_):  # of the networks, which flax draws with functions of its own
        jax.random.normal(key)
        return Policy.init(jax.random.key(0), env, (2,))

    with monkeypatch.context() as patched:
        patched.setattr("jaxdrones.learning.result.Policy", type("Policy", (), {"init": staticmethod(init)}))
        state = learner.init(KEY, env, config)
    jax.jit(lambda state: learner.update(env, config, state))(state)
    for purpose in (plan.SELECTION_STREAM, plan.REPORT_STREAM):
        jax.random.split(jax.random.fold_in(KEY, purpose))
    keys.check(least=10)
