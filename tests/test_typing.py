"""The types that the package promises with py.typed: complete, right, and of use to who has a type checker."""

import ast
import re
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import pytest

import jaxdrones

PACKAGE = Path(jaxdrones.__file__).parent
HERE = Path(__file__).parent
INTERNAL = {"cli", "numerics"}  # what no user imports
SHELL = {"episode", "events", "hosts", "runs", "sb3", "sb3_training", "training"}  # learning/, behind the command line
PUBLIC = [
    path
    for path in sorted(PACKAGE.rglob("*.py"))
    if path.relative_to(PACKAGE).parts[0].removesuffix(".py") not in INTERNAL
    and not (path.parent.name == "learning" and path.stem in SHELL)
]


def functions(tree: ast.Module):
    """Public functions, and public methods of public classes."""
    for node in tree.body:
        for member in [node, *(node.body if isinstance(node, ast.ClassDef) and node.name[0] != "_" else [])]:
            if isinstance(member, ast.FunctionDef) and (
                member.name[0] != "_" or member.name in ("__init__", "__call__")
            ):
                yield member


def without_a_type(function: ast.FunctionDef) -> list[str]:
    given = function.args
    arguments = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
    missing = [x.arg for x in arguments if x is not None and x.annotation is None and x.arg not in ("self", "cls")]
    return missing + ["what it returns"] * (function.returns is None and function.name != "__init__")


def test_everything_public_has_types():
    found = {path: functions(ast.parse(path.read_text())) for path in PUBLIC}
    missing = [(p.name, f.name, without_a_type(f)) for p, fs in found.items() for f in fs if without_a_type(f)]
    assert missing == []


def test_the_package_says_that_it_has_types():
    assert files("jaxdrones").joinpath("py.typed").is_file()


@pytest.mark.needs("mypy")
@pytest.mark.slow
def test_a_type_checker_tells_every_mistake_and_nothing_else():
    """Of a list of mistakes; that it finds nothing in the package and in a user's script is a part of `make lint`."""
    source = HERE / "typing" / "mistakes.py"
    command = [sys.executable, "-m", "mypy", str(source)]
    done = subprocess.run(command, cwd=HERE.parent, capture_output=True, text=True, check=False)
    told = {(file, int(line)) for file, line in re.findall(r"(?m)^(.*):(\d+): error", done.stdout)}
    where, lines = str(source.relative_to(HERE.parent)), source.read_text().splitlines()
    mistakes = {(where, number) for number, line in enumerate(lines, 1) if "# mistake" in line}
    assert told == mistakes, done.stdout + done.stderr


@pytest.mark.slow
def test_the_users_script_that_is_checked_runs():
    command = [sys.executable, "-W", "error", str(HERE / "typing" / "user_script.py")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
