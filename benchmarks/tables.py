"""Measure the tables of the pages again: `make tables`, or `python -m benchmarks.tables NAME ...` for some of them.

A table is on its page between `<!-- measured: NAME OPTIONS -->` and `<!-- end -->`. It is the output of
`python -m benchmarks NAME OPTIONS` with machine, versions and commit. benchmarks/results/ has the results as JSON.
Measure on idle cores, at a commit without changes.
"""

import argparse
import json
import re
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parent.parent
PAGES = (ROOT / "README.md", ROOT / "benchmarks/README.md", *sorted((ROOT / "docs").glob("*.md")))
_TABLE = re.compile(r"^<!-- measured: (?P<command>[^\n]+) -->\n(?P<table>.*?)^<!-- end -->$", re.M | re.S)


def commands(text: str) -> list[str]:
    """Names and options of the benchmarks whose tables are on a page."""
    return [found["command"] for found in _TABLE.finditer(text)]


def result_file(command: str) -> Path:
    """Where the result of a benchmark with its options is kept."""
    return ROOT / "benchmarks/results" / (re.sub(r"[^\w.]+", "-", command).strip("-") + ".json")


def table(command: str, result: dict) -> str:
    """The text between the marks of a page."""
    about = result["about"]
    versions = f"commit {about['commit']}, jax {about['jax']}, Python {about['python']}"
    cores = "1 core" if about["cores"] == 1 else f"{about['cores']} cores"
    source = f"`python -m benchmarks {command}` at {versions}, on {cores} of {about['cpu']}:"
    return "\n".join([source, "", "```text", *result["lines"], "```", ""])


def rewritten(text: str, results: dict[str, dict]) -> str:
    """A page with the tables of some commands made anew."""

    def renew(found: re.Match) -> str:
        command = found["command"]
        made = table(command, results[command]) if command in results else found["table"]
        return f"<!-- measured: {command} -->\n{made}<!-- end -->"

    return _TABLE.sub(renew, text)


def measure(command: str) -> dict:
    """Run a benchmark in a process of its own and keep its result."""
    run = [sys.executable, "-m", "benchmarks", *command.split(), "--json"]
    result = json.loads(subprocess.run(run, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True).stdout)
    file = result_file(command)
    file.parent.mkdir(exist_ok=True)
    file.write_text(json.dumps(result, indent=1) + "\n")
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="benchmarks to run; all that have a table if left out")
    names = parser.parse_args().names
    pages = {page: page.read_text() for page in PAGES}
    wanted = dict.fromkeys(command for text in pages.values() for command in commands(text))
    for command in wanted:
        if names and command.split()[0] not in names:
            continue
        start = time.monotonic()
        result = measure(command)
        print(f"{time.monotonic() - start:6.0f} s  {command}", flush=True)
        for page, text in pages.items():
            pages[page] = rewritten(text, {command: result})
            if pages[page] != text:
                page.write_text(pages[page])


if __name__ == "__main__":
    main()
