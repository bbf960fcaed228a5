"""The paper's multi-agent workflow at the shell: `jaxdrones train --library rllib`, and flying what came of it."""

import csv
import json
import subprocess
import sys

import numpy as np
import pytest

import jaxdrones.adapters
from jaxdrones.cli import main

pytestmark = [pytest.mark.float32, pytest.mark.filterwarnings("default")]

RLLIB = ["train", "leader-follower", "--library", "rllib"]
SMALL = ["--set", "worlds=4", "--set", "horizon=8", "--set", "hidden_sizes=8,", "--episodes", "2"]


@pytest.fixture
def without_ray(monkeypatch):
    """As where ray is not installed."""
    for name in list(sys.modules):
        if name.partition(".")[0] == "ray" or name.startswith(
            ("jaxdrones.adapters.rllib", "jaxdrones.training.rllib.")
        ):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.setitem(sys.modules, "ray.rllib", None)
    monkeypatch.delattr(jaxdrones.adapters, "rllib", raising=False)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([*RLLIB, "--algo", "sac"], "unknown algorithm of rllib 'sac' (known: ppo)"),
        (["train", "leader-folower", "--library", "rllib"], "unknown task 'leader-folower'"),
        ([*RLLIB, "--budget", "long"], "--budget is 'long'; give updates, for example 300"),
        ([*RLLIB, "--set", "gae_lamda=1"], "unknown setting 'gae_lamda'; did you mean 'gae_lambda'"),
        ([*RLLIB, "--set", "worlds=0"], "worlds is 0"),
        ([*RLLIB, "--set", "library=sb3"], "--set library is not a setting of a learner"),
        ([*RLLIB, "--resume"], "--resume is given with --library rllib"),
        ([*RLLIB, "--hosts", "2", "--host", "0", "--coordinator", "a:1"], "--library rllib trains on one host"),
        (RLLIB, 'RLlib is not installed; pip install "ray[rllib]==2.60.0" torch'),
    ],
)
def test_a_mistake_is_one_line_before_ray_is_loaded(arguments, message, without_ray, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and message in captured.err and captured.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_run_is_flown_and_evaluated_without_ray(tmp_path, capsys):
    pytest.importorskip("ray.rllib")
    train = [*RLLIB, *SMALL, "--budget", "2", "--output", str(tmp_path), "--json"]
    assert main(train) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [seed["updates"] for seed in printed["seeds"]] == [2]
    files = ("best.msgpack", "best.json", "last.msgpack", "progress.csv", "curve.png", "report.json", "rllib")
    assert all((tmp_path / name).exists() for name in files)
    without = "import sys; sys.modules['ray'] = sys.modules['torch'] = None; from jaxdrones.cli import main; "
    for command in (["eval", str(tmp_path), "--episodes", "2"], ["fly", "--policy", str(tmp_path)]):
        done = subprocess.run(
            [sys.executable, "-c", f"{without}raise SystemExit(main({command}))"], capture_output=True, text=True
        )
        assert done.returncode == 0 and "leader-follower by rllib ppo" in done.stdout, done.stderr
    assert (tmp_path / "flight" / "flight.png").stat().st_size > 0
    assert main(train) == 2
    assert "holds a finished training; replace it with --overwrite" in capsys.readouterr().err
    assert main([*train, "--overwrite", "--no-figure"]) == 0


@pytest.mark.slow
def test_leader_and_follower_learn_to_fly_near_their_set_points(tmp_path, capsys):
    """After a quarter of the preset's updates, which end within 5 cm (docs/rllib.md)."""
    pytest.importorskip("ray.rllib")
    assert main([*RLLIB, "--budget", "50", "--episodes", "2", "--output", str(tmp_path), "--json"]) == 0
    (seed,) = json.loads(capsys.readouterr().out)["seeds"]
    assert seed["evaluation"]["mean_return"] > -2.5 and seed["evaluation"]["final_error"] < 0.2
    rows = list(csv.DictReader((tmp_path / "progress.csv").read_text().splitlines()))
    assert len(rows) == 50 and float(rows[-1]["steps"]) == 50 * 128 * 128 * 2
    assert main(["fly", "--policy", str(tmp_path), "--no-figure"]) == 0
    with np.load(tmp_path / "flight" / "log.npz") as log:
        assert (np.abs(log["pos"][-1, :, 2] - 0.5) < 0.2).all()
