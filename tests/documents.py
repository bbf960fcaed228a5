"""The fenced blocks of the pages, and running them."""

import importlib.util
import re
from pathlib import Path
from typing import Any, NamedTuple

import jax

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "benchmarks/README.md")]
PAGES += sorted((ROOT / "docs").glob("*.md"))
LANGUAGES = ("python", "sh", "text")

_FENCE = re.compile(
    r"(?:^<!-- not run: (?P<reason>[^\n]+) -->\n)?^```(?P<language>\w*)\n(?P<code>.*?)^```$", re.M | re.S
)
_NEEDS = {  # words in a block -> the library without which it does not run
    r"\bbullet\b": "pybullet",
    r"\bpettingzoo\b": "pettingzoo",
    r"\bbrax\b": "brax",
    r"\btwin\b|\bmpc\b": "casadi",
    r"\braptor\b": "foundation_policy",
    r"\bsb3\b": "stable_baselines3",
    r"\brllib\b": "ray",
}


class Block(NamedTuple):
    page: Path
    line: int
    language: str
    code: str
    reason: str | None
    """Why it is not run; in the comment `<!-- not run: ... -->` above it."""

    @property
    def name(self) -> str:
        return f"{self.page.relative_to(ROOT)}, line {self.line}"

    def missing(self) -> list[str]:
        """Libraries that it needs and that are not installed."""
        needed = [library for word, library in _NEEDS.items() if re.search(word, self.code)]
        return [library for library in needed if importlib.util.find_spec(library) is None]


def blocks(page: Path, language: str | None = None) -> list[Block]:
    """The blocks of a page, in one language or in all."""
    text = page.read_text()
    found = [
        Block(page, text[: m.start("code")].count("\n") + 1, m["language"], m["code"], m["reason"])
        for m in _FENCE.finditer(text)
    ]
    return [block for block in found if language in (None, block.language)]


def run_python(page: Path, skipped: list[str]) -> dict[str, Any]:
    """Run the Python of a page from top to bottom, as a user has JAX; what a library is missing for is `skipped`."""
    names: dict[str, Any] = {}
    with jax.numpy_rank_promotion("allow"):
        for block in blocks(page, "python"):
            if block.reason is not None:
                continue
            if missing := block.missing():
                skipped.append(f"{block.name} needs {', '.join(missing)}")
            else:
                exec(compile("\n" * (block.line - 1) + block.code, str(page), "exec"), names)
    return names
