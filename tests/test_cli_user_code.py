"""Tasks, vehicles and policies of a user at the shell; trainings that say what is not known and what failed."""

import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import jax
import pytest
from documents import ROOT, blocks

from jaxdrones import assets
from jaxdrones.cli import main
from jaxdrones.cli.train_output import warn_of_failure
from jaxdrones.envs import TASKS
from jaxdrones.learning.evaluation import Report
from jaxdrones.training import trainer
from jaxdrones.training.presets import default_algorithm, settings_known
from jaxdrones.training.run import Run

pytestmark = pytest.mark.float32

SMALL = "--set worlds=2 --set horizon=2 --set hidden_sizes=4, --set duration=0.1 --budget 2 --episodes 4"
RESUMED = "--no-figure"
MORE = {  # command of a page -> what makes it short
    "explain my_task.py:moving_box": "",
    "train my_task.py:moving_box --set period=6.0": SMALL,
    "eval runs/moving_box": "--episodes 4",
    "fly --policy runs/moving_box": "--no-figure",
    "view runs/moving_box": "",
    "train my_task.py:moving_box --resume --budget 100": RESUMED,
    "fly circle --vehicle mine.urdf": "--duration 0.2",
    "explain hover --vehicle mine.urdf": "",
    "train hover --vehicle mine.urdf": SMALL,
    "eval runs/hover": "--episodes 4",
    "fly --policy runs/hover": "--no-figure",
    "train hover --vehicle mine.urdf --resume --budget 50": RESUMED,
    "eval my_policy.py:policy --task hover --set action=position --set reach=0.5 --set tilt=20": "--episodes 4",
    "fly --policy my_policy.py:policy --task hover --set action=position --backend bullet": "--no-figure",
    "demo --policy my_policy.py:policy --set action=position --set reach=0.5 --set tilt=20": "--no-open",
    "eval any-vehicle --task hover --realistic any": "--episodes 4",
    "eval raptor --task hover --vehicle x500": "--episodes 4",
}


@pytest.fixture
def here(tmp_path, monkeypatch):
    """The folder in which a user is, with the files of the pages."""
    monkeypatch.chdir(tmp_path)
    for name, page in (("my_task.py", "own-task.md"), ("my_policy.py", "own-policy.md")):
        Path(name).write_text(blocks(ROOT / "docs" / page, "python")[0].code)
    Path("mine.urdf").write_text(assets.vehicles()["cf2x"].read_text().replace('value="0.027"', 'value="0.032"'))
    with jax.numpy_rank_promotion("allow"):  # as users have JAX
        yield tmp_path


def commands(page: str) -> list[str]:
    lines = [line for block in blocks(ROOT / "docs" / page, "sh") for line in block.code.splitlines()]
    return [line.removeprefix("jaxdrones ") for line in lines]


PAGES = ("own-task.md", "own-vehicle.md", "own-policy.md")


def test_every_command_of_the_pages_is_tried():
    assert [command for page in PAGES for command in commands(page)] == list(MORE)


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [*PAGES[:2], pytest.param(PAGES[2], marks=pytest.mark.needs("pybullet", "foundation_policy"))]
)
def test_the_commands_of_a_page_run_also_where_the_files_are_gone(page, here, capsys):
    for command in commands(page):
        if "--policy runs" in command or command.startswith("eval runs"):
            for file in here.glob("m*.*"):  # the run keeps their texts
                file.rename(file.with_suffix(".moved"))
        assert main([*command.split(), *MORE[command].split()]) == 0, capsys.readouterr().err
        printed = capsys.readouterr().out
        if command.startswith("explain hover"):
            assert "0.032 kg" in printed
        elif "my_task" in command or "moving_box" in command:
            assert "moving_box" in printed or "moving-box" in printed


@pytest.mark.slow
def test_a_run_of_user_files_refuses_what_has_changed(here, capsys):
    train = ["train", "my_task.py:moving_box", "--vehicle", "mine.urdf", "--no-figure"]
    assert main([*train, *SMALL.split()]) == 0
    run = Run("runs/moving_box")
    assert set(run.recipe().files) == {"my_task.py", "mine.urdf"}
    assert str(here) not in Path(run.folder, "best.json").read_text()
    task = Path("my_task.py").read_text()
    for name, text in (("my_task.py", task + "\n# edited\n"), ("mine.urdf", "edited")):
        before = Path(name).read_text()
        Path(name).write_text(text)
        capsys.readouterr()
        assert main([*train, "--resume", "--budget", "1"]) == 2
        assert f"{name} has changed since runs/moving_box was started" in capsys.readouterr().err
        Path(name).write_text(before)
    shutil.move("runs/moving_box", "moved")
    Path("my_task.py").unlink()
    assert main([*train, "--resume", "--budget", "1", "--output", "moved"]) == 0
    assert Run("moved").report()["updates"] == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["eval", "my_policy.py:policy"], "--task is missing; give the task for my_policy.py:policy"),
        (["eval", "my_policy.py:pol", "--task", "hover"], "defines no 'pol'; did you mean 'policy'?"),
        (["eval", "my_policy.py", "--task", "hover"], "give my_policy.py:NAME"),
        (
            ["eval", "my_task.py:HEIGHT", "--task", "hover"],
            "my_task.py:HEIGHT is 1.5; give a function from",
        ),
        (["eval", "runs/hover", "--task", "hover"], "--task is given beside the run runs/hover"),
        (["eval", "runs/hover", "--set", "drones=2"], "--set drones is given beside the run runs/hover"),
        (["eval", "runs/hover", "--vehicle", "hb"], "--vehicle is given beside the run runs/hover"),
        (["fly", "--policy", "my_policy.py:policy"], "--task is missing"),
        (
            ["fly", "--policy", "my_policy.py:policy", "--task", "hover", "--set", "vehicle=hb"],
            "--set vehicle=hb is given; give --vehicle hb in its place",
        ),
        (["fly", "--policy", "runs/hover", "--set", "reach=1"], "--set reach is given beside the run runs/hover"),
        (["fly", "circle", "--task", "hover"], "--task hover is given without --policy file.py:name"),
        (["fly", "circle", "--set", "drones=2"], "--set drones=2 is given without --policy file.py:name"),
        (["train", "my_task.py"], "give my_task.py:NAME"),
        (["train", "my_task.py:moving_box", "--set", "perod=3"], "did you mean 'period'"),
        (["train", "hover", "--vehicle", "cf2x", "--set", "vehicle=hb"], "vehicle=hb is given beside --vehicle"),
        (["train", "hover", "--vehicle", "missing.urdf"], "missing.urdf: cannot be read"),
        (["train", "my_task.py:moving_box", "--resume"], "runs/moving_box holds no training to continue"),
        (["explain", "missing.py:f"], "missing.py: cannot be read"),
        (["fly", "circle", "--controller", "my_policy.py"], "my_policy.py defines no 'gains'"),
        (["compare", "circle", "--controllers", "pid,old/pid.py"], "two controllers named 'pid'; rename one"),
    ],
)
def test_a_mistake_with_user_files_is_one_line(arguments, message, here, capsys):
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.err.count("\n") == 1 and captured.out == ""
    assert not (here / "runs").exists()


def test_a_user_policy_of_a_wrong_shape_is_refused(here, capsys):
    Path("my_policy.py").write_text("def policy(obs):\n    return obs[:, :2]\n")
    assert main(["eval", "my_policy.py:policy", "--task", "hover", "--episodes", "2"]) == 2
    said = capsys.readouterr().err
    assert "my_policy.py:policy returns an array (1, 2) of float32; return actions of shape (1, 4)" in said


def test_a_least_success_of_a_task_without_a_criterion_is_refused_before_the_evaluation(here, capsys, monkeypatch):
    monkeypatch.setattr("jaxdrones.cli.evaluate.evaluate", lambda *_: pytest.fail("evaluated"))
    command = ["eval", "my_policy.py:policy", "--task", "fly-through-gate", "--fail-below", "0.9"]
    assert main(command) == 2
    assert (
        "--fail-below 0.9 is given, and the task has no criterion of success; leave it out" in capsys.readouterr().err
    )


def test_an_evaluation_that_is_not_finite_fails(here, capsys, monkeypatch):
    nan = float("nan")
    errors, metrics = dict.fromkeys((50, 95, 99), nan), {"error": nan, "speed": nan}
    report = Report(2, 2, 2, 0.0, (0.0, 0.66), nan, errors, nan, nan, 0.01, {"lost": 1.0}, metrics)
    monkeypatch.setattr("jaxdrones.cli.evaluate.evaluate", lambda *_: report)
    Path("my_policy.py").write_text("def policy(obs):\n    return obs[:, :4] * float('nan')\n")
    assert main(["eval", "my_policy.py:policy", "--task", "hover"]) == 1
    assert "the mean return is not finite" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(("task", "warned"), [("hover", False), ("room", False), ("takeoff", True)])
def test_a_training_without_known_settings_says_so_before_it_starts(task, warned, tmp_path, capsys, monkeypatch):
    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(trainer.Trainer, "compile", interrupted)
    small = ["--set", "worlds=2", "--set", "horizon=2"]
    assert main(["train", task, *small, "--no-figure", "--output", str(tmp_path)]) == 130
    said = capsys.readouterr().err
    assert (f"warning: there are no tuned settings for bptt on {task}; if it fails" in said) == warned
    assert said.count("\n") == 1 + warned


def test_settings_are_known_for_what_the_tables_name():
    known = {task for task in TASKS if settings_known(task, default_algorithm(task))}
    assert {"hover", "landing", "tracking", "recovery", "gates", "forest", "follow", "flock"} <= known
    assert {"crowd", "room", "swap-goals", "wake", "race"} <= known and "takeoff" not in known
    assert settings_known("hover", "ppo") and settings_known("hover", "shac") and not settings_known("landing", "ppo")


@pytest.mark.parametrize(
    ("best", "successes", "criterion", "said"),
    [
        (
            0,
            3,
            True,
            r"nothing was learned, the best policy is the first one, of update 0 \(30\.0 % success\)",
        ),
        (20, 0, True, r"the best policy succeeds in 0 of 10 episodes; try --seeds 3"),
        (20, 0, False, None),
        (20, 4, True, None),
    ],
)
def test_a_training_that_failed_says_so_in_one_line(best, successes, criterion, said, capsys):
    run = SimpleNamespace(folder=Path("runs/x"))
    evaluation = (
        {"success": successes / 10, "successes": successes} if criterion else dict(success=None, successes=None)
    )
    evaluation |= {"episodes": 10}
    warn_of_failure(run, {"best_update": best, "evaluation": evaluation})
    err = capsys.readouterr().err
    assert err == "" if said is None else re.match(f"jaxdrones: warning: runs/x: {said}.*\n$", err)
