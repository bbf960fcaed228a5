"""How fast is each of a fixed set of programs, commit by commit, and against another commit in the same run?

Times of the plant, teams, environments, updates of the learners and a camera, 1,024 worlds each, and of compiling the
updates (benchmarks/programs.py). The result of a commit on a machine is a line of JSON in
benchmarks/results/track.jsonl; a figure shows all lines of this machine. `--against COMMIT` instead compares with that
commit in the same run, which is robust against other programs (benchmarks/against.py), and ends with exit code 1 if a
program lost more than 30 % of its speed in all rounds.
"""

import argparse
import functools
import json
import subprocess
from collections.abc import Sequence
from pathlib import Path

from benchmarks import against
from benchmarks.common import about, in_turn, summary
from benchmarks.programs import COMPILED, PROGRAMS, Programs
from benchmarks.server import COMPILE, definitions

ROOT = Path(__file__).parent.parent
HISTORY = ROOT / "benchmarks/results/track.jsonl"
FIGURE = ROOT / "benchmarks/figures/track.png"
COMPILATIONS = 3
MACHINE = ("cpu", "cores", "device")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--only", nargs="+", default=[], choices=PROGRAMS, metavar="PROGRAM", help=", ".join(PROGRAMS))
    parser.add_argument("--repeats", type=int, default=9, help="of a time; the median counts")
    parser.add_argument("--against", nargs="?", const="HEAD~1", metavar="COMMIT", help="compare with COMMIT (HEAD~1)")
    parser.add_argument("--budget", type=float, default=240.0, metavar="S", help="seconds of a comparison (240)")
    parser.add_argument("--history", type=Path, default=HISTORY, help="JSON lines to add to")
    parser.add_argument("--figure", type=Path, default=FIGURE, help="PNG to write")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    if options.against:
        return against.main(options.against, options.only, options.budget)
    names = options.only or list(PROGRAMS)
    rows = measure(names[:1] if options.quick else names, 1 if options.quick else options.repeats)
    lines = [f"{row['median']:10.4g} +- {row['spread']:8.2g} {row['unit']:14} {row['name']}" for row in rows]
    if not options.quick:
        lines += keep(rows, options.history, options.figure)
    return {"rows": rows}, lines


def measure(names: Sequence[str], repeats: int) -> list[dict]:
    """A row for each program, and for compiling the learners among them."""
    programs, explained = Programs(), definitions()
    rows = []
    for name in names:
        if name in COMPILED:
            seconds = summary([programs.compile(name) for _ in range(min(repeats, COMPILATIONS))])
            rows.append({"name": name + COMPILE, "unit": "s"} | seconds)
    times = in_turn({name: functools.partial(programs.call, name) for name in names}, repeats)
    for name, found in times.items():
        program = PROGRAMS[name]
        values = {key: program.value(found[key]) for key in ("median", "spread")}
        rows.append({"name": name, "unit": program.unit} | values)
    return [row | {"definition": explained[row["name"]]} for row in rows]


def keep(rows: list[dict], history: Path, figure: Path) -> list[str]:
    """Add a line to the history, in place of one of the same commit and machine, and draw it."""
    facts = about()
    changed = subprocess.run(["git", "diff", "--quiet", "HEAD", "--", "jaxdrones"], cwd=ROOT, check=False).returncode
    line = {
        "commit": str(facts["commit"]) + " and changes" * bool(changed),
        "machine": {name: facts[name] for name in MACHINE},
        "versions": {name: facts[name] for name in ("jax", "jaxlib", "python")},
        "rows": rows,
    }
    kept = [json.loads(text) for text in history.read_text().splitlines()] if history.is_file() else []
    kept = [one for one in kept if (one["commit"], one["machine"]) != (line["commit"], line["machine"])]
    history.write_text("".join(json.dumps(one) + "\n" for one in [*kept, line]))
    draw([one for one in kept if one["machine"] == line["machine"]] + [line], figure)
    return [f"written: {history}, {figure}"]


def draw(lines: Sequence[dict], path: Path) -> None:
    """A panel for each unit: medians, with their spread, against commits, oldest first."""
    from matplotlib.ticker import LogLocator  # only where a figure is drawn

    from jaxdrones.visualization import style

    units = dict.fromkeys(row["unit"] for row in lines[-1]["rows"])
    commits = [line["commit"] for line in lines]
    with style.figure(4.5 * len(units), 7) as figure:
        for axes, unit in zip(figure.subplots(1, len(units), squeeze=False)[0], units, strict=True):
            for name in [row["name"] for row in lines[-1]["rows"] if row["unit"] == unit]:
                found = [(i, row) for i, line in enumerate(lines) for row in line["rows"] if row["name"] == name]
                medians, halves = [row["median"] for _, row in found], [row["spread"] / 2 for _, row in found]
                axes.errorbar([i for i, _ in found], medians, halves, marker="o", capsize=3, label=name)
            axes.set_xticks(range(len(commits)), commits, rotation=60)
            axes.set(title=unit if unit != "s" else "s to compile", yscale="log")
            axes.yaxis.set(major_locator=LogLocator(subs=(1, 1.5, 2, 3, 5, 7)), major_formatter="{x:g}")
            axes.yaxis.set_minor_formatter("")
            axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.25))
        machine = lines[-1]["machine"]
        figure.suptitle(f"Time of each program, by commit; {machine['cores']} cores of {machine['cpu']}")
        style.save(figure, path)
