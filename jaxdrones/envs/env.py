"""An environment: a task, a step, an action type and an observation, as two pure functions."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxdrones.checks import check_finite, check_key, check_shape
from jaxdrones.engine.step import HostStep, Step
from jaxdrones.envs import randomize as draws
from jaxdrones.envs.action import Action
from jaxdrones.envs.arguments import check_draws, check_team, check_terms, delay_steps, episode_steps
from jaxdrones.envs.construction import Constructed, constructed
from jaxdrones.envs.functions import check_episode
from jaxdrones.envs.observations import bounds, observe
from jaxdrones.envs.privileged import PrivilegedObservation, deviations
from jaxdrones.envs.process import check_process
from jaxdrones.envs.surroundings import DrawScene, check_scene, scene_for_step
from jaxdrones.envs.vision import ImageSpace, Vision, first_images, next_images, observation
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.sensing.sensor import Sensor, check_sensors, hold_between, init_sensors, measure_sensors
from jaxdrones.state import State
from jaxdrones.tasks.task import ObservationTerm, Task, World

DISTURBANCE, NOISE, START, RANDOMIZE, RESET, SENSORS, SCENE, VISION = range(8)
"""Random streams: what a key is folded with, so that only the draws that are used cost time."""

Obs = Any  # (n, d), or with cameras a dict of arrays with a leading drone axis
Key = Any  # a random key; `None` where nothing is drawn


class Env(Constructed):
    """`reset(key) -> obs, world` and `step(key, world, action) -> obs, world, reward, terminated, truncated, info`.

    Both are pure: use `jax.jit`, `jax.vmap` for many worlds, `jax.grad` on the explicit backend. Nothing is reset
    when an episode ends; `AutoReset` does that. A copy (`copy.copy`) is an environment of its own, whose attributes,
    such as `steps`, may be set without changing the original; on Bullet both share one connection. Environments pickle,
    compare and hash by the arguments they were made with (functions by identity), so that they may be static arguments
    of `jax.jit`; those of Bullet are equal only to themselves.
    """

    def __init__(
        self,
        task: Task,
        params: Params,
        step: Step,
        *,
        dt: float,
        action: Action,
        observation: Sequence[ObservationTerm],
        randomize: Sequence[draws.Randomization] = (),
        noise: draws.Noise | None = None,
        disturbance: draws.Disturbance | None = None,
        delay: float | tuple[float, float] = 0.0,
        vision: Vision | None = None,
        sensors: Sequence[Sensor] = (),
        scene: Scene | DrawScene | None = None,
        vehicle: str = "drones",
    ):
        """Put an environment together; `jaxdrones.make` does it by name.

        Args:
            task: the task.
            params: nominal parameters of the team.
            step: step of either backend, for one control period.
            dt: control period, s.
            action: action type.
            observation: terms that are concatenated.
            randomize: randomizations that draw the parameters of every episode from the nominal ones.
            noise: noise of the observed state.
            disturbance: sets the surroundings before every control step, for example `random_pushes`.
            delay: delay between action and command, s; or the shortest and the longest of all drones and episodes.
            vision: cameras, as `jaxdrones.envs.vision.make_vision` returns them for the same step and scene.
            sensors: sensors of every drone, which measure after `reset` and after every control step.
            scene: obstacles and ground, or a function `(key) -> Scene` that draws them for every episode; the task's
                when left out.
            vehicle: name of the vehicle, for people.

        Raises:
            ValueError: an argument of another kind, or a number out of range; says what to give.
        """
        check_process()
        check_team(task, params, action, dt)
        terms, randomize = check_terms(observation), check_draws(randomize, noise, disturbance)
        self.delay = delay_steps(task, delay, dt)  # shortest and longest, control steps
        params, randomize = draws.prepared(disturbance, self.delay, params, randomize)
        self.scene = task.scene if scene is None else scene
        """Obstacles and ground, or the function that draws them."""
        obstacles = check_scene(self.scene, step, task)
        self.task, self.params, self.dt, self.drones = task, params, dt, task.drones
        self.action, self.action_size = action.fitted(params), action.size
        self.physics, self.vision, self.vehicle = step, vision, vehicle
        self.image_spaces: dict[str, ImageSpace] = vision.spaces(task.drones, obstacles) if vision else {}
        """Shape, dtype and bounds of every image of a drone, by name."""
        self.steps = episode_steps(task, dt)
        """Number of control steps after which an episode is truncated."""
        self.sensors = check_sensors(sensors, dt)
        self.terms, self.randomize, self.noise, self.disturbance = terms, randomize, noise, disturbance
        self._history = max(math.ceil(self.delay[1]) + 1, *(term.history for term in terms))
        self._drawn = draws.drawn_leaves(randomize, params)
        self.term_sizes = check_episode(task, params, self.scene, terms, dt, self._first_world)
        self.observation_bound = bounds(terms, self.term_sizes)
        """(d,) largest magnitude of every entry of the observation."""
        self.observation_size = len(self.observation_bound)
        constructed(self)

    @property
    def _key(self) -> Any:
        return id(self) if isinstance(self.physics, HostStep) else super()._key  # a connection is no other's

    def __repr__(self) -> str:
        backend = "bullet" if isinstance(self.physics, HostStep) else "explicit"
        seen = f"{self.observation_size} observations" + (f" and {self.vision}" if self.vision else "")
        team = f"{self.drones} x {self.vehicle}, dt {self.dt:.4g} s, {self.steps} steps"
        return f"<Env {self.task.name}: {team}, {self.action_size} actions and {seen} a drone, {backend} backend>"

    @property
    def constant_fields(self) -> tuple[str, ...]:
        """Names of the fields of a world that are the same in every episode."""
        params = () if self.randomize or self.disturbance else ("params",)
        return (*params, "scene") if isinstance(self.scene, Scene) else params

    @property
    def privileged_size(self) -> int:
        """How many numbers of a drone a privileged observation has beside the observation."""
        leaves = zip(jax.tree.leaves(self.params), self._drawn, strict=True)
        return sum(leaf.size for leaf, drawn in leaves if drawn) // self.drones

    def reset(self, key: jax.Array) -> tuple[Obs, World]:
        """The first observation, and the world at the start of an episode.

        Raises:
            ValueError: `key` is not one random key.
        """
        obs, world = self.begin(key)
        if self.vision:
            world = self.with_images(first_images, key, world)
        return observation(obs, world), world

    def begin(self, key: jax.Array) -> tuple[Float[Array, "n d"], World]:
        """The same as `reset`, but without images."""
        check_key("key", key)
        world = self.compiled(Env._start)(key)
        rate = self._rate(world, world.drones.rpm)
        return self.compiled(Env._first_observation)(key, world, rate)

    def with_images(self, look: Callable[..., World], key: jax.Array, world: World, *args: Any) -> World:
        """`look(env, key, world, *args)`, which gives the world new images, compiled unless it leaves JAX."""
        assert self.vision is not None
        noise = jax.random.fold_in(key, VISION) if self.vision.camera.noise else None
        return (functools.partial(look, self) if self.vision.on_host else self.compiled(look))(noise, world, *args)

    def step(
        self, key: jax.Array, world: World, action: Float[ArrayLike, "n a"]
    ) -> tuple[Obs, World, Float[Array, " n"], Array, Array, dict[str, Any]]:
        """One control step.

        Args:
            key: random key for noise and disturbances.
            world: as `reset` or `step` returned it.
            action: (n, a), clipped to [-1, 1].

        Returns:
            The observation; the world; the reward (n,); terminated (), whether the episode ended for good; truncated
            (), whether it was cut; and info: `rewards` and `metrics` by name (n,), `terminations` and `truncations`
            by name ().

        Raises:
            ValueError: no random key, a wrong shape, or numbers that are not finite (where they can be looked at).
        """
        check_key("key", key)
        check_shape("action", action, (self.drones, self.action_size), "one row of the action type's size per drone")
        check_finite("action", action)
        # A program without random keys can be a single kernel.
        key_of_draws: Key = key if self.noise or self.disturbance or self.sensors else None
        world, rpm = self.compiled(Env._command)(key_of_draws, world, action)
        drones = self.physics(world.params, world.drones, rpm, scene_for_step(self.physics, self.scene, world))
        world = world.replace(drones=drones)
        obs, world, *outcome = self.compiled(Env._outcome)(key_of_draws, world, self._rate(world, rpm))
        if self.vision:
            world = self.with_images(next_images, key, world)
        return observation(obs, world), world, *outcome

    def privileged_observation(self, world: World) -> PrivilegedObservation:
        """What a critic may know in training: the observation without noise, and the drawn parameters."""
        return PrivilegedObservation(
            observe(self.terms, self.task, world), deviations(world.params, self.params, self._drawn)
        )

    def compiled(self, function: Callable) -> Callable:
        """`function(env, ...)` with this environment, compiled once until one of its attributes is set."""
        check_process()
        programs = vars(self)["_programs"]
        if function not in programs:
            programs[function] = jax.jit(functools.partial(function, self))
        return programs[function]

    def close(self) -> None:
        """End the connection of a backend that has one."""
        if isinstance(self.physics, HostStep):
            self.physics.close()

    def __enter__(self) -> Env:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def _start(self, key: jax.Array) -> World:
        """The world at the start of an episode, before the first measurement."""
        params = draws.draw(self.randomize, jax.random.fold_in(key, RANDOMIZE), self.params)
        scene = self.scene if isinstance(self.scene, Scene) else self.scene(jax.random.fold_in(key, SCENE))
        known = draws.scaling_params(self.randomize, params, self.params)
        drones, variables = self.task.begin(jax.random.fold_in(key, START), known, scene)
        return World(
            params=params,
            drones=self.physics.init(params, drones),
            variables=variables,
            memory=self.action.team_memory(self.drones),
            actions=jnp.zeros((self.drones, self._history, self.action_size), drones.pos.dtype),
            step=jnp.zeros((), jnp.int32),
            dt=self.dt,
            scene=scene,
        )

    def _first_observation(self, key: jax.Array, world: World, rate: State | None) -> tuple[Array, World]:
        """The observation at the start of an episode, and the world with the first readings."""
        if rate is not None:
            world = self._measured_first(key, world, rate)
        return self._noisy_observation(key, world), world

    def _measured_first(self, key: jax.Array, world: World, rate: State) -> World:
        """The world with the first readings of the sensors."""
        init_key, measure_key = jax.random.split(jax.random.fold_in(key, SENSORS))
        world = world.replace(sensors=init_sensors(self.sensors, init_key, world.params))
        return self._measured(measure_key, world, rate)

    def _rate(self, world: World, rpm: Array) -> State | None:
        """The time derivative of the state for the sensors, if there are any."""
        if not self.sensors:
            return None
        return self.physics.rate(world.params, world.drones, rpm, scene_for_step(self.physics, self.scene, world))

    def _measured(self, key: jax.Array, world: World, rate: State) -> World:
        """The world with new readings of the sensors."""
        after = measure_sensors(self.sensors, key, world.params, world.drones, rate, world.scene, world.sensors)
        sensors, readings = hold_between(self.sensors, world.step, self.dt, (world.sensors, world.readings), after)
        return world.replace(sensors=sensors, readings=readings)

    def _command(self, key: Key, world: World, action: Array) -> tuple[World, Array]:
        """The world with the new action and disturbance, and the commanded rotor speeds."""
        action = jnp.clip(jnp.asarray(action, world.actions.dtype), -1, 1)
        actions = jnp.concatenate([world.actions[:, 1:], action[:, None]], axis=1)
        params = world.params
        if self.disturbance:
            params = self.disturbance(jax.random.fold_in(key, DISTURBANCE), params, self.dt)
        world = world.replace(actions=actions, params=params)

        def of_drone(params, memory, state, action, setpoint):
            return self.action.rpm(params, memory, state, action, setpoint, self.dt)

        flown = draws.delayed(actions, draws.delay_of(params, self.delay)), self.task.target_now(world)
        known = draws.scaling_params(self.randomize, params, self.params)
        memory, rpm = jax.vmap(of_drone)(known, world.memory, world.drones, *flown)
        return world.replace(memory=memory), rpm

    def _outcome(self, key: Key, world: World, rate: State | None):
        """Observation, world, reward and the rest of what `step` returns, from the world with the state after it."""
        task = self.task
        world = world.replace(step=world.step + 1)
        if rate is not None:
            world = self._measured(jax.random.fold_in(key, SENSORS), world, rate)
        world = world.replace(variables=task.advance(task, world))
        rewards = {name: scale * term(task, world) for name, (scale, term) in task.rewards.items()}
        terminations, truncations = (
            {name: jnp.any(condition(task, world)) for name, condition in conditions.items()}
            for conditions in (task.terminations, task.truncations)
        )
        terminated = functools.reduce(jnp.logical_or, terminations.values(), jnp.zeros((), bool))
        truncated = functools.reduce(jnp.logical_or, truncations.values(), world.step >= self.steps)
        info = dict(rewards=rewards, metrics=task.measure(world), terminations=terminations, truncations=truncations)
        obs = self._noisy_observation(key, world)
        return obs, world, sum(rewards.values()), terminated, truncated, info

    def _noisy_observation(self, key: Key, world: World) -> Array:
        if self.noise:
            world = world.replace(drones=self.noise(jax.random.fold_in(key, NOISE), world.drones))
        return observe(self.terms, self.task, world)

    def _first_world(self, key: jax.Array) -> World:
        """The world at the start of an episode, with the first readings."""
        rate = self._rate(world := self._start(key), world.drones.rpm)
        return world if rate is None else self._measured_first(key, world, rate)
