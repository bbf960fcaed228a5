"""Records of the leaderboard for the page of a task, from benchmarks/results/leaderboard.json."""

import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parent.parent))

from benchmarks.leaderboard import percent
from benchmarks.leaderboard_scenarios import SCENARIOS

_HEAD = ["scenario", "", "record", "success [95 % interval]", "tuning or training", "time per command", "tied"]
Row = dict[str, Any]


def section(root: Path, task: str) -> str:
    """Records of the scenarios of a task, in Markdown; empty if it has none."""
    results = json.loads((root / "benchmarks" / "results" / "leaderboard.json").read_text())
    names = [name for name, scenario in SCENARIOS.items() if scenario.task == task]
    firsts = {name: best([row for row in results["rows"] if row["scenario"] == name]) for name in names}
    if not any(firsts.values()):
        return ""
    about, known = results["about"], next(first[0] for first in firsts.values() if first)
    lines = [_HEAD, ["---"] * len(_HEAD), *(_cells(name, first) for name, first in firsts.items())]
    return "\n".join(
        [
            "The table has the pilots with the highest lower bound of the success rate in each scenario of the "
            f"[leaderboard](../leaderboard.md). Times are CPU times, at commit {about['commit']} on {about['cores']} "
            f"cores of {about['cpu']}. This command measures a row again:",
            "",
            "```sh",
            f"python -m benchmarks leaderboard --pilot {known['pilot']} --scenario {known['scenario']}",
            "```",
            "",
            *("| " + " | ".join(cells) + " |" for cells in lines),
        ]
    )


def best(rows: Sequence[Row]) -> list[Row]:
    """Rows with the highest lower bound of the success rate, the fastest first; none if no pilot succeeds."""
    bounds = [row["interval"][0] if row["interval"] else row["success"] for row in rows]
    first = [row for row, bound in zip(rows, bounds, strict=True) if bound == max(bounds) and row["success"] > 0]
    return sorted(first, key=lambda row: row["seconds to obtain"] or math.inf)


def _cells(scenario: str, first: Sequence[Row]) -> list[str]:
    """Cells of one scenario, with its best rows."""
    about = [f"`{scenario}`", SCENARIOS[scenario].text]
    if not first:
        return [*about, "none", "0 %", "", "", ""]
    row, *others = first
    interval = f" [{percent(row['interval'][0])}, {percent(row['interval'][1])}]" if row["interval"] else ""
    return [
        *about,
        row["pilot"],
        f"{percent(row['success'])} % of {row['starts']:,}{interval}",
        f"{row['seconds to obtain']:.0f} s" if row["seconds to obtain"] else "elsewhere",
        f"{1e6 * row['seconds a command']:.2g} us",
        ", ".join(other["pilot"] for other in others),
    ]
