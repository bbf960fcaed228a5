"""The paper's workflow at the shell: `jaxdrones train --library sb3`, and flying what came of it."""

import csv
import json
import sys

import numpy as np
import pytest

import jaxdrones.adapters
import jaxdrones.training
from jaxdrones.cli import main

pytestmark = pytest.mark.float32

SB3 = ["train", "hover", "--library", "sb3"]
SMALL = ["--set", "net_arch=16,", "--set", "worlds=4", "--set", "n_steps=8", "--episodes", "2"]


@pytest.fixture
def without_sb3(monkeypatch):
    """As where Stable-Baselines3 is not installed."""
    for name in list(sys.modules):
        if name.partition(".")[0] == "stable_baselines3":
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    for package, name in ((jaxdrones.adapters, "sb3"), (jaxdrones.training, "stable_baselines")):
        monkeypatch.delitem(sys.modules, f"{package.__name__}.{name}", raising=False)
        monkeypatch.delattr(package, name, raising=False)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "hover", "--library", "sb4"], "unknown library 'sb4'; did you mean 'sb3'"),
        ([*SB3, "--algo", "bptt"], "unknown algorithm of sb3 'bptt' (known: a2c, ppo, sac)"),
        (["train", "hoover", "--library", "sb3"], "unknown task 'hoover'"),
        ([*SB3, "--budget", "long"], "--budget is 'long'; give control steps, for example 100000"),
        ([*SB3, "--episodes", "0"], "episodes is 0"),
        ([*SB3, "--set", "worlds"], "give NAME=VALUE"),
        ([*SB3, "--resume"], "--resume is given with --library sb3"),
        ([*SB3, "--seeds", "2"], "--seeds 2 is given with --library sb3"),
        (SB3, 'stable-baselines3 is not installed; pip install "jaxdrones[sb3]"'),
    ],
)
def test_a_mistake_is_one_line_before_sb3_is_loaded(arguments, message, without_sb3, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and message in captured.err and captured.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_model_of_sb3_names_the_extra_it_is_flown_with(without_sb3, capsys, tmp_path):
    (tmp_path / "best.zip").touch()
    for command in (["fly", "--policy", str(tmp_path)], ["eval", str(tmp_path)]):
        assert main(command) == 2
        assert 'pip install "jaxdrones[sb3]"' in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "n_stepz=3"], "unknown setting 'n_stepz'; did you mean 'n_steps'"),
        (["--set", "gama=1"], "unknown setting 'gama'; did you mean 'gamma'"),
        (["--set", "n_steps=2.5"], "n_steps is 2.5; give something like 2048"),
        (["--set", "worlds=0"], "worlds is 0"),
        (["--set", "batch_size=1"], "do not fit sb3 ppo"),
        (["--set", "drones=0"], "drones"),
    ],
)
def test_a_setting_that_sb3_or_the_environment_lacks_is_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    assert main([*SB3, *arguments]) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("task", ["hover", "hover-2021", "leader-follower"])
def test_the_task_that_is_named_is_the_one_that_is_trained(task, capsys, tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3")
    from jaxdrones.training import stable_baselines_trainer

    def interrupted(self, recipe, *_):
        assert recipe.env().task.name == task
        raise KeyboardInterrupt

    monkeypatch.setattr(stable_baselines_trainer.SB3Trainer, "__init__", interrupted)
    assert main(["train", task, "--library", "sb3", "--no-figure", "--output", str(tmp_path)]) == 130
    assert capsys.readouterr().out.startswith(f"{task} by sb3 ppo: ")


@pytest.mark.needs("pybullet", "stable_baselines3")
@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "settings"),
    [
        ("ppo", ["--budget", "60000", "--set", "learning_rate=1e-3"]),
        ("a2c", ["--budget", "120000", "--set", "learning_rate=1e-3"]),
        ("sac", ["--budget", "10000", "--set", "learning_rate=1e-3"]),
    ],
)
def test_the_papers_learners_climb_to_the_goal_and_fly_there_on_both_backends(algorithm, settings, tmp_path, capsys):
    small = ["--set", "net_arch=64,64", "--episodes", "2", "--json", "--output", str(tmp_path)]
    assert main(["train", "hover-2021", "--library", "sb3", "--algo", algorithm, *settings, *small]) == 0
    printed = json.loads(capsys.readouterr().out)
    for name in ("best.zip", "last.zip", "progress.csv", "curve.png", "report.json"):
        assert (tmp_path / name).stat().st_size > 0
    first = next(csv.DictReader((tmp_path / "progress.csv").read_text().splitlines()))
    returned = printed["seeds"][0]["evaluation"]["mean_return"]
    assert returned > float(first["evaluated_return"]) + 30  # to stay on the ground gives -191, an optimal climb -27
    for backend in ("explicit", "bullet"):
        flight = ["fly", "--policy", str(tmp_path), "--backend", backend, "--json"]
        assert main([*flight, *(["--no-figure"] if backend == "bullet" else [])]) == 0
        flown = json.loads(capsys.readouterr().out)
        assert flown["algorithm"] == f"sb3 {algorithm}" and flown["backend"] == backend
        with np.load(tmp_path / "flight" / "log.npz") as log:
            assert log["rpm"].std(axis=-1).max() < 1e-2  # RPM; all four motors turn alike
    assert (tmp_path / "flight" / "flight.png").stat().st_size > 0


@pytest.mark.slow
def test_an_interrupted_training_keeps_the_best_and_is_not_replaced_unasked(tmp_path, capsys, monkeypatch):
    pytest.importorskip("stable_baselines3")
    from jaxdrones.training import stable_baselines_trainer

    def interrupted(self):
        raise KeyboardInterrupt

    train = [*SB3, *SMALL, "--set", "batch_size=32", "--budget", "64", "--no-figure", "--output", str(tmp_path)]
    monkeypatch.setattr(stable_baselines_trainer._Callback, "_on_rollout_end", interrupted)
    assert main(train) == 130
    assert "best.zip is the best policy, of update 0" in capsys.readouterr().err
    monkeypatch.undo()
    assert main(train) == 2
    assert "did not finish; replace it with --overwrite" in capsys.readouterr().err
    assert main([*train, "--overwrite"]) == 0
    assert json.loads((tmp_path / "report.json").read_text())["updates"] == 2
    capsys.readouterr()
    assert main(train) == 2
    assert (
        "holds a finished training; replace it with --overwrite, or choose another --output" in capsys.readouterr().err
    )
    assert main(["eval", str(tmp_path), "--episodes", "2", "--last"]) == 0
    assert "policy of update 2" in capsys.readouterr().out


@pytest.mark.slow
def test_numbers_that_are_not_finite_stop_training_and_the_best_policy_stays(tmp_path, capsys):
    pytest.importorskip("stable_baselines3")
    wild = ["--set", "learning_rate=1e20", "--set", "batch_size=32", "--budget", "320"]
    assert main([*SB3, *SMALL, *wild, "--no-figure", "--output", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert "training diverged" in said and "best.zip is the best policy" in said
    assert main(["eval", str(tmp_path), "--episodes", "2"]) == 0


@pytest.mark.slow
def test_a_time_budget_ends_training_and_a_seed_repeats_it(tmp_path, capsys):
    pytest.importorskip("stable_baselines3")
    train = [*SB3, *SMALL, "--set", "batch_size=32", "--no-figure", "--json", "--seed", "3"]
    assert main([*train, "--budget", "0.001s", "--output", str(tmp_path / "least")]) == 0
    (least,) = json.loads(capsys.readouterr().out)["seeds"]
    assert least["updates"] == 1 and least["seed"] == 3
    rows = []
    for name in ("first", "second"):
        assert main([*train, "--budget", "128", "--output", str(tmp_path / name)]) == 0
        (report,) = json.loads(capsys.readouterr().out)["seeds"]
        lines = (tmp_path / name / "progress.csv").read_text().splitlines()
        rows.append([line.split(",")[:2] + line.split(",")[3:] for line in lines])  # without the seconds
        assert report["steps"] == 128
    assert rows[0] == rows[1]
