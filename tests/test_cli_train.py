"""Training at the shell: what it writes, how it stops, how it goes on."""

import contextlib
import csv
import io
import json

import jax
import numpy as np
import pytest

from jaxdrones.cli import main
from jaxdrones.learning import checkpoint, training
from jaxdrones.learning.runs import Run

pytestmark = pytest.mark.float32

SMALL = ["--set", "worlds=4", "--set", "horizon=4", "--set", "sizes=8,", "--set", "duration=0.2"]
TRAIN = ["train", "hover", *SMALL, "--budget", "4", "--episodes", "8"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of a short training, and what it printed."""
    folder = tmp_path_factory.mktemp("runs") / "hover"
    with jax.enable_x64(False), contextlib.redirect_stdout(io.StringIO()) as out:
        assert main([*TRAIN, "--output", str(folder), "--json"]) == 0
    return folder, json.loads(out.getvalue())


def test_training_writes_policies_state_progress_figure_and_report(trained):
    folder, printed = trained
    run = Run(folder)
    assert run.policy("best")(np.zeros((1, 22), np.float32)).shape == (1, 4)
    assert run.policy("last").network.sizes == (8,)
    assert run.recipe().config.worlds == 4 and run.recipe().options == {"duration": 0.2}
    rows = run.history()
    assert [row["update"] for row in rows] == [1, 2, 3, 4]
    assert rows[-1]["steps"] == 4 * 4 * 4 and rows[-1]["success"] == 0 and rows[-1]["seconds"] > 0
    assert (folder / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert len(list(folder.glob("events.out.tfevents.*"))) == 1
    (report,) = printed["seeds"]
    assert report == json.loads((folder / "report.json").read_text())
    assert report["evaluation"]["episodes"] == 8 and len(report["evaluation"]["interval"]) == 2
    assert report["seconds"]["training"] > 0 and report["seconds"]["compiling"] > 0


def test_an_interrupted_training_keeps_the_best_and_goes_on_bit_for_bit(trained, tmp_path, capsys, monkeypatch):
    advance, calls = training.Trainer.advance, []

    def interrupted(self, state, updates):
        calls.append(updates)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return advance(self, state, updates)

    monkeypatch.setattr(training.Trainer, "advance", interrupted)
    folder = tmp_path / "hover"
    assert main([*TRAIN, "--output", str(folder)]) == 130
    said = capsys.readouterr().err
    assert "interrupted at update 2" in said and f"jaxdrones train hover --output {folder} --resume" in said
    assert said.count("\n") == 1
    Run(folder).policy("best")

    assert main([*TRAIN, "--output", str(folder)]) == 2
    assert "go on with --resume" in capsys.readouterr().err
    assert main(["train", "hover", "--output", str(folder), "--resume", "--algo", "ppo"]) == 2
    assert "began with algo bptt, not ppo" in capsys.readouterr().err

    assert main(["train", "hover", "--output", str(folder), "--resume"]) == 0
    whole, _ = trained
    for name in ("state", "last", "best"):
        file = f"{name}.msgpack"
        assert (folder / file).read_bytes() == (whole / file).read_bytes()
    assert without_seconds(folder) == without_seconds(whole)
    capsys.readouterr()
    assert main(["train", "hover", "--output", str(folder), "--resume"]) == 2
    assert "trained to the end" in capsys.readouterr().err


def without_seconds(folder):
    with (folder / "progress.csv").open() as file:
        return [{name: x for name, x in row.items() if name != "seconds"} for row in csv.DictReader(file)]


def test_numbers_that_are_not_finite_stop_training_and_the_best_policy_stays(tmp_path, capsys):
    wild = [*TRAIN, "--set", "learning_rate=1e38", "--no-figure", "--output", str(tmp_path)]
    assert main(wild) == 1
    said = capsys.readouterr().err
    assert "training diverged" in said and "best.msgpack is the best policy" in said and "learning_rate" in said
    for leaf in jax.tree.leaves(Run(tmp_path).policy()):
        assert np.isfinite(leaf).all()


def test_seeds_share_a_program_and_the_best_of_them_is_flown(tmp_path, capsys):
    arguments = ["train", "hover", *SMALL, "--algo", "shac", "--budget", "0.001s", "--episodes", "8", "--seeds", "2"]
    assert main([*arguments, "--seed", "3", "--json", "--output", str(tmp_path)]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [report["seed"] for report in printed["seeds"]] == [3, 4] and printed["best_seed"] in (3, 4)
    assert all(report["updates"] == 1 for report in printed["seeds"])  # the least, when there is no time
    best = checkpoint.load(tmp_path / "best")
    same = checkpoint.load(tmp_path / f"seed-{printed['best_seed']}" / "best")
    jax.tree.map(np.testing.assert_array_equal, best, same)
    assert main(["eval", str(tmp_path), "--episodes", "4"]) == 0
    assert "hover by shac" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "hoover"], "unknown task 'hoover'; did you mean 'hover'"),
        (["train", "hover", "--algo", "pppo"], "unknown algorithm 'pppo'; did you mean 'ppo'"),
        (["train", "hover", "--set", "wrlds=3"], "unknown setting 'wrlds'; did you mean 'worlds'"),
        (["train", "hover", "--set", "worlds=2.5"], "worlds is 2.5; give something like 256"),
        (["train", "hover", "--set", "worlds=0"], "worlds is 0"),
        (["train", "hover", "--set", "worlds"], "give NAME=VALUE"),
        (["train", "hover", "--algo", "ppo", "--set", "worlds=6"], "give a multiple of batches, 8"),
        (["train", "hover", "--budget", "long"], "--budget is 'long'; give updates"),
        (["train", "hover", "--seeds", "0"], "seeds is 0"),
        (["train", "hover", "--resume"], "holds no training to go on with"),
        (["train", "hover", "--output", "file"], "choose another --output"),
        (["eval", "nowhere"], "no checkpoint at nowhere/best"),
        (["fly", "--policy", "nowhere"], "no checkpoint at nowhere/best"),
        (["fly", "--policy", "nowhere", "--drones", "3"], "drones 3 is given beside --policy"),
        (["fly", "--policy", "nowhere", "--backend", "gazebo"], "unknown backend 'gazebo'"),
    ],
)
def test_a_mistake_is_one_line_before_anything_is_trained(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and message in captured.err and captured.err.count("\n") == 1


def test_eval_prints_one_object(trained, capsys):
    folder, _ = trained
    assert main(["eval", str(folder), "--episodes", "8", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["evaluation"]["episodes"] == 8 and printed["recipe"]["task"] == "hover"
    assert set(printed["evaluation"]["error_percentiles"]) == {"50", "95", "99"}


@pytest.mark.needs("pybullet")
def test_a_policy_is_flown_on_either_backend(trained, tmp_path, capsys):
    folder, _ = trained
    logs = []
    for backend in ("explicit", "bullet"):
        output = tmp_path / backend
        arguments = ["fly", "--policy", str(folder), "--backend", backend, "--output", str(output), "--json"]
        assert main([*arguments, *([] if backend == "bullet" else ["--no-figure"])]) == 0
        printed = json.loads(capsys.readouterr().out)
        assert printed["task"] == "hover" and printed["success"] is False and printed["duration"] == pytest.approx(0.2)
        logs.append(np.load(output / "log.npz"))
    assert (tmp_path / "bullet" / "flight.png").read_bytes().startswith(b"\x89PNG")
    assert logs[0]["pos"].shape == (20, 1, 3)
    np.testing.assert_allclose(logs[0]["pos"], logs[1]["pos"], atol=1e-4)  # float32, and no contact
    assert json.loads(str(logs[0]["conditions"]))["run"] == str(folder)


@pytest.mark.needs("pybullet", "imageio_ffmpeg")
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # of imageio-ffmpeg's pipes
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_policy_is_filmed(trained, tmp_path, capsys):
    folder, _ = trained
    film = tmp_path / "film.mp4"
    assert main(["fly", "--policy", str(folder), "--video", str(film), "--no-figure", "--output", str(tmp_path)]) == 0
    assert film.stat().st_size > 1000
    assert "no success: return" in capsys.readouterr().out
