"""The notebooks with outputs are those that are edited, and small. That they run is tried by .ci/run."""

import base64
import importlib.util
import json
import re
import subprocess
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent.parent / "notebooks"
SOURCES = sorted(FOLDER.glob("[0-9]*.py"))
LARGEST = 60_000  # bytes of a picture
each_notebook = pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)


def executed(source):
    """The cells of the notebook with outputs."""
    return json.loads(source.with_suffix(".ipynb").read_text())["cells"]


def outputs(source):
    return [output for cell in executed(source) for output in cell.get("outputs", ())]


def pictures(source):
    data = [output.get("data", {}) for output in outputs(source)]
    return [base64.b64decode(x["image/png"]) for x in data if "image/png" in x]


def test_there_are_notebooks_and_none_without_a_source():
    assert len(SOURCES) >= 8
    assert sorted(FOLDER.glob("*.ipynb")) == [source.with_suffix(".ipynb") for source in SOURCES]


@pytest.mark.needs("jupytext")
@each_notebook
def test_the_notebook_with_outputs_has_the_cells_of_its_source(source):
    import jupytext

    cells = [(cell.cell_type, cell.source) for cell in jupytext.read(source).cells]
    assert [(cell["cell_type"], "".join(cell["source"])) for cell in executed(source)] == cells, "run `make notebooks`"


@each_notebook
def test_every_cell_was_executed_in_order_without_errors_and_warnings(source):
    counts = [cell["execution_count"] for cell in executed(source) if cell["cell_type"] == "code"]
    assert counts == list(range(1, len(counts) + 1))
    assert [o for o in outputs(source) if o["output_type"] == "error" or o.get("name") == "stderr"] == []


@each_notebook
def test_outputs_are_small_pictures_and_text(source):
    found = pictures(source)
    assert len(found) >= 2
    assert max(map(len, found)) <= LARGEST
    assert [output for output in outputs(source) if "text/html" in output.get("data", {})] == []


@each_notebook
def test_outputs_name_no_place_on_the_machine_that_made_them(source):
    text = json.dumps([o.get("text", o.get("data", {}).get("text/plain", "")) for o in outputs(source)])
    assert re.findall(r"/(?:home|root|tmp|work|usr)/", text) == []


@each_notebook
def test_the_first_code_installs_the_package_only_where_it_is_missing(source, monkeypatch):
    first = next(cell for cell in executed(source) if cell["cell_type"] == "code")
    calls = []
    monkeypatch.setattr(subprocess, "run", lambda command, **options: calls.append(command))
    exec("".join(first["source"]), {})
    assert calls == []
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    exec("".join(first["source"]), {})
    assert [command[1:4] for command in calls] == [["-m", "pip", "install"]]
