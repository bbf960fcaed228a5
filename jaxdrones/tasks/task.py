"""`Task`: start, target, rewards and terminations of an episode."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdrones import arguments, rotation, vector
from jaxdrones.arguments import checked
from jaxdrones.checks import bind, check_choice, check_function, check_number, short_repr
from jaxdrones.control import Setpoint
from jaxdrones.dynamics.model import Model
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.quantity import Quantity, check_quantities
from jaxdrones.sensing import Camera, Scene
from jaxdrones.state import State
from jaxdrones.vector import safe_sqrt
from jaxdrones.wrench import Wrench


class World(PyTreeNode):
    """Complete state of an episode between two control steps. Arrays of the team have a leading drone axis."""

    params: Params
    """Parameters of the team in this episode; hidden from action types and policies."""
    drones: State
    """State of the team."""
    variables: Any
    """Variables of the task, for example goals, the next gate or a random curve."""
    memory: Any
    """Memory of the action type's controller."""
    actions: Array
    """(n, h, a) last h actions, newest last; initially zero."""
    step: Array
    """() number of control steps since the start."""
    active: Array
    """(n,) whether each drone is still in the world, always with `Task.ends` of `team`."""
    dt: float = flax.struct.field(pytree_node=False)
    """Control period, s."""
    scene: Scene = flax.struct.field(default_factory=Scene)
    """Obstacles and ground of this episode."""
    sensors: dict[str, Any] = flax.struct.field(default_factory=dict)
    """Memories of the sensors, by name."""
    readings: dict[str, Any] = flax.struct.field(default_factory=dict)
    """Latest readings of the sensors by name: arrays, or pytrees of arrays."""
    images: dict[str, Array] = flax.struct.field(default_factory=dict)
    """Latest camera images by name, those of `jaxdrones.make(vision=...)`."""
    poses: Any = None
    """(k, n, 7) poses at the last k control steps, oldest first, for images that are not yet observed."""
    task: str = flax.struct.field(pytree_node=False, default="")
    """Name of the task."""

    @property
    def time(self) -> Array:
        """() time since the start, s."""
        return self.step * jnp.asarray(self.dt, self.drones.pos.dtype)

    @property
    def action(self) -> Array:
        """(n, a) newest action."""
        return self.actions[:, -1]


Entries = tuple[Quantity, ...] | Callable[[int, tuple[Quantity, ...]], tuple[Quantity, ...]]
"""Quantities, or a function (number of drones, quantities of an action) -> quantities."""
Effect = Callable[..., Wrench]
"""Effect on one drone, `(params, state) -> Wrench`."""
Randomization = Callable[[jax.Array, Params], Params]
"""(key, params) of one drone -> its parameters in an episode."""
CONTACTS = ("ground", "drones", "obstacles")
IMAGES = ("rgb", "depth", "segmentation")
Drones = Annotated[int, arguments.whole("number of drones of {function}")]  # argument of a task
Team = Annotated[int, arguments.whole("number of drones of {function}", 2)]
_OF_A_WORLD = ("task", "world")
_OBSERVE = arguments.function("", _OF_A_WORLD, "observe of an ObservationTerm")
_OBSERVATION = ("position_error", "rotation_matrix", "velocity_error", "omega", "last_action")


@checked
@dataclasses.dataclass(frozen=True)
class ObservationTerm:
    """One term of an observation."""

    observe: Annotated[Callable[[Task, World], Float[Array, "n d"]], _OBSERVE]
    """(task, world with the measured state) -> entries of every drone."""
    bound: float | tuple[float, ...]
    """Largest magnitude, of all entries or of each, for clipping."""
    history: Annotated[int, arguments.whole("history of an observation")] = 2
    """Number of past actions in the term."""
    entries: Entries = ()
    """Description of each entry of a drone, for `jaxdrones.explain`; optional."""
    name: str = ""
    """Name of the term, set by `jaxdrones.make`."""
    rows: arguments.NonNegativeInt = 0
    """Number of rows of equal length, side by side, of a set whose order has no meaning; 0 for a vector. A row begins
    with a position relative to the drone, m."""
    reach: Annotated[float, arguments.number("m", above=0, infinite=True)] = math.inf
    """Distance beyond which a row has no effect, m."""

    def __post_init__(self):
        for bound in self.bound if isinstance(self.bound, tuple) else (self.bound,):
            check_number("bound of an observation", bound, above=0, infinite=True)
        if not callable(self.entries):
            check_quantities("entries of an ObservationTerm", self.entries)


@checked
@dataclasses.dataclass(frozen=True)
class Task:
    """Start, target, rewards and terminations of an episode, as functions of one world.

    Rewards, conditions and metrics are functions `(task, world)`. The task is that of the environment, so
    `task.target_now(world)` is its target, also after `dataclasses.replace`.

    By default an episode belongs to the whole team: it ends when a condition is true for one drone. See `ends`.
    """

    name: str
    summary: str
    drones: Annotated[int, arguments.whole("number of drones of a task")]
    duration: arguments.Seconds
    """Time after which an episode is truncated, s."""
    start: Callable[..., tuple[State, Any]]
    """(key, params) -> initial state of the team, and the task's variables. Optional parameters are `scene` and
    `progress`, the progress of training in [0, 1], which is 1 outside of training."""
    target: Callable[[Any, Array], Setpoint]
    """(variables, time in s) -> set-points of the team; the time may be in the future."""
    rewards: Mapping[str, tuple[float, Term]]
    """Name -> (scale, term); the reward is the sum of scale times term."""
    terminations: Mapping[str, Condition] = dataclasses.field(default_factory=dict)
    """Name -> condition that terminates the episode in a state without future value."""
    truncations: Mapping[str, Condition] = dataclasses.field(default_factory=dict)
    """Name -> condition that truncates the episode."""
    ends: Annotated[str, arguments.choice("ends", ("team", "drone"))] = "team"
    """Episode that a condition ends: that of the `team`, or that of one `drone`, which leaves the world while the
    others continue: it is far away, and not in `World.active`."""
    advance: Callable[[Task, World], Any] = lambda task, world: world.variables
    """(task, world after a step with the variables before it) -> variables of the task after the step."""
    metrics: Mapping[str, Term] = dataclasses.field(default_factory=dict)
    """Reported quantities without reward, beside the `error` (m) and `speed` (m/s) of every task."""
    success: Callable[[Mapping[str, Array], float], Array] | None = None
    """(metrics over an episode (T, n), control period) -> (n,): success of every drone. Metrics keep their last values
    after the end of an episode. An episode that ends with a failure is not a success. With `ends="team"` all drones
    must succeed."""
    success_terminations: Annotated[tuple[str, ...], arguments.sequence("'reached'")] = ()
    """Names of the terminations that are not failures, such as a reached goal. All other terminations, and all
    truncations except the time limit, are failures."""
    observations: Mapping[str, ObservationTerm] = dataclasses.field(default_factory=dict)
    """Observation terms of this task by name."""
    randomize: Annotated[tuple[Randomization, ...], arguments.sequence("scaled('mass', 0.9, 1.1)")] = ()
    """Randomizations of the task: (key, params) of one drone -> its parameters in an episode."""
    effects: Annotated[tuple[Effect, ...], arguments.sequence("jaxdrones.cable")] = ()
    """Effects of the task's physics, in addition to those of `jaxdrones.make`."""
    models: Annotated[tuple[Model, ...], arguments.sequence("jaxdrones.payload()")] = ()
    """Models of the task's physics, in addition to those of `jaxdrones.make`."""
    equip: Callable[[Params], Params] = lambda params: params
    """(parameters of the team) -> the same with constants of the task's models, such as a load."""
    control_hz: arguments.Hertz = 100.0
    """Default control steps per second."""
    substeps: arguments.Count = 5
    """Default physics steps per control step."""
    scene: Scene | Callable[[jax.Array], Scene] = dataclasses.field(default_factory=Scene)
    """Obstacles and ground, or a function `(key) -> Scene` that draws them for every episode."""
    obstacles_terminate: arguments.Switch = False
    """Whether a hit of an obstacle terminates the episode, so that contact forces are not needed."""
    camera: Camera | None = None
    """Default camera of every drone; `None` for `Camera()`."""
    vision: Annotated[tuple[str, ...], arguments.choices("image", IMAGES, "'depth'")] = ()
    """Names of the default images."""
    contact: Annotated[tuple[str, ...], arguments.choices("contact", CONTACTS, "'ground'")] = ()
    """Contact forces of the explicit backend: `ground`, `drones`, `obstacles` (unless `obstacles_terminate`)."""
    pairs: tuple[str, ...] = ()
    """Names of the default pair effects."""
    action: str = "rpm"
    """Name of the default action type."""
    observation: Annotated[tuple[str, ...], arguments.sequence("'position_error'")] = _OBSERVATION
    """Names of the default observation terms."""
    extra_steps: arguments.NonNegativeInt = 0
    """Control steps of an episode after `duration`; 2 in gym-pybullet-drones, which checks the time before a step."""

    def __post_init__(self):
        kinds = {"name": str, "summary": str, "camera": Camera | None}
        for (name, kind), what in zip(kinds.items(), ("string", "string", "Camera"), strict=True):
            if not isinstance(x := getattr(self, name), kind) or x == "":
                raise UserError(f"{name} of the task is {short_repr(x)}; give a {what}")
        for field, function, names in self._functions():
            check_function(field, function, names)
        for name in {*self.truncations}.intersection({*self.terminations, "time"}):
            raise UserError(f"truncations has {name!r}, the name of another end of the episode; give it another name")
        for name in self.success_terminations:
            check_choice("success termination", name, self.terminations)
        for name, term in _mapping("observations", self.observations, "an ObservationTerm").items():
            if not isinstance(term, ObservationTerm):
                raise UserError(f"observations[{name!r}] is {short_repr(term)}; give an ObservationTerm")

    def _functions(self) -> Iterator[tuple[str, Any, tuple[str, ...]]]:
        """Name, value and arguments of every function of the task."""
        yield "start", bind(self.start, scene=None, progress=1.0), ("key", "params")
        yield "equip", self.equip, ("params",)
        yield "target", self.target, ("variables", "time")
        yield "advance", self.advance, _OF_A_WORLD
        if self.success is not None:
            yield "success", self.success, ("metrics", "dt")
        if not isinstance(self.scene, Scene):
            yield "scene", self.scene, ("key",)
        yield from (("randomize", function, ("key", "params")) for function in self.randomize)
        for name, entry in _mapping("rewards", self.rewards, "(scale, function of (task, world))").items():
            if not (isinstance(entry, tuple | list) and len(entry) == 2):
                raise UserError(f"rewards[{name!r}] is {short_repr(entry)}; give (scale, function of (task, world))")
            check_number(f"scale of the reward {name!r}", entry[0])
            yield f"rewards[{name!r}]", entry[1], _OF_A_WORLD
        if not self.rewards:
            raise UserError("rewards is empty; give at least one, name: (scale, function of (task, world))")
        for field in "terminations", "truncations", "metrics":
            for name, function in _mapping(field, getattr(self, field), "a function of (task, world)").items():
                yield f"{field}[{name!r}]", function, _OF_A_WORLD

    def begin(self, key: jax.Array, params: Params, scene: Scene, progress: Any = 1.0) -> tuple[State, Any]:
        """Initial state of the team in a scene, and the task's variables."""
        return bind(self.start, scene=scene, progress=jnp.asarray(progress, jnp.float32))(key, params)

    def measure(self, world: World) -> dict[str, Float[Array, " n"]]:
        """All metrics by name; the task's metrics override standard ones."""
        standard = {"error": distance(self, world), "speed": norm(world.drones.vel)}
        return standard | {name: metric(self, world) for name, metric in self.metrics.items()}

    def succeeded(self, metrics: Mapping[str, Array], ends: Mapping[str, Array], dt: float) -> Bool[Array, " n"]:
        """Whether a drone, or with `ends="team"` every drone, met the criterion of success without a failure.

        `metrics` (T, n) are those over the longest possible episode, with their last values after its end; `ends` (n,)
        are, by name, the terminations and truncations in the last step of each drone's episode; `dt` is the control
        period, s.
        """
        assert self.success is not None, "the task has no criterion of success"
        succeeded = self.success(metrics, dt)
        for name, ended in ends.items():
            if name not in self.success_terminations:
                succeeded &= ~jnp.asarray(ended)
        return self.shared(jnp.all, succeeded)

    def shared(self, reduce: Callable[[Array], Array], x: Bool[Array, " n"]) -> Bool[Array, " n"]:
        """With `ends="team"` the reduction of x over the drones, repeated for each of them; else x."""
        return jnp.broadcast_to(reduce(x), x.shape) if self.ends == "team" else x

    def target_now(self, world: World) -> Setpoint:
        """Current set-points of the team."""
        return self.target(world.variables, world.time)


def _mapping(field: str, value: Any, example: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping) or not all(isinstance(name, str) for name in value):
        raise UserError(f"{field} is {short_repr(value)}; give a dictionary of names, {{'name': {example}}}")
    return value


Term = Callable[[Task, World], Float[Array, " n"]]
"""Number for every drone: a reward or a metric."""
Condition = Callable[[Task, World], Bool[Array, " n"]]
"""Boolean for every drone."""


def norm(v: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Length of every row, with a zero gradient at zero."""
    return safe_sqrt(jax.vmap(vector.dot)(v, v))


def square(v: Float[Array, "n k"]) -> Float[Array, " n"]:
    """Squared length of every row."""
    return jax.vmap(vector.dot)(v, v)


def distance(task: Task, world: World) -> Float[Array, " n"]:
    """Distance of every drone from its target, m."""
    return norm(world.drones.pos - task.target_now(world).pos)


def upright(task: Task, world: World) -> Float[Array, " n"]:
    """Cosine of the tilt: 1 is level, 0 on edge, -1 upside down."""
    return jax.vmap(rotation.z_axis)(world.drones.quat)[:, 2]
