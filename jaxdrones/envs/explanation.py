"""Descriptions of observations, actions, rewards and simulation of an environment, as text and JSON."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jaxdrones.checks import short_repr
from jaxdrones.engine.step import HostStep
from jaxdrones.engine.wrenches import describe
from jaxdrones.envs.env import Env
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.quantity import Quantity, check_quantities, description
from jaxdrones.sensing import Scene

_STANDARD_METRICS = {"error": "Distance from the target, m.", "speed": "Speed, m/s."}
_UNKNOWN = "?"  # the unit of a number that a term does not describe
_NUMBERS = (
    "Entries are in their unit, unless the last columns have the values at -1, 0 and 1.\n"
    "Values beyond the range are clipped."
)


_ENDS = {
    "team": "the episode ends for all drones when a termination or truncation holds for one",
    "drone": "a termination or truncation ends the episode of that drone, which leaves the world; the others fly on",
}


@dataclasses.dataclass(frozen=True)
class Entry:
    """One entry of the observation or action of a drone."""

    term: str
    """Name of its observation term or action type."""
    quantity: Quantity
    low: float
    """Lower bound."""
    high: float
    """Upper bound."""


@dataclasses.dataclass(frozen=True)
class Part:
    """Reward, metric, or condition for the end of an episode."""

    name: str
    meaning: str
    weight: float | None = None
    """Weight of a reward; `None` otherwise."""


@dataclasses.dataclass(frozen=True, repr=False)
class Explanation:
    """Description of an environment; its text is a table."""

    task: dict[str, str]
    """Name, summary, team, time, start, target, success, and whose episode a termination ends."""
    observation: tuple[Entry, ...]
    images: dict[str, str]
    """Images of one drone by name."""
    action: tuple[Entry, ...]
    rewards: tuple[Part, ...]
    metrics: tuple[Part, ...]
    terminations: tuple[Part, ...]
    truncations: tuple[Part, ...]
    physics: dict[str, str]
    """Backend, integrator, rates, rotors, effects, and randomizations."""
    vehicle: dict[str, str]
    """Constants of the vehicle, with units."""

    def as_dict(self) -> dict[str, Any]:
        """Dictionary for JSON; entries have an `index` in their observation or action."""
        entries = {name: _plain(getattr(self, name)) for name in ("observation", "action")}
        parts = {
            name: [dataclasses.asdict(part) for part in getattr(self, name)]
            for name in ("rewards", "metrics", "terminations", "truncations")
        }
        own = {name: getattr(self, name) for name in ("task", "images", "physics", "vehicle")}
        return {"task": own.pop("task"), **entries, **parts, **own}

    def __str__(self) -> str:
        team = {name: text for name, text in self.task.items() if name not in ("name", "summary") and text}
        sections = [
            f"{self.task['name']}: {self.task['summary']}\n{_pairs(team)}",
            f"Observation: {_count(self.observation)} of each drone\n{entries_table(self.observation)}\n{_NUMBERS}",
            *([f"Images of each drone\n{_pairs(self.images)}"] if self.images else []),
            f"Action: {_count(self.action)} of each drone\n{entries_table(self.action)}",
            f"Reward of each drone in each control step: the sum of weight times term\n{_parts(self.rewards)}",
            f"Terminations\n{_parts(self.terminations)}",
            f"Truncations\n{_parts(self.truncations)}",
            f"Metrics of each drone\n{_parts(self.metrics)}",
            f"Physics\n{_pairs(self.physics)}",
            f"Vehicle\n{_pairs(self.vehicle)}",
        ]
        return "\n\n".join(sections)

    __repr__ = __str__


def explain(env: Env) -> Explanation:
    """Describe the observation, action, rewards and simulation of an environment.

    Returns:
        An object with a table as its text (`print(jaxdrones.explain(env))`), and with `as_dict()` for JSON.

    Raises:
        ValueError: an argument that is not an environment, or a term with the wrong number of descriptions.
    """
    if not isinstance(env, Env):
        raise UserError(f"env is {short_repr(env)}; give an environment, for example jaxdrones.make('hover')")
    task = env.task
    drone = jax.tree.map(lambda x: x[0], env.params)
    described = env.action.entries(drone) if env.action.entries else ()
    action = _checked(f"the action type {env.action.name}".strip(), described, env.action_size)
    return Explanation(
        task={
            "name": task.name,
            "summary": task.summary,
            "team": f"{env.drones} x {env.vehicle}",
            "time": f"{task.duration:.4g} s at {1 / env.dt:g} control steps per second: {env.steps} control steps",
            "start": description(task.start),
            "target": description(task.target),
            "success": description(task.success) if task.success else "no criterion",
            "ends": _ENDS[task.ends],
        },
        observation=tuple(_observed(env, action)),
        images={
            name: f"{space.shape} {np.dtype(space.dtype)}, {number(space.low)} to {number(space.high)}: {space.meaning}"
            for name, space in env.image_spaces.items()
        },
        action=tuple(Entry(env.action.name or "own", quantity, -1.0, 1.0) for quantity in action),
        rewards=tuple(Part(name, description(term), scale) for name, (scale, term) in task.rewards.items()),
        metrics=_conditions(_STANDARD_METRICS | {name: description(metric) for name, metric in task.metrics.items()}),
        terminations=_conditions(
            {
                name: f"{description(condition)} {'Success' if name in task.success_terminations else 'Failure'}."
                for name, condition in task.terminations.items()
            }
        ),
        truncations=_conditions(
            {"time": f"The time is up: {env.steps} control steps."}
            | {name: f"{description(condition)} Failure." for name, condition in task.truncations.items()}
        ),
        physics=_physics(env),
        vehicle=_vehicle(env, drone),
    )


def _observed(env: Env, action: tuple[Quantity, ...]) -> Iterable[Entry]:
    bounds = iter(env.observation_bound.tolist())
    for i, (term, size) in enumerate(zip(env.terms, env.term_sizes, strict=True)):
        name = term.name or f"term {i}"
        described = term.entries(env.drones, action) if callable(term.entries) else term.entries
        for quantity in _checked(f"the observation term {name}", described, size):
            bound = next(bounds)
            yield Entry(name, quantity, -bound, bound)


def _checked(what: str, described: tuple[Quantity, ...], size: int) -> tuple[Quantity, ...]:
    """Quantities of a term or action type, one per entry; placeholders without a description."""
    if not described:
        return tuple(Quantity(f"number {i}", _UNKNOWN, _UNKNOWN) for i in range(size))
    check_quantities(f"entries of {what}", described)
    if len(described) != size:
        raise UserError(f"{what} describes {len(described)} numbers and has {size}; give entries=(...) of {size}")
    return described


def _conditions(meanings: Mapping[str, str]) -> tuple[Part, ...]:
    return tuple(Part(name, meaning) for name, meaning in meanings.items())


def _physics(env: Env) -> dict[str, str]:
    step, physics = env.physics, env.physics.physics
    facts = {
        "backend": "bullet" if isinstance(step, HostStep) else "explicit",
        "integrator": step.integrator,
        "rates": f"{1 / env.dt:g} control steps per second of {step.substeps} physics steps of {1000 * step.dt:.4g} ms",
        "rotors": describe([physics.rotors]),
        "effects": describe(physics.effects),
        "pair effects": describe(physics.pairs),
        "team effects": describe(physics.team_effects),
        "models": ", ".join(model.name for model in physics.models) or "none",
        "scene": _scene(env.scene),
        "sensors": ", ".join(sensor.name for sensor in env.sensors) or "none",
        "cameras": str(env.vision) if env.vision else "none",
        "delay": " to ".join(f"{x * env.dt:.4g}" for x in sorted({*env.delay_steps})) + " s between action and command",
        "noise": _text(env.noise, "none"),
        "disturbance": _text(env.disturbance, "none"),
        "drawn per episode": "; ".join(_text(one, "a randomization of its own") for one in env.draws) or "nothing",
    }
    return facts


def _text(function: Any, otherwise: str) -> str:
    return (description(function) if function is not None else "") or otherwise


def _scene(scene: Any) -> str:
    if not isinstance(scene, Scene):
        return "drawn for every episode"
    ground = "the ground at z = 0" if scene.ground else "no ground"
    return f"{scene.count} obstacles and {ground}" if scene.has_obstacles else ground


def _vehicle(env: Env, drone: Params) -> dict[str, str]:
    def of(x: Any, unit: str) -> str:
        return f"{', '.join(number(float(y)) for y in np.ravel(x))} {unit}".strip()

    alike = all(np.all(np.asarray(x) == np.asarray(x)[:1]) for x in jax.tree.leaves(env.params))
    ratio = float(drone.max_thrust / drone.weight)
    return {
        "name": env.vehicle + ("" if alike else "; the numbers are those of drone 0, others of the team differ"),
        "mass": of(drone.mass, "kg"),
        "inertia": of(drone.inertia, "kg m^2 about body x, y, z"),
        "arm": of(drone.arm, "m"),
        "rotor speeds": f"{of(drone.hover_rpm, 'RPM')} to hover, {of(drone.max_rpm, 'RPM')} at most",
        "highest thrust": f"{number(ratio)} times the weight" if math.isfinite(ratio) else "without a limit",
        "highest speed": of(drone.max_speed, "m/s"),
        "rotor lag": f"{of(drone.rotor_rise_time, 's')} up, {of(drone.rotor_fall_time, 's')} down, where rotors lag",
        "collision": f"cylinder, radius {of(drone.collision_radius, 'm')}, height {of(drone.collision_height, 'm')}",
    }


def number(x: float) -> str:
    """Format a number with five digits."""
    return f"{x:.5g}"


def _count(entries: Sequence[Entry]) -> str:
    return "1 number" if len(entries) == 1 else f"{len(entries)} numbers"


def _plain(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    return [
        {"index": i, "term": entry.term, **dataclasses.asdict(entry.quantity), "low": entry.low, "high": entry.high}
        for i, entry in enumerate(entries)
    ]


def entries_table(entries: Sequence[Entry]) -> str:
    """Table of entries, with a heading and a line for each."""
    scaled = any(entry.quantity.values for entry in entries)
    rows = [["", "term", "what", "unit", "frame", "range", *(["-1 is", "0 is", "1 is"] if scaled else [])]]
    for i, entry in enumerate(entries):
        what = entry.quantity
        values = [number(x) for x in what.values] if what.values else [""] * 3
        rows.append(
            [str(i), entry.term, what.name, what.unit, what.frame, f"{number(entry.low)} to {number(entry.high)}"]
        )
        rows[-1] += values if scaled else []
    return aligned(rows)


def _parts(parts: Sequence[Part]) -> str:
    rows = [
        [part.name, *([] if part.weight is None else [number(part.weight)]), part.meaning or "(it has no docstring)"]
        for part in parts
    ]
    return aligned(rows) if rows else "  none"


def _pairs(pairs: dict[str, str]) -> str:
    return aligned(list(pairs.items()))


def aligned(rows: Sequence[Sequence[str]], align: Callable[[str, int], str] = str.ljust) -> str:
    """Table of rows of cells, indented, with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(map(align, row, widths)) for row in rows)
    return "\n".join(f"  {line}".rstrip() for line in lines)
