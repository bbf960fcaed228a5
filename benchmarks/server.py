"""Measure the programs of programs.py on request, in a separate process, for against.py.

The first line of its output has the definitions of all rows, as JSON. Then it answers each line of input with one line,
`{"seconds": ...}` or `{"error": ...}`: `prepare NAME` compiles a program if necessary, `NAME` measures its time, and
`NAME, compile` compiles it again.
"""

import functools
import json
import sys

from benchmarks.common import in_turn
from benchmarks.programs import COMPILED, PROGRAMS, Programs

REPEATS = 5
COMPILE, PREPARE = ", compile", "prepare "


def definitions() -> dict[str, str]:
    """What each row is; rows of commits are comparable if their definitions are the same."""
    rows = {}
    for name, program in PROGRAMS.items():
        if name in COMPILED:
            rows[name + COMPILE] = f"tracing and compiling {program.definition}"
        rows[name] = program.definition
    return rows


def answer(request: str, programs: Programs) -> float:
    """Seconds of a request."""
    if request.endswith(COMPILE):
        return programs.compile(request.removesuffix(COMPILE))
    name = request.removeprefix(PREPARE)
    repeats = REPEATS if name == request else 1
    return in_turn({name: functools.partial(programs.call, name)}, repeats)[name]["median"]


def main() -> None:
    answers, sys.stdout = sys.stdout, sys.stderr
    print(json.dumps(definitions()), file=answers, flush=True)
    programs = Programs()
    for line in sys.stdin:
        try:
            found: dict[str, object] = {"seconds": answer(line.strip(), programs)}
        except Exception as error:  # of any kind: the programs of an old commit, or of one that is being made
            found = {"error": f"{type(error).__name__}: {error}".splitlines()[0]}
        print(json.dumps(found), file=answers, flush=True)


if __name__ == "__main__":
    main()
