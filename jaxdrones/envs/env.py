"""An environment: a task, a step, an action type and an observation, as two pure functions."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxdrones.checks import (
    check_callable,
    check_finite,
    check_key,
    check_number,
    check_params,
    check_positive,
    check_sequence,
    check_shape,
    shown,
)
from jaxdrones.control import for_team
from jaxdrones.engine.step import HostStep, Step
from jaxdrones.envs.actions import Action
from jaxdrones.envs.randomize import Disturbance, Noise, Randomization, delayed, draw
from jaxdrones.envs.vision import Vision
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.tasks.task import Part, Task, World

DISTURB, NOISE, START, LAWS, RESET = range(5)  # what a key is folded with: only the draws that are used cost time

_MOST_STEPS = 1e9  # of an episode

Obs = Any  # (n, d), or with cameras a dict of arrays with a leading drone axis


class PrivilegedObservation(flax.struct.PyTreeNode):
    """Of a team, as no sensor shows it."""

    obs: Array
    """(n, d) the vector that would be observed without noise."""
    secrets: Array
    """(n, e) of the parameters that are drawn: deviations from their nominal values, as shares of the largest one."""


class Env:
    """`reset(key) -> obs, world` and `step(key, world, action) -> obs, world, reward, terminated, truncated, info`.

    Both are pure: use `jax.jit`, `jax.vmap` for many worlds, `jax.grad` on the explicit backend. Nothing is reset
    when an episode ends; `autoreset` does that.
    """

    def __init__(
        self,
        task: Task,
        params: Params,
        step: Step,
        *,
        dt: float,
        action: Action,
        observation: Sequence[Part],
        laws: Sequence[Randomization] = (),
        noise: Noise | None = None,
        disturb: Disturbance | None = None,
        delay: float = 0.0,
        vision: Vision | None = None,
        vehicle: str = "drones",
    ):
        """Put an environment together; `jaxdrones.make` does it by name.

        Args:
            task: what is to be done.
            params: nominal parameters of the team.
            step: of either backend, for one control period.
            dt: control period, s.
            action: action type.
            observation: parts that are put side by side.
            laws: draw the parameters of every episode from the nominal ones.
            noise: of the sensors.
            disturb: sets the surroundings before every control step: pushes.
            delay: between action and command, s.
            vision: cameras; only with the Bullet backend.
            vehicle: what the drones are, for people.

        Raises:
            ValueError: an argument of another kind, or a number out of range; says what to give.
        """
        _check_kinds(task, params, action)
        check_positive("dt", dt, "s")
        check_params(params)
        check_shape("params.mass", params.mass, (task.drones,), f"the task {task.name} has {task.drones} drones")
        check_number("delay", delay, "s, less than an episode", at_least=0, below=task.duration)
        parts = check_sequence("observation", observation, "OBSERVATIONS['position_error']")
        if not parts:
            raise ValueError("observation is empty; name at least one part")
        for part in parts:
            if not isinstance(part, Part):
                raise ValueError(f"observation: {shown(part)} is not a part; give a name or part of OBSERVATIONS")
        laws = check_sequence("laws", laws, "scaled('mass', 0.9, 1.1)")
        for law in laws:
            check_callable("laws", law, "scaled('mass', 0.9, 1.1)")
        if noise is not None:
            check_callable("noise", noise, "sensor_noise()")
        if disturb is not None:
            check_callable("disturb", disturb, "pushes(0.3)")
        self.task, self.params, self.dt, self.drones = task, params, dt, task.drones
        self.action, self.action_size = action.fitted(params), action.size
        self.steps = _steps(task, dt)
        self._parts, self._laws, self._noise, self._disturb = parts, laws, noise, disturb
        self.kept = () if laws or disturb else ("params",)
        """What of a world is the same in every episode."""
        self._delay = _nearly_whole(delay / dt)
        self._history = max(math.ceil(self._delay) + 1, *(part.history for part in observation))
        self.physics, self.vision, self._vehicle = step, vision, vehicle
        self._start, self._before, self._after = jax.jit(self._draw), jax.jit(self._commanded), jax.jit(self._outcome)
        widths = self._widths()
        bound = [np.broadcast_to(part.bound, (width,)) for part, width in zip(self._parts, widths, strict=True)]
        self.observation_bound = np.concatenate(bound).astype(np.float32)
        """(d,) largest magnitude of every entry of the observation."""
        self.observation_size = len(self.observation_bound)

    def __repr__(self) -> str:
        backend = "bullet" if isinstance(self.physics, HostStep) else "explicit"
        images = "".join(f" and {image}" for image in (self.vision.images if self.vision else ()))
        return (
            f"<Env {self.task.name}: {self.drones} x {self._vehicle}, dt {self.dt:.4g} s, {self.steps} steps, "
            f"{self.action_size} actions and {self.observation_size} observations{images} a drone, {backend} backend>"
        )

    def reset(self, key: jax.Array) -> tuple[Obs, World]:
        """The first observation, and the world at the start of an episode.

        Raises:
            ValueError: `key` is not one random key.
        """
        check_key("key", key)
        world, obs = self._start(key)
        if self.vision:
            world = world.replace(images=self.vision.look(world.params, world.drones))
        return self._seen(obs, world), world

    def step(
        self, key: jax.Array, world: World, action: Float[ArrayLike, "n a"]
    ) -> tuple[Obs, World, Float[Array, " n"], Array, Array, dict[str, Any]]:
        """One control step.

        Args:
            key: for noise and disturbances.
            world: as `reset` or `step` returned it.
            action: (n, a), cut to [-1, 1].

        Returns:
            The observation; the world; the reward (n,); terminated (), whether the episode ended for good; truncated
            (), whether it was cut; and info: `rewards` by name (n,), `metrics` by name (n,), `ends` by name ().

        Raises:
            ValueError: no random key, a wrong shape, or not a number (where it can be looked at).
        """
        check_key("key", key)
        check_shape("action", action, (self.drones, self.action_size), "one row of the action type's size per drone")
        check_finite("action", action)
        world, rpm = self._before(key, world, action)
        drones = self.physics(world.params, world.drones, rpm)
        obs, world, *outcome = self._after(key, world, drones)
        if self.vision:
            world = world.replace(images=self.vision.next(world))
        return self._seen(obs, world), world, *outcome

    def truth(self, world: World) -> PrivilegedObservation:
        """What a critic may know in training, and no policy in flight."""
        off = [_deviation(getattr(world.params, name), getattr(self.params, name)) for name in self._varied]
        secrets = [jnp.reshape(x, (self.drones, -1)) for x in off]
        return PrivilegedObservation(
            self._shown(world), jnp.concatenate([jnp.zeros((self.drones, 0)), *secrets], axis=-1)
        )

    @property
    def privileged_size(self) -> int:
        """Numbers that `truth` has of a drone beside its observation."""
        return sum(getattr(self.params, name).size for name in self._varied) // self.drones

    @functools.cached_property
    def _varied(self) -> list[str]:
        """Names of the parameters that a draw changes."""
        with jax.ensure_compile_time_eval():
            drawn = vars(draw(self._laws, jax.random.key(0), self.params))
            return [name for name, value in drawn.items() if jnp.any(value != getattr(self.params, name))]

    def close(self) -> None:
        """End the connection of a backend that has one."""
        if isinstance(self.physics, HostStep):
            self.physics.close()

    def __enter__(self) -> Env:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def _draw(self, key: jax.Array) -> tuple[World, Array]:
        """The world at the start of an episode, and what is observed of it."""
        params = draw(self._laws, jax.random.fold_in(key, LAWS), self.params)
        drones, variables = self.task.start(jax.random.fold_in(key, START), self.params)
        world = World(
            params=params,
            drones=drones,
            variables=variables,
            memory=for_team(self.action.init(), self.drones),
            actions=jnp.zeros((self.drones, self._history, self.action_size), drones.pos.dtype),
            step=jnp.zeros((), jnp.int32),
            dt=self.dt,
        )
        return world, self._observe(jax.random.fold_in(key, NOISE), world)

    def _commanded(self, key: jax.Array, world: World, action: Array) -> tuple[World, Array]:
        """What the rotors are commanded, and the surroundings they meet."""
        action = jnp.clip(jnp.asarray(action, world.actions.dtype), -1, 1)
        actions = jnp.concatenate([world.actions[:, 1:], action[:, None]], axis=1)
        params = world.params
        if self._disturb:
            params = self._disturb(jax.random.fold_in(key, DISTURB), params, self.dt)
        world = world.replace(actions=actions, params=params)
        target = self.task.target_now(world)

        def fly(params, memory, state, action, setpoint):
            return self.action.rpm(params, memory, state, action, setpoint, self.dt)

        command = delayed(actions, self._delay)
        memory, rpm = jax.vmap(fly)(self.params, world.memory, world.drones, command, target)
        return world.replace(memory=memory), rpm

    def _outcome(self, key: jax.Array, world: World, drones: State):
        """What came of it."""
        task = self.task
        world = world.replace(drones=drones, step=world.step + 1)
        world = world.replace(variables=task.advance(world))
        rewards = {name: scale * term(world) for name, (scale, term) in task.rewards.items()}
        ends = {name: jnp.any(condition(world)) for name, condition in task.ends.items()}
        limits = {name: jnp.any(condition(world)) for name, condition in task.limits.items()}
        metrics = task.measure(world)
        terminated = _any(ends.values())
        truncated = _any(limits.values()) | (world.step >= self.steps)
        info = {"rewards": rewards, "metrics": metrics, "ends": ends | limits}
        obs = self._observe(jax.random.fold_in(key, NOISE), world)
        return obs, world, sum(rewards.values()), terminated, truncated, info

    def _observe(self, key: jax.Array, world: World) -> Array:
        if self._noise:
            world = world.replace(drones=self._noise(key, world.drones))
        return self._shown(world)

    def _shown(self, world: World) -> Array:
        parts = [part.observe(self.task, world) for part in self._parts]
        return jnp.concatenate([_cut(x, part.bound) for x, part in zip(parts, self._parts, strict=True)], axis=-1)

    def _widths(self) -> list[int]:
        def parts(key):
            world, _ = self._draw(key)
            return [part.observe(self.task, world) for part in self._parts]

        return [x.shape[-1] for x in jax.eval_shape(parts, jax.random.key(0))]

    def _seen(self, obs: Array, world: World) -> Obs:
        return obs if self.vision is None else {"state": obs, **world.images}


def _check_kinds(task: Task, params: Params, action: Action) -> None:
    for name, given, kind in ("task", task, Task), ("params", params, Params), ("action", action, Action):
        if not isinstance(given, kind):
            raise ValueError(f"{name} is {shown(given)}; give an object of {kind.__name__}, or use jaxdrones.make")


def _steps(task: Task, dt: float) -> int:
    """Control steps of an episode, which are counted by an integer of 32 bits."""
    steps = task.duration / dt
    if not 0.5 < steps < _MOST_STEPS:
        raise ValueError(
            f"duration is {task.duration} s, {steps:.3g} control steps of {dt:.4g} s; give 1 to {_MOST_STEPS:.0e}"
        )
    return round(steps) + task.overtime


def _deviation(value: Array, nominal: Array) -> Array:
    """As a share of the largest magnitude of the nominal one; of none, as it is."""
    largest = jnp.max(jnp.abs(nominal))
    return (value - nominal) / jnp.where(largest > 0, largest, 1)


def _any(conditions) -> Array:
    return functools.reduce(jnp.logical_or, conditions, jnp.zeros((), bool))


def _cut(x: Array, bound: float | tuple[float, ...]) -> Array:
    limit = jnp.broadcast_to(jnp.asarray(bound, x.dtype), x.shape[-1:])[None]
    return jnp.clip(x, -limit, limit)


def _nearly_whole(steps: float) -> float:
    """Control steps of a delay; 0.02 s at 100 Hz are two, whatever the rounding."""
    return float(round(steps)) if math.isclose(steps, round(steps), abs_tol=1e-6) else steps
