"""The history of speed, and the comparison with another commit."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import against, track
from benchmarks.server import definitions

ROOT = Path(__file__).parent.parent
ROWS = [{"name": "plant", "unit": "ns a drone-step", "median": 4.0, "spread": 0.5, "definition": "..."}]


def result(*options: str) -> dict:
    command = [sys.executable, "-m", "benchmarks", "track", "--json", *options]
    return json.loads(subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout)


def test_a_row_is_slower_only_if_it_lost_every_round():
    assert against.losers({"all": [0.6, 0.5, 0.69], "two": [0.6, 0.5, 0.71], "too few": [0.1, 0.1]}) == ["all"]


def test_a_commit_has_one_line_for_each_machine(tmp_path):
    history, figure = tmp_path / "track.jsonl", tmp_path / "track.png"
    track.keep(ROWS, history, figure)
    other = json.loads(history.read_text()) | {"machine": {"cpu": "another"}}
    history.write_text(history.read_text() + json.dumps(other) + "\n")
    track.keep([ROWS[0] | {"median": 5.0}], history, figure)
    first, second = map(json.loads, history.read_text().splitlines())
    assert first["machine"] == {"cpu": "another"} and first["rows"] == ROWS
    assert second["commit"] == first["commit"] and second["rows"][0]["median"] == 5.0
    assert set(second["machine"]) == {"cpu", "cores", "device"}
    assert set(second["versions"]) == {"jax", "jaxlib", "python"}
    assert figure.stat().st_size > 1000


def test_a_commit_that_is_not_there_is_not_checked_and_does_not_fail():
    found, lines = against.main("no-such-commit", [], budget=1.0)
    assert "failed" not in found and lines[0].startswith("NOT CHECKED: speed against no-such-commit: ")


def test_a_comparison_without_time_does_not_fail():
    found, lines = against.main("HEAD", [], budget=0.0)
    assert "failed" not in found and all("NOT CHECKED" in line for line in lines)


@pytest.mark.slow
def test_quick_measures_a_program_and_keeps_nothing():
    before = track.HISTORY.read_text()
    (row,) = result("--quick")["rows"]
    assert row["definition"] == definitions()[row["name"]] and row["median"] > 0
    assert track.HISTORY.read_text() == before


@pytest.mark.slow
def test_a_commit_is_compared_in_every_round_or_the_reason_is_said():
    found = result("--quick", "--against", "HEAD", "--only", "plant by vmap")
    assert set(found["ratios"]) | set(found.get("missing", ())) <= {"plant by vmap"}
    assert all(len(rounds) == against.ROUNDS for rounds in found["ratios"].values())
    assert found["ratios"] or any("NOT CHECKED" in line for line in found["lines"])
