"""What a run keeps of a user's files."""

import json
import os
import re
from pathlib import Path

import jax
import numpy as np
import pytest
from documents import ROOT, blocks

import jaxdrones as jd
from jaxdrones import assets, user_code
from jaxdrones.cli import main
from jaxdrones.learning import Policy
from jaxdrones.training import user_files
from jaxdrones.training.recipe import Recipe
from jaxdrones.training.run import Run

TASK = blocks(ROOT / "docs" / "own-task.md", "python")[0].code
URDF = assets.vehicles()["cf2x"].read_text().replace('mass value="0.027"', 'mass value="0.032"')


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A folder with a task and a vehicle of a user, in which the user is."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_task.py").write_text(TASK)
    (tmp_path / "mine.urdf").write_text(URDF)
    with jax.numpy_rank_promotion("allow"):
        yield tmp_path


@pytest.mark.slow
def test_a_recipe_keeps_the_texts_and_flies_them_when_the_files_are_gone(files, tmp_path_factory, monkeypatch):
    recipe = Recipe.of(str(files / "my_task.py:moving_box"), vehicle="mine.urdf", period=3.0, worlds=8)
    assert recipe.task == "my_task.py:moving_box" and recipe.options == {"vehicle": "mine.urdf", "period": 3.0}
    entries = json.loads(json.dumps(recipe.as_dict()))
    assert str(files) not in json.dumps(entries)
    (files / "my_task.py").unlink()
    (files / "mine.urdf").write_text("of another vehicle")
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    again = Recipe.from_dict(entries)
    assert again == recipe
    env = again.env()
    assert env.task.name == "moving-box" and float(env.params.mass[0]) == pytest.approx(0.032)
    phase = env.reset(jax.random.key(0))[1].variables
    fast = env.task.target(phase, 0.0).vel, jd.make(recipe_task(), period=6.0).task.target(phase, 0.0).vel
    np.testing.assert_allclose(fast[0], 2 * fast[1], rtol=1e-6)


def recipe_task():
    return user_code.definition("my_task.py", TASK, "moving_box")


def test_a_recipe_of_the_registry_keeps_no_files():
    assert "files" not in Recipe.of("hover").as_dict()


def test_kept_files_stand_in_for_those_that_are_gone_and_changed_ones_are_refused(files):
    kept = {"my_task.py": TASK, "mine.urdf": URDF}
    (files / "my_task.py").unlink()
    assert user_files.take_task("my_task.py:moving_box", kept) == ("my_task.py:moving_box", {"my_task.py": TASK})
    (files / "mine.urdf").write_text(URDF.replace("0.032", "0.033"))
    _, found = user_files.take_vehicle({"vehicle": "mine.urdf"}, kept)
    with pytest.raises(ValueError, match=r"mine\.urdf has changed since runs/x was started; undo the change"):
        user_files.check_unchanged(Path("runs/x"), kept, found)
    user_files.check_unchanged(Path("runs/x"), kept, {"my_task.py": TASK})


@pytest.mark.parametrize("command", ["eval", "fly --policy", "view --history", "train evil.py:task --resume --output"])
def test_code_of_a_run_is_announced_where_it_is_opened_before_it_is_executed(command, tmp_path, capsys):
    policy = Policy.init(jax.random.key(0), jd.make("hover"), (4,))
    recipe = Recipe.of("hover").as_dict() | {"task": "evil.py:task", "files": {"evil.py": "raise ValueError('done')"}}
    about = {"recipe": recipe, "run_id": "1", "seed": 0, "episodes": 8, "update": 1}
    run = Run(tmp_path)
    for name in "best", "last":
        run.save_policy(name, policy, **about)
    run.save_state(policy, **about)
    run.keep_policy(policy, **about)
    assert main([*command.split(), str(tmp_path)]) == 2
    assert re.search("holds evil.py, which is executed.*\n.*evil.py: line 1 raises .*done", capsys.readouterr().err)


def test_a_task_of_a_file_is_made_with_its_options(files):
    env = jd.make("my_task.py:moving_box", drones=2, duration=1.0)
    assert env.drones == 2 and env.steps == 100 and env.task.name == "moving-box"


@pytest.mark.parametrize(
    ("reference", "text", "message"),
    [
        ("my_task.py", "", r"my_task\.py names only a file; give my_task\.py:NAME"),
        ("my_task.py:", "", r"give my_task\.py:NAME"),
        ("missing.py:moving_box", "", r"missing\.py: cannot be read \(No such file or directory\)"),
        (
            "my_task.py:moving_bax",
            TASK,
            r"no 'moving_bax'; did you mean 'moving_box'\? \(it defines moving_box\)",
        ),
        ("my_task.py:HEIGHT", TASK, r"my_task\.py:HEIGHT: 1\.5 is not a function"),
        ("my_task.py:f", "x = 1\ny = x / 0", r"my_task\.py: line 2 raises ZeroDivisionError: division by zero"),
        ("my_task.py:f", "def f(:", r"my_task\.py: line 1 raises SyntaxError: "),
        (
            "my_task.py:f",
            "import helpers_of_mine",
            r"ModuleNotFoundError: .*; your file may import lib",
        ),
        ("my_task.py:f", "def f():\n    return 3", r"my_task\.py:f returned 3; return a jaxdrones\.tasks\.Task"),
        ("my_task.py:f", "def f(a: int = 3):\n    return a", r"got an unexpected keyword argument 'period'"),
    ],
)
def test_a_mistake_in_a_file_is_one_line(reference, text, message, files):
    (files / "my_task.py").write_text(text)
    options = {"period": 3.0} if "(a: int" in text else {}
    with pytest.raises((ValueError, TypeError), match=message) as error:
        jd.make(reference, **options)
    assert "\n" not in str(error.value)


def test_a_file_with_dataclasses_and_late_annotations_is_executed():
    text = "from __future__ import annotations\nimport dataclasses\n@dataclasses.dataclass\nclass A:\n    x: int = 3\n"
    assert user_code.definition("mine.py", text, "A")().x == 3
    assert user_code.definition("mine.py", text, "A") is user_code.definition("mine.py", text, "A")
    assert os.path.basename(user_code.split_reference("a/b.py:c")[0]) == "b.py"


def test_a_file_is_executed_as_python_executes_it():
    text = "def f(a: 1 + 1): ...\nkind = f.__annotations__['a']\n"
    assert (
        user_code.definition("plain.py", text, "kind") == 2
    )  # not the text of an annotation, as in the library's files
