"""The pages name what there is, and what is written on them runs."""

import ast
import importlib
import json
import re
import subprocess

import pytest
from documents import LANGUAGES, PAGES, ROOT, blocks, run_python
from helpers import mostly_slow

from jaxdrones.envs import ACTIONS, OBSERVATIONS, TASKS

IN_TEST_README = ("README.md", "first-ten-minutes.md")
PAGE = (ROOT / "docs" / "environments.md").read_text()


def test_everything_with_a_name_is_on_the_page():
    assert [name for name in [*TASKS, *ACTIONS, *OBSERVATIONS] if f"`{name}`" not in PAGE] == []


def test_every_block_says_what_it_is_and_all_python_is_python():
    for page in PAGES:
        found = blocks(page)
        assert page.read_text().count("```") == 2 * len(found), f"{page.name}: a block is indented, or not closed"
        for block in found:
            assert block.language in LANGUAGES, f"{block.name}: give the language, one of {', '.join(LANGUAGES)}"
            if block.language == "python":
                ast.parse(block.code, filename=block.name)


def test_every_file_that_a_page_names_is_there():
    path = re.compile(r"(?<![\w/])(?:assets|benchmarks|docs|notebooks|tests|\.ci)/[\w./-]*\w")
    missing = [(p.name, name) for p in PAGES for name in path.findall(p.read_text()) if not (ROOT / name).exists()]
    assert missing == []


def test_the_source_of_every_function_that_a_page_shows_is_a_line_of_its_own():
    """Elsewhere the site does not show it (website/hook.py)."""
    for page in PAGES:
        in_text = page.read_text().replace("`<!-- code:", "")  # that of CONTRIBUTING.md, which explains it
        assert in_text.count("<!-- code:") == len(re.findall(r"^<!-- code: \S+ \w+ -->$", in_text, re.M)), page.name


def test_every_commit_of_a_number_is_in_the_history():
    """A commit that was rewritten afterwards reproduces nothing."""
    named = {
        (page.name, commit)
        for page in PAGES
        for found in re.findall(
            r"commits? ([0-9a-f]{7}(?:(?:, | and | \(\"now\"\) and )[0-9a-f]{7})*)", page.read_text()
        )
        for commit in re.findall(r"[0-9a-f]{7}", found)
    }
    assert len(named) > 20
    listed = subprocess.run(["git", "rev-list", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False)
    history = {commit[:7] for commit in listed.stdout.split()}
    missing = {(page, commit) for page, commit in named if commit not in history}
    if missing == named or (ROOT / ".git" / "shallow").exists():
        pytest.skip("the whole history is not here")
    assert missing == set()


@pytest.mark.parametrize(
    "name",
    mostly_slow(
        (str(page.relative_to(ROOT)) for page in PAGES if blocks(page, "python") and page.name not in IN_TEST_README),
        quick=[],
    ),
)
def test_the_python_of_a_page_runs_from_top_to_bottom(name):
    skipped = []
    run_python(ROOT / name, skipped)
    if skipped:
        pytest.skip("; ".join(skipped))


def test_every_result_of_a_training_is_on_the_page_of_a_task():
    """The site's page of a task shows the rows of the table that begin with its name (website/tasks.py)."""
    table = (ROOT / "docs" / "training.md").read_text().partition("| task, learner |")[2].partition("\n\n")[0]
    named = [re.match(r"\| `([\w-]+)`[ ,]", row) for row in table.splitlines()[2:]]
    assert len(named) > 10
    assert {match and match[1] for match in named} <= TASKS.keys()


def test_the_page_of_a_task_names_the_best_pilots_of_the_leaderboard(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "website")
    records = importlib.import_module("records")

    def row(pilot, low, seconds):
        return {"pilot": pilot, "success": low, "interval": (low, 1.0), "seconds to obtain": seconds}

    rows = [row("slow", 0.9, 9.0), row("elsewhere", 0.9, 0.0), row("fast", 0.9, 1.0), row("worse", 0.8, 0.5)]
    assert [found["pilot"] for found in records.best(rows)] == ["fast", "slow", "elsewhere"]
    assert records.best([row("never", 0.0, 1.0)]) == []
    rows = json.loads((ROOT / "benchmarks" / "results" / "leaderboard.json").read_text())["rows"]
    best = max((row for row in rows if row["scenario"] == "eight-3"), key=lambda row: row["interval"][0])
    (shown,) = [line for line in records.section(ROOT, "tracking").splitlines() if line.startswith("| `eight-3`")]
    assert f"| {best['pilot']} | {100 * best['success']:.1f} % of " in shown
    assert records.section(ROOT, "forest") == ""
