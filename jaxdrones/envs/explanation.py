"""What an environment is, in words and tables for people and as plain entries for machines."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from jaxdrones.quantity import Quantity

_NUMBERS = (
    "A number is in its unit; where -1, 0 and 1 stand for something else, the last columns say for what.\n"
    "Numbers beyond the range are clipped."
)


@dataclasses.dataclass(frozen=True)
class Entry:
    """One number of the observation or action of a drone."""

    term: str
    """Name of the observation term or of the action type that it belongs to."""
    quantity: Quantity
    low: float
    """Smallest number that occurs."""
    high: float
    """Largest number that occurs."""


@dataclasses.dataclass(frozen=True)
class Part:
    """A reward, a metric, or a condition that ends an episode."""

    name: str
    meaning: str
    weight: float | None = None
    """Weight of a reward; `None` of anything else."""


@dataclasses.dataclass(frozen=True, repr=False)
class Explanation:
    """What an environment observes, commands, rewards and simulates; its text is a table."""

    task: dict[str, str]
    """Name, summary, team, time, start, target and success."""
    observation: tuple[Entry, ...]
    images: dict[str, str]
    """What an image of one drone is, by name."""
    action: tuple[Entry, ...]
    rewards: tuple[Part, ...]
    metrics: tuple[Part, ...]
    terminations: tuple[Part, ...]
    truncations: tuple[Part, ...]
    physics: dict[str, str]
    """Backend, integrator, rates, rotors, effects, and what is drawn at random."""
    vehicle: dict[str, str]
    """Constants of the vehicle, with units."""

    def as_dict(self) -> dict[str, Any]:
        """The same for JSON; numbers have an `index` in their observation or action."""
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
            f"Observation: {_count(self.observation)} of each drone\n{_entries(self.observation)}\n{_NUMBERS}",
            *([f"Images of each drone\n{_pairs(self.images)}"] if self.images else []),
            f"Action: {_count(self.action)} of each drone\n{_entries(self.action)}",
            f"Reward of each drone in each control step: the sum of weight times term\n{_parts(self.rewards)}",
            f"Terminations: the episode ends for good where one holds for one drone\n{_parts(self.terminations)}",
            f"Truncations: the episode is cut, though it could go on\n{_parts(self.truncations)}",
            f"Metrics of each drone, which are not rewarded\n{_parts(self.metrics)}",
            f"Physics\n{_pairs(self.physics)}",
            f"Vehicle\n{_pairs(self.vehicle)}",
        ]
        return "\n\n".join(sections)

    __repr__ = __str__


def number(x: float) -> str:
    """A number with five digits."""
    return f"{x:.5g}"


def _count(entries: Sequence[Entry]) -> str:
    return "1 number" if len(entries) == 1 else f"{len(entries)} numbers"


def _plain(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    return [
        {"index": i, "term": entry.term, **dataclasses.asdict(entry.quantity), "low": entry.low, "high": entry.high}
        for i, entry in enumerate(entries)
    ]


def _entries(entries: Sequence[Entry]) -> str:
    scaled = any(entry.quantity.values for entry in entries)
    rows = [["", "term", "what", "unit", "frame", "range", *(["-1 is", "0 is", "1 is"] if scaled else [])]]
    for i, entry in enumerate(entries):
        what = entry.quantity
        values = [number(x) for x in what.values] if what.values else [""] * 3
        rows.append(
            [str(i), entry.term, what.name, what.unit, what.frame, f"{number(entry.low)} to {number(entry.high)}"]
        )
        rows[-1] += values if scaled else []
    return _table(rows)


def _parts(parts: Sequence[Part]) -> str:
    rows = [
        [part.name, *([] if part.weight is None else [number(part.weight)]), part.meaning or "(it has no docstring)"]
        for part in parts
    ]
    return _table(rows) if rows else "  none"


def _pairs(pairs: dict[str, str]) -> str:
    return _table([[name, text] for name, text in pairs.items()])


def _table(rows: list[list[str]]) -> str:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)
    return "\n".join(f"  {line}".rstrip() for line in lines)
