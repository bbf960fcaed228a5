"""Environments with a known answer, a double integrator and a cue, and small settings of every learner for them."""

from types import SimpleNamespace

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.envs.vision import observation
from jaxdrones.learning import bptt, ppo, shac

SMALL = {
    bptt: bptt.Config(updates=3, worlds=4, horizon=4, hidden_sizes=(8,)),
    shac: shac.Config(updates=3, worlds=4, horizon=4, hidden_sizes=(8,), critic_hidden_sizes=(8,), critic_steps=2),
    ppo: ppo.Config(
        updates=3, worlds=4, horizon=4, hidden_sizes=(8,), critic_hidden_sizes=(8,), epochs=2, minibatches=2
    ),
}


class Point(flax.struct.PyTreeNode):
    pos: jax.Array


class PointWorld(flax.struct.PyTreeNode):
    drones: Point
    step: jax.Array
    images: dict = flax.struct.field(default_factory=dict)
    poses: None = None


class Untasked:
    """What learners ask of the task of an environment: no curriculum, any number of truncations, ends of the team."""

    task = SimpleNamespace(start=lambda key, params: None, truncations={"some": None}, ends="team")
    sets = ()


class DoubleIntegrator(Untasked):
    """x'' = u from x, v in [-0.1, 0.1], cost 100 x^2 + 10 v^2 + 10 u^2; all that a learner needs."""

    drones, action_size, observation_size, dt, steps, constant_fields, vision = 1, 1, 2, 0.1, 50, (), None

    def reset(self, key):
        x = jax.random.uniform(key, (1, 2), minval=-0.1, maxval=0.1)
        return x, PointWorld(Point(x), jnp.zeros((), jnp.int32))

    begin = reset

    def step(self, key, world, action):
        a, b = dynamics()
        x = world.drones.pos
        cost = 100 * x[:, 0] ** 2 + 10 * x[:, 1] ** 2 + 10 * action[:, 0] ** 2
        x = x @ jnp.asarray(a.T, x.dtype) + action * jnp.asarray(b.T, x.dtype)
        world = PointWorld(Point(x), world.step + 1)
        return x, world, -cost, *outcome(self, jnp.zeros((), bool), world, jnp.abs(x[:, 0]))


class Cue(Untasked):
    """Cost (u - cue)^2 in every step, for a cue of 0.5 or -0.5 that is observed in the first step only, or in all.

    The cue is a number of the observation or the depth that an image shows. Who does not remember it pays at least 0.25
    in every step in which it is not shown.
    """

    drones, action_size, observation_size, dt, steps, constant_fields = 1, 1, 1, 0.1, 6, ()

    def __init__(self, shown: int = 1, image: bool = False):
        self.shown, self.vision = shown, image

    def begin(self, key):
        cue = jax.random.choice(key, jnp.array([-0.5, 0.5]), (1, 1))
        world = PointWorld(Point(cue), jnp.zeros((), jnp.int32))
        return self.vector(world), world

    def reset(self, key):
        _, world = self.begin(key)
        world = self.with_images(None, key, world)
        return observation(self.vector(world), world), world

    def step(self, key, world, action):
        cost = (action[:, 0] - world.drones.pos[:, 0]) ** 2
        world = self.with_images(None, key, world.replace(step=world.step + 1))
        obs = observation(self.vector(world), world)
        return obs, world, -cost, *outcome(self, jnp.zeros((), bool), world, jnp.sqrt(cost))

    def visible(self, world):
        return jnp.where(world.step < self.shown, world.drones.pos, 0)

    def vector(self, world):
        return jnp.zeros_like(world.drones.pos) if self.vision else self.visible(world)

    def with_images(self, look, key, world, *ended):
        depth = 3 + 4 * jnp.tile(self.visible(world)[..., None], (1, 3, 4))
        return world.replace(images={"depth": depth} if self.vision else {})


class Clock(Untasked):
    """A team that observes the time of its episode, which fails after one step half of the time, or lasts `steps`.

    Drone i is rewarded 1 + i in every step.
    """

    action_size, observation_size, dt, constant_fields, vision = 1, 1, 0.1, (), None

    def __init__(self, steps: int = 10, drones: int = 1):
        self.steps, self.drones = steps, drones

    def reset(self, key):
        fails = jnp.broadcast_to(jax.random.bernoulli(key), (self.drones, 1)).astype(float)
        return jnp.zeros((self.drones, 1)), PointWorld(Point(fails), jnp.zeros((), jnp.int32))

    begin = reset

    def step(self, key, world, action):
        world = world.replace(step=world.step + 1)
        reward = 1 + jnp.arange(self.drones, dtype=action.dtype) + 0 * action[:, 0]
        obs = jnp.full((self.drones, 1), world.step, action.dtype)
        return obs, world, reward, *outcome(self, world.drones.pos[0, 0] > 0, world, reward)


def outcome(env, terminated, world, error):
    """Ends of a team, and info."""
    truncated = world.step >= env.steps
    of_team = {"terminated": terminated, "truncated": truncated, "active": jnp.ones((), bool)}
    info = {name: jnp.broadcast_to(x, (env.drones,)) for name, x in of_team.items()}
    return terminated, truncated, info | {"metrics": {"error": error}}


def dynamics():
    dt = DoubleIntegrator.dt
    return np.array([[1, dt], [0, 1]]), np.array([[dt**2 / 2], [dt]])
