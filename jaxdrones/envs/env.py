"""Environments as two pure functions, `reset` and `step`."""

import dataclasses
import functools
import math
from collections.abc import Callable, Hashable
from typing import Any, Self

import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxdrones.arguments import Fraction, Key, checked
from jaxdrones.checks import check_shape, check_whole, is_concrete
from jaxdrones.engine.step import HostStep, Step, is_traced
from jaxdrones.envs import episode, randomize
from jaxdrones.envs.actions import Action
from jaxdrones.envs.disturbances import Disturbance, DisturbanceWithMemory, check_loads
from jaxdrones.envs.episode import in_full_precision
from jaxdrones.envs.functions import DrawScene, check_episode, check_process, scene_example
from jaxdrones.envs.observations import PrivilegedObservation, bounds, deviations, observe
from jaxdrones.envs.randomize import Noise, Randomization
from jaxdrones.envs.vision import ImageSpace, Vision, observation
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.sensing.sensor import Sensor, check_sensors
from jaxdrones.tasks.task import ObservationTerm, Task, World

RowSet = tuple[int, int, int, float]
"""First column of a set in an observation, number of rows, length of a row, and reach (m); see `ObservationTerm`."""
Obs = Any  # (n, d), or with cameras a dict of arrays with a leading drone axis


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Env:
    """`reset(key) -> obs, world` and `step(key, world, action) -> obs, world, reward, terminated, truncated, info`.

    Both are pure: use `jax.jit`, `jax.vmap` for many worlds, `jax.grad` on the explicit backend. Episodes do not reset
    automatically; see `AutoReset`. `jaxdrones.make` makes environments by name.

    An environment is immutable; `dataclasses.replace(env, steps=100)` makes a changed copy. It hashes and compares by
    identity, so it can be a static argument of `jax.jit`, and pickles by value.
    """

    task: Task
    params: Params
    """Nominal parameters of the team."""
    physics: Step
    """Step of either backend, for one control period."""
    _: dataclasses.KW_ONLY
    dt: float
    """Control period, s."""
    action: Action
    """Action type, fitted to the nominal parameters unless they are traced."""
    terms: tuple[ObservationTerm, ...]
    """Observation terms to concatenate."""
    randomize: tuple[Randomization, ...] = ()
    """Randomizations of the parameters of every episode."""
    noise: Noise | None = None
    """Noise of the observed state."""
    disturbance: Disturbance | None = None
    """Disturbance of wind or external force before every control step, for example `random_pushes`."""
    delay: tuple[float, float] = (0.0, 0.0)
    """Shortest and longest delay between action and command, s; drawn per drone and episode."""
    vision: Vision | None = None
    """Cameras from `jaxdrones.envs.vision.make_vision` for the same step and scene."""
    sensors: tuple[Sensor, ...] = ()
    """Sensors of every drone, read after `reset` and after every control step."""
    scene: Scene | DrawScene = dataclasses.field(default_factory=Scene)
    """Obstacles and ground, or a function `(key) -> Scene` for random scenes."""
    vehicle: str = "drones"
    """Name of the vehicle."""
    steps: int = 0
    """Number of control steps until an episode is truncated; 0 for the task's duration."""
    _task_steps: int = dataclasses.field(default=0, repr=False)
    """`steps` if it follows from the task's duration, and so from that of a task that replaces it."""

    def __post_init__(self):
        check_process()
        episode.check_period(self)
        check_sensors(self.sensors, self.dt)
        object.__setattr__(self, "delay", randomize.delay_bounds(self.delay, self.task.duration))
        of_team = [model.name for model in self.physics.physics.models if model.of_team]
        if of_team and self.task.ends == "drone":
            raise UserError(
                f"the model {of_team[0]!r} has a state of the whole team, and drones leave {self.task.name} one by "
                "one; give a task that ends for the whole team (ends='team')"
            )
        params = self.params
        if isinstance(self.disturbance, DisturbanceWithMemory):
            params = self.disturbance.nominal(params)
        if self.draws_delay:
            params = randomize.with_delay(params, sum(self.delay_steps) / 2)
        object.__setattr__(self, "params", params)
        if not is_traced(params):
            object.__setattr__(self, "action", self.action.fitted(params))
        if is_concrete(self.steps):
            check_whole("steps", self.steps, 0)
        if isinstance(self.steps, int) and self.steps in (0, self._task_steps):
            steps = round(float(self.task.duration) / self.dt) + self.task.extra_steps
            object.__setattr__(self, "steps", steps)
            object.__setattr__(self, "_task_steps", steps)

    def __reduce__(self):
        import cloudpickle  # tasks and randomizations are closures

        if isinstance(self.physics, HostStep):
            raise TypeError("an environment of Bullet does not pickle; make it in the process that flies it")
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return _unpickled, (cloudpickle.dumps(fields),)

    def __copy__(self) -> Self:
        return self

    def __deepcopy__(self, memo: dict) -> Self:
        return self

    def __repr__(self) -> str:
        backend = "bullet" if isinstance(self.physics, HostStep) else "explicit"
        seen = f"{self.observation_size} observations" + (f" and {self.vision}" if self.vision else "")
        team = f"{self.drones} x {self.vehicle}, dt {self.dt:.4g} s, {self.steps} steps"
        return f"<Env {self.task.name}: {team}, {self.action_size} actions and {seen} a drone, {backend} backend>"

    @property
    def drones(self) -> int:
        """Number of drones."""
        return self.task.drones

    @property
    def action_size(self) -> int:
        """Length of the action of one drone."""
        return self.action.size

    @property
    def delay_steps(self) -> tuple[float, float]:
        """Shortest and longest delay, control steps, robust to rounding."""
        steps = (bound / self.dt for bound in self.delay)
        shortest, longest = (float(round(x)) if math.isclose(x, round(x), abs_tol=1e-6) else x for x in steps)
        return shortest, longest

    @functools.cached_property
    def draws(self) -> tuple[Randomization, ...]:
        """All randomizations, including the start of a disturbance with memory and a random delay."""
        own: list[Randomization] = []
        if isinstance(self.disturbance, DisturbanceWithMemory):
            own.append(self.disturbance.starting())
        if self.draws_delay:
            own.append(randomize.drawn_delay(*self.delay_steps))
        return (*self.randomize, *own)

    @functools.cached_property
    def term_sizes(self) -> list[int]:
        """Length of every observation term of a drone."""
        episode.check_scene(self)
        first_world = functools.partial(episode.first_world, self)
        drawn, on_the_way = (self.draws, self.scene), (self.noise, self.disturbance)
        sizes = check_episode(self.task, self.params, *drawn, self.terms, self.dt, first_world, *on_the_way)
        random = jax.tree.unflatten(jax.tree.structure(self.params), self._drawn)
        check_loads(self.physics.physics, self.params, scene_example(self.scene), random, self.disturbance)
        return sizes

    @functools.cached_property
    def observation_bound(self) -> np.ndarray:
        """(d,) largest magnitude of every entry of the observation."""
        return bounds(self.terms, self.term_sizes)

    @property
    def sets(self) -> tuple[RowSet, ...]:
        """Sets in the observation."""
        starts = np.cumsum([0, *self.term_sizes]).tolist()
        terms = zip(self.terms, starts, self.term_sizes, strict=False)
        return tuple((at, term.rows, size // term.rows, term.reach) for term, at, size in terms if term.rows)

    @property
    def observation_size(self) -> int:
        """Length of the observation of one drone, without images."""
        return len(self.observation_bound)

    @property
    def image_spaces(self) -> dict[str, ImageSpace]:
        """Shape, dtype and bounds of every image of a drone, by name."""
        return self.vision.spaces(self.drones, scene_example(self.scene).count) if self.vision else {}

    @property
    def constant_fields(self) -> tuple[str, ...]:
        """Names of the fields of a world that are constant over episodes."""
        params = () if self.draws or self.disturbance else ("params",)
        return (*params, "scene") if isinstance(self.scene, Scene) else params

    @property
    def privileged_size(self) -> int:
        """Extra entries per drone in the privileged observation."""
        leaves = zip(jax.tree.leaves(self.params), self._drawn, strict=True)
        return sum(leaf.size for leaf, drawn in leaves if drawn) // self.drones

    @in_full_precision
    def reset(self, key: jax.Array, progress: Fraction = 1.0) -> tuple[Obs, World]:
        """First observation and world; `progress` is that of training in [0, 1], for a task with a curriculum."""
        obs, world = self.begin(key, progress)
        if self.vision:
            world = self.with_images("first", key, world)
        return observation(obs, world), world

    @checked
    @in_full_precision
    def begin(self, key: Key, progress: Fraction = 1.0) -> tuple[Float[Array, "n d"], World]:
        """`reset` without images."""
        _ = is_traced(self.params) or self.term_sizes  # checks functions that were replaced, such as a disturbance
        world = self.compiled(episode.start)(key, progress)
        rate = episode.state_rate(self, world, world.drones.rpm)
        return self.compiled(episode.first_observation)(key, world, rate)

    def with_images(self, method: str, key: jax.Array, world: World, *args: Any) -> World:
        """World with new images by a method of `Vision`, compiled unless it leaves JAX."""
        assert self.vision is not None
        look = getattr(self.vision, method)
        noise = jax.random.fold_in(key, episode.VISION) if self.vision.camera.noise else None
        return (look if self.vision.on_host else self._program(method, look))(noise, world, *args)

    @checked
    @in_full_precision
    def step(
        self, key: Key, world: World, action: Float[ArrayLike, "n a"]
    ) -> tuple[Obs, World, Float[Array, " n"], Array, Array, dict[str, Any]]:
        """One control step.

        Args:
            key: random key for noise and disturbances.
            world: from `reset` or `step`.
            action: (n, a), clipped to [-1, 1].

        Returns:
            The observation; the world; the reward (n,); terminated (), whether the episode ended in a terminal state;
            truncated (), whether it was cut off; and info (n,): `rewards`, `metrics`, `terminations` and `truncations`
            by name; `terminated` and `truncated`, whether the episode of each drone ended in this step; and `active`,
            whether it had not ended before. After its end the reward of a drone is zero, and its metrics have no
            meaning; see `Task.ends`.

        Raises:
            ValueError: no random key, a world of another task, a wrong shape, or numbers that are not finite (unless
                traced).
        """
        episode.check_world(self, world)
        shape = self.drones, self.action_size
        check_shape("action", action, shape, "one row of the action type's size per drone", finite=True)
        # A program without random keys can be a single kernel.
        key_of_draws = key if self.noise or self.disturbance or self.sensors else None
        world, rpm = self.compiled(episode.command)(key_of_draws, world, action)
        world = world.replace(drones=self.physics(world.params, world.drones, rpm, episode.scene_for_step(self, world)))
        obs, world, *outcome = self.compiled(episode.outcome)(key_of_draws, world, episode.state_rate(self, world, rpm))
        if self.vision:
            world = self.with_images("next", key, world)
        return observation(obs, world), world, *outcome

    def privileged_observation(self, world: World) -> PrivilegedObservation:
        """Privileged observation for a critic: the observation without noise, and the drawn parameters."""
        return PrivilegedObservation(
            observe(self.terms, self.task, world), deviations(world.params, self.params, self._drawn)
        )

    def compiled(self, function: Callable) -> Callable:
        """Compiled `function(env, ...)` with this environment, cached."""
        return self._program(function, functools.partial(function, self))

    def close(self) -> None:
        """Close the connection of the Bullet backend, if any."""
        if isinstance(self.physics, HostStep):
            self.physics.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def _program(self, name: Hashable, function: Callable) -> Callable:
        check_process()
        if name not in self._programs:
            self._programs[name] = jax.jit(function)
        return self._programs[name]

    @functools.cached_property
    def _programs(self) -> dict[Hashable, Callable]:
        return {}

    @property
    def draws_delay(self) -> bool:
        """Whether the delay is random."""
        return self.delay[0] < self.delay[1]

    @functools.cached_property
    def _drawn(self) -> list[bool]:
        return randomize.drawn_leaves(self.draws, self.params)


def _unpickled(fields: bytes) -> Env:
    import cloudpickle

    return Env(**cloudpickle.loads(fields))
