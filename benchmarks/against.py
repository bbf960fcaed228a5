"""Compare the speed of the working tree with that of another commit; what `track --against` prints.

The commit is checked out into a temporary worktree. Each side is a process with its own package and programs
(server.py); they are measured alternately, in three rounds, and again in new processes if a program was slower in all
of them. It fails if it was slower in all rounds both times, which other programs on the machine do not cause.
"""

import contextlib
import json
import os
import select
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.server import COMPILE, PREPARE, definitions

ROOT = Path(__file__).parent.parent
ROUNDS = 3
KEPT = 0.7
"""Of the speed; a round with less is lost."""
SHORTEST_RETRY = 60.0  # s


class NotMeasured(Exception):
    """A row, or all, cannot be measured."""


class TimeIsUp(Exception):
    """No answer came in time."""


class Side:
    """A process that measures the programs of a checkout."""

    def __init__(self, folder: Path, until: float):
        if not (folder / "benchmarks/server.py").is_file():
            raise NotMeasured("it lacks this benchmark")
        environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
        self._until = until
        self.process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.server"],
            cwd=folder,
            env=environment | {"PYTHONPATH": str(folder)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(self, request: str) -> None:
        """Write a request."""
        with contextlib.suppress(BrokenPipeError):  # it has ended, as `read` says
            self.process.stdin.write(request + "\n")
            self.process.stdin.flush()

    def read(self) -> dict:
        """The next line that it writes, if that comes in time."""
        if not select.select([self.process.stdout], [], [], max(0.0, self._until - time.monotonic()))[0]:
            raise TimeIsUp
        line = self.process.stdout.readline()
        if not line:
            raise NotMeasured(f"its process ended with {self.process.wait()}")
        return json.loads(line)

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        with contextlib.suppress(BrokenPipeError), self.process:
            pass


@contextlib.contextmanager
def checked_out(commit: str) -> Iterator[Path]:
    """A temporary worktree of a commit."""
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "tree"
        made = _git("worktree", "add", "--detach", str(folder), commit)
        if made.returncode:
            raise NotMeasured(f"it cannot be checked out: {made.stderr.strip().splitlines()[-1]}")
        try:
            yield folder
        finally:
            _git("worktree", "remove", "--force", str(folder))


def _git(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)


@contextlib.contextmanager
def sides(folder: Path, until: float) -> Iterator[tuple[Side, Side]]:
    """The old and the new side, in fresh processes."""
    with contextlib.ExitStack() as stack:
        old, new = (stack.enter_context(contextlib.closing(Side(place, until))) for place in (folder, ROOT))
        yield old, new


def compare(folder: Path, names: Sequence[str], until: float) -> tuple[dict[str, list[float]], dict[str, str]]:
    """Ratios of the speed of rows, new over old, of every round; and why others have none."""
    ratios: dict[str, list[float]] = {}
    with sides(folder, until) as (old, new):
        theirs, ours = old.read(), new.read()
        missing = {name: "the old commit measures something else" for name in names if theirs.get(name) != ours[name]}
        for name in [name for name in names if name not in missing]:
            try:
                ratios[name] = rounds(old, new, name)
            except NotMeasured as why:
                missing[name] = str(why)
            except TimeIsUp:
                unmeasured = [name for name in names if name not in ratios and name not in missing]
                missing |= dict.fromkeys(unmeasured, "the time was up")
                break
    return ratios, missing


def rounds(old: Side, new: Side, name: str) -> list[float]:
    """Ratios of the rounds of a row; a compilation that was not lost is not repeated."""
    found: list[float] = []
    if not name.endswith(COMPILE):
        together(old, new, PREPARE + name)
    while len(found) < ROUNDS and not (name.endswith(COMPILE) and not lost(found)):
        found.append(ratio(old, new, name, old_first=len(found) % 2 == 0))
    return found


def together(old: Side, new: Side, request: str) -> None:
    """Compile at the same time what need not be measured; an error comes again when the program is measured."""
    for side in (old, new):
        side.ask(request)
    for side in (old, new):
        side.read()


def ratio(old: Side, new: Side, name: str, old_first: bool) -> float:
    """Speed of the new side over that of the old one, measured one after the other."""
    found = {}
    for side in (old, new) if old_first else (new, old):
        side.ask(name)
        found[side] = side.read()
    if "error" in found[new]:
        raise SystemExit(f"{name}: {found[new]['error']}")
    if "error" in found[old]:
        raise NotMeasured(f"the old commit fails: {found[old]['error']}")
    return found[old]["seconds"] / found[new]["seconds"]


def lost(ratios: Sequence[float]) -> bool:
    """Whether all rounds so far were lost."""
    return all(ratio < KEPT for ratio in ratios)


def main(commit: str, names: Sequence[str], budget: float) -> tuple[dict, list[str]]:
    """The result and the lines of a comparison, with `failed` if a row lost all rounds twice."""
    until = time.monotonic() + budget
    names = [name for name in definitions() if not names or name.removesuffix(COMPILE) in names]
    again: dict[str, list[float]] = {}
    try:
        with checked_out(commit) as folder:
            ratios, missing = compare(folder, names, until)
            losing = losers(ratios)
            if losing:
                again, _ = compare(folder, losing, max(until, time.monotonic() + SHORTEST_RETRY))
    except (NotMeasured, TimeIsUp) as why:
        return {"against": commit, "ratios": {}}, [f"NOT CHECKED: speed against {commit}: {why}"]
    slower = losers(again)
    result = {"against": commit, "ratios": ratios, "again": again, "missing": missing, "slower": slower}
    return result | ({"failed": 1} if slower else {}), lines(result)


def losers(ratios: dict[str, list[float]]) -> list[str]:
    """Rows that lost every round."""
    return [name for name, each in ratios.items() if len(each) == ROUNDS and lost(each)]


def lines(result: dict) -> list[str]:
    """Lines for people."""
    made = [f"speed, times that of {result['against']}: median (rounds)"]
    for name, ratios in result["ratios"].items():
        rounds = ratios + result["again"].get(name, [])
        each = " ".join(f"{ratio:.2f}" for ratio in rounds)
        made.append(f"{statistics.median(rounds):6.2f} ({each})  {name}{', SLOWER' * (name in result['slower'])}")
    made += [f"NOT CHECKED: {name}: {why}" for name, why in result["missing"].items()]
    if result["slower"]:
        made.append(f"lost more than {100 * (1 - KEPT):.0f} % in all rounds: {'; '.join(result['slower'])}")
    return made
