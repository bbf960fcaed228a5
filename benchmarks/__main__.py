"""Run a benchmark: `python -m benchmarks NAME [--quick] [--json]`; `NAME --help` lists its options.

A benchmark is a module with a docstring that asks its question, `main(options) -> (result, lines)`, and
`add_arguments(parser)` if it has options. Versions, machine, commit and the printed lines are added to every result.
"""

import argparse
import importlib
import json
import sys
from pathlib import Path

from benchmarks.common import about

HELPERS = (
    "__init__",
    "__main__",
    "against",
    "cameras_scenes",
    "common",
    "crowd_baselines",
    "exported",
    "leaderboard_pilots",
    "leaderboard_scenarios",
    "programs",
    "published",
    "server",
    "tables",
)
NAMES = sorted(path.stem for path in Path(__file__).parent.glob("*.py") if path.stem not in HELPERS)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=f"Benchmarks: {', '.join(NAMES)}.")
    parser.add_argument("name", choices=NAMES, metavar="NAME")
    name = parser.parse_args(sys.argv[1:2]).name
    benchmark = importlib.import_module(f"benchmarks.{name}")
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks {name}",
        description=benchmark.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    if hasattr(benchmark, "add_arguments"):
        benchmark.add_arguments(parser)
    parser.add_argument("--quick", action="store_true", help="a few steps of a small case, without other simulators")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    options = parser.parse_args(sys.argv[2:])
    result, lines = benchmark.main(options)
    result |= {"about": about() | result.get("about", {}), "lines": lines}
    if options.json:
        print(json.dumps(result))
    else:
        print("\n".join([*(f"{name}: {value}" for name, value in result["about"].items()), *lines]))
    if "failed" in result:
        sys.exit(result["failed"])


if __name__ == "__main__":
    main()
