"""Each extension is one short file that needs nothing of the package but its public names."""

import ast
from pathlib import Path

import pytest

import jaxdrones

FILES = [f for f in sorted(Path(__file__).parent.glob("*.py")) if not f.name.startswith("test_")]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_an_extension_is_one_short_file(file):
    assert len(file.read_text().splitlines()) <= 60


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_an_extension_needs_public_names_alone(file):
    tree = ast.parse(file.read_text())
    modules = [node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    modules += [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    ours = [module for module in modules if module.split(".")[0] == "jaxdrones"]
    assert set(ours) <= {"jaxdrones", "jaxdrones.sensing"}
    names = [n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute) and getattr(n.value, "id", "") == "jd"]
    assert set(names) <= set(jaxdrones.__all__)
