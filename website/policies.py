"""Trains the bundled policies, each by `jaxdrones train TASK --seed 0`; the one for any vehicle in two trainings.

    python website/policies.py [NAME ...]

Finished trainings in runs/policies are kept, so that an interrupted run can continue. It takes an hour on one core.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
RUNS = ROOT / "runs" / "policies"
BUNDLED = ROOT / "assets" / "policies"
TASKS = (
    "hover",
    "recovery",
    "tracking",
    "follow",
    "landing",
    "forest",
    "gates",
    "room",
    "race",
    "swap-goals",
    "crowd",
    "wake",
    "sling",
    "transport",
)
_FIRST, _ANY = "any-vehicle-first", "any-vehicle"
_ARGUMENTS: dict[str, list[str]] = {
    _FIRST: ["hover", "--realistic", "any"],
    _ANY: ["--config", "website/fine_tuning.toml", "--from", f"runs/policies/{_FIRST}"],
}
"""Arguments of `jaxdrones train` for policies that are not called as their task."""
_FILES = ("best.json", "best.msgpack", "report.json")
_HEAD = """# Bundled policies

Each was trained by `jaxdrones train TASK --seed 0`, at the commit of the row, by `python website/policies.py`.
Seeds were not selected. Success is that of the evaluation after training, with the lower bound of its 95 % interval,
unless all episodes have the same start.
`jaxdrones eval TASK` evaluates one again, `jaxdrones demo` shows flights.

| task | learner | success | at least | episodes | compile, train, evaluate (s) | bytes | commit |
|---|---|---|---|---|---|---|---|
"""


def main() -> None:
    """Train, copy the policies, and write the table of the README there."""
    for name in sys.argv[1:] or (*TASKS, *_ARGUMENTS):
        run = RUNS / name
        if not (run / "report.json").exists():
            shutil.rmtree(run, ignore_errors=True)
            command = [sys.executable, "-c", "import sys; from jaxdrones.cli import main; sys.exit(main())"]
            arguments = [*_ARGUMENTS.get(name, [name]), "--seed", "0", "--output", run.relative_to(ROOT)]
            subprocess.run([*command, "train", *arguments], cwd=ROOT, check=True)
            (run / "commit").write_text(_git("rev-parse", "--short", "HEAD"))
        if name == _FIRST:
            continue
        folder = BUNDLED.parent / _ANY if name == _ANY else BUNDLED / name
        folder.mkdir(parents=True, exist_ok=True)
        for file in _FILES:
            shutil.copy(run / file, folder / file)
        report = json.loads((run / "report.json").read_bytes())
        if name == _ANY:
            report["first_training"] = json.loads((RUNS / _FIRST / "report.json").read_bytes())
        commit = (run / "commit").read_text().strip()
        (folder / "report.json").write_text(json.dumps(report | {"commit": commit}, indent=2))
    rows = [_row(BUNDLED / task) for task in TASKS if (BUNDLED / task).exists()]
    (BUNDLED / "README.md").write_text(_HEAD + "".join(rows))


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True, text=True).stdout


def _row(folder: Path) -> str:
    report, sidecar = (json.loads((folder / f"{name}.json").read_bytes()) for name in ("report", "best"))
    evaluation = report["evaluation"]
    low = f"{100 * evaluation['success_interval'][0]:.1f} %" if evaluation["success_interval"] else "one start"
    size = (folder / "best.msgpack").stat().st_size
    learner = sidecar["recipe"]["algorithm"]
    return (
        f"| `{folder.name}` | {learner} | {100 * evaluation['success']:.1f} % | {low} | {evaluation['episodes']} | "
        f"{sum(report['seconds'].values()):.0f} | {size:,} | {report['commit']} |\n"
    )


if __name__ == "__main__":
    main()
