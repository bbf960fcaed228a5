"""Text that the targets share: the description of inputs and outputs, and numbers."""

import dataclasses
import re
import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from jaxdrones.envs.explanation import Explanation, entries_table
from jaxdrones.export.layers import BYTES, Graph

WIDTH = 120
_DEFINITION = re.compile(r"^(?:static inline \w+ NAME_|function |const )(\w+)", re.MULTILINE)


@dataclasses.dataclass(frozen=True)
class Description:
    """Meaning of the inputs and outputs of an exported policy."""

    title: str
    """Task, learner and update, in one line."""
    explanation: Explanation
    """Of the environment of the policy."""
    period: float
    """Time between two calls, s."""
    graph: Graph | None = None
    """Layers of the policy; `None` for a network of unknown layers."""
    ram: int | None = None
    """Bytes of working memory and hidden state, of targets that manage their own memory."""

    @property
    def flash(self) -> int | None:
        """Bytes of the weights; `None` for unknown layers."""
        return None if self.graph is None else BYTES * self.graph.weights

    @property
    def hidden_size(self) -> int:
        """Length of the hidden state of a recurrent policy; 0 without one, and for unknown layers."""
        return 0 if self.graph is None else self.graph.hidden_size

    def lines(self) -> list[str]:
        """Text of inputs and outputs, one line per row of a table."""
        text = [
            f"{self.title}: deterministic policy of one drone, written by `jaxdrones export`.",
            f"Call it {1 / self.period:g} times per second.",
        ]
        if self.graph is not None:
            ram = "" if self.ram is None else f", {self.ram:,} bytes of RAM (working memory and hidden state)"
            text.append(f"One call: {self.graph.multiply_adds:,} multiply-adds{ram}, {self.flash:,} bytes of weights.")
        text += ["", "Observation; clip values beyond the range:", *self._table("observation")]
        for name, meaning in self.explanation.images.items():
            text += ["", f"Image {name}, row by row: {meaning}"]
        if self.hidden_size:
            text += ["", f"Hidden state: {self.hidden_size} numbers, kept between calls; 0 at the start of a flight"]
        return [*text, "", "Action, in (-1, 1):", *self._table("action")]

    def as_dict(self) -> dict[str, Any]:
        """Title, rate and entries for JSON."""
        entries = self.explanation.as_dict()
        own = {name: entries[name] for name in ("observation", "images", "action")}
        return {"title": self.title, "period_s": self.period, "hidden_size": self.hidden_size, **own}

    def _table(self, name: str) -> list[str]:
        return entries_table(getattr(self.explanation, name)).splitlines()


def block_comment(lines: list[str]) -> str:
    """Lines as a comment of C and JavaScript, with all special character sequences broken up."""
    for text, harmless in (("*/", "* /"), ("/*", "/ *"), ("??", "? ?"), ("\\", "/")):
        lines = [line.replace(text, harmless) for line in lines]
    return "\n".join(["/*", *(f" * {line}".rstrip() for line in lines), " */"])


def number(x: float) -> str:
    """Shortest decimal number that is this number in float32."""
    return str(np.float32(x))


def numbers(array: np.ndarray, suffix: str = "") -> str:
    """Indented lines of an array's numbers, row by row."""
    text = ", ".join(f"{number(x)}{suffix}" for x in array.ravel())
    return textwrap.fill(text, WIDTH, initial_indent="    ", subsequent_indent="    ", break_long_words=False)


def functions(file: str, names: set[str]) -> list[str]:
    """Functions of these names in a file of this folder, in its order, each with the comment above it.

    An empty line follows each function, and a function that calls `sigmoid` needs it.
    """
    blocks = (Path(__file__).parent / file).read_text().strip().split("\n\n")
    by_name = {match[1]: block for block in blocks if (match := _DEFINITION.search(block))}
    if any("sigmoid(" in by_name[name] for name in names):
        names = names | {"sigmoid"}
    return [block for name, block in by_name.items() if name in names]
