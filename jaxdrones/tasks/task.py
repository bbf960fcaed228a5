"""What a task is: what to start from, where to be, what is rewarded, when it ends."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdrones import rotation, vector
from jaxdrones.checks import check_choice, check_number, check_positive, check_sequence, check_whole
from jaxdrones.control import Setpoint
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.state import State
from jaxdrones.vector import safe_sqrt


class World(flax.struct.PyTreeNode):
    """All there is between two control steps of an episode. Arrays of the team have a leading drone axis."""

    params: Params
    """Of the team, as drawn for this episode; action types and policies do not see it."""
    drones: State
    variables: Any
    """The task's own: goals, the next gate, a random curve."""
    memory: Any
    """Of the action type's controller."""
    actions: Array
    """(n, h, a) the last h actions, the newest last; zeros before the first."""
    step: Array
    """() control steps since the start."""
    dt: float = flax.struct.field(pytree_node=False)
    """Control period, s."""
    images: Any = None
    """What the cameras saw last, if there are any."""

    @property
    def time(self) -> Array:
        """() s since the start."""
        return self.step * jnp.asarray(self.dt, self.drones.pos.dtype)

    @property
    def action(self) -> Array:
        """(n, a) the newest action."""
        return self.actions[:, -1]


SPINNING = 100.0  # rad/s; a drone that turns faster is lost
CONTACTS = ("ground", "drones")

Term = Callable[[World], Float[Array, " n"]]
Condition = Callable[[World], Bool[Array, " n"]]


@dataclasses.dataclass(frozen=True)
class Part:
    """One part of an observation."""

    observe: Callable[[Task, World], Float[Array, "n d"]]
    """Of the world as the sensors show it."""
    bound: float | tuple[float, ...]
    """Largest magnitude, of all entries or of each; what is beyond is cut off."""
    history: int = 2
    """Past actions that must be kept for it."""

    def __post_init__(self):
        for bound in self.bound if isinstance(self.bound, tuple) else (self.bound,):
            check_number("bound of an observation", bound, above=0)
        check_whole("history of an observation", self.history)


@dataclasses.dataclass(frozen=True)
class Task:
    """What to start from, where to be, what is rewarded, when it ends; all functions of one world.

    An episode is the whole team's: it ends when an end is true for one drone.
    """

    name: str
    summary: str
    drones: int
    duration: float
    """s, after which an episode is truncated."""
    start: Callable[[jax.Array, Params], tuple[State, Any]]
    """(key, params) -> the team at the start, and the task's variables."""
    target: Callable[[Any, Array], Setpoint]
    """(variables, time in s) -> where every drone should be, also later than now."""
    rewards: Mapping[str, tuple[float, Term]]
    """name -> (scale, term); the reward is the sum of scale times term."""
    ends: Mapping[str, Condition] = dataclasses.field(default_factory=dict)
    """Name -> condition that terminates: what follows has no value."""
    limits: Mapping[str, Condition] = dataclasses.field(default_factory=dict)
    """Name -> condition that truncates: the episode is cut, though it could go on."""
    advance: Callable[[World], Any] = lambda world: world.variables
    """The task's variables after a step, from the world with the variables before it."""
    metrics: Mapping[str, Term] = dataclasses.field(default_factory=dict)
    """What is reported but not rewarded, beside the `error` (m) and `speed` (m/s) of every task."""
    success: Callable[[Mapping[str, Array], float], Array] | None = None
    """(metrics over an episode (T, n), control period) -> (n,): whether a drone did what it should."""
    senses: Mapping[str, Part] = dataclasses.field(default_factory=dict)
    """Parts of an observation that only this task has."""
    laws: tuple[Callable[[jax.Array, Params], Params], ...] = ()
    """(key, params) of one drone -> its parameters in an episode: what varies as part of the task."""
    control_hz: float = 100.0
    """Control steps per second, unless the environment says otherwise."""
    substeps: int = 5
    """Physics steps per control step, unless the environment says otherwise."""
    scene: Scene = dataclasses.field(default_factory=Scene)
    contact: tuple[str, ...] = ()
    """What drones touch on purpose, `ground` or `drones`: adds those forces to the explicit backend."""
    action: str = "rpm"
    observation: tuple[str, ...] = ("position_error", "rotation_matrix", "velocity_error", "omega", "last_action")
    overtime: int = 0
    """Control steps an episode goes on after `duration`; 2 in the reference, which looks at the clock late."""

    def __post_init__(self):
        check_whole(f"number of drones of {self.name}", self.drones)
        check_positive("duration", self.duration, "s")
        check_positive("control_hz", self.control_hz, "1/s")
        check_whole("substeps", self.substeps)
        check_whole("overtime", self.overtime, minimum=0)
        for name, (scale, _) in self.rewards.items():
            check_number(f"scale of the reward {name!r}", scale)
        for contact in check_sequence("contact", self.contact, "'ground'"):
            check_choice("contact", contact, CONTACTS)

    def measure(self, world: World) -> dict[str, Float[Array, " n"]]:
        """All metrics by name; one's own go before the standard ones."""
        standard = {"error": distance(self, world), "speed": norm(world.drones.vel)}
        return standard | {name: metric(world) for name, metric in self.metrics.items()}

    def target_now(self, world: World) -> Setpoint:
        """Where every drone should be at this moment."""
        return self.target(world.variables, world.time)


def norm(v: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Length of every row, with a zero gradient at zero."""
    return safe_sqrt(jax.vmap(vector.dot)(v, v))


def square(v: Float[Array, "n k"]) -> Float[Array, " n"]:
    """Squared length of every row."""
    return jax.vmap(vector.dot)(v, v)


def distance(task: Task, world: World) -> Float[Array, " n"]:
    """Distance of every drone from its target, m."""
    return norm(world.drones.pos - task.target_now(world).pos)


def upright(world: World) -> Float[Array, " n"]:
    """Cosine of the tilt: 1 level, 0 on edge, -1 upside down."""
    return jax.vmap(rotation.z_axis)(world.drones.quat)[:, 2]


def out_of_control(center: tuple[float, float, float], reach: float) -> dict[str, Condition]:
    """The ends of a flight that cannot be saved, or is not a number any more.

    `lost` is further than `reach` (m) from `center` along some axis, `spinning` faster than 100 rad/s about some axis.
    """

    def lost(world: World) -> Bool[Array, " n"]:
        return _beyond(world.drones.pos - jnp.asarray(center, world.drones.pos.dtype)[None], reach)

    def spinning(world: World) -> Bool[Array, " n"]:
        return _beyond(world.drones.omega, SPINNING)

    return {"lost": lost, "spinning": spinning}


def _beyond(v: Float[Array, "n 3"], limit: float) -> Bool[Array, " n"]:
    x, y, z = (jnp.abs(column) < limit for column in v.T)  # false where it is not a number
    return ~(x & y & z)
