"""Trainings killed by the operating system at random moments, and two trainings into one folder.

`KILLS=100 pytest tests/training/test_killed.py` kills as often.
"""

import csv
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from jaxdrones.training.lock import locked
from jaxdrones.training.run import Run

KILLS = int(os.environ.get("KILLS", 4))
CLI = "import sys; from jaxdrones.cli import main; sys.exit(main())"
TRAIN = ["train", "hover", "--set", "worlds=8", "--set", "horizon=8", "--set", "hidden_sizes=16,"]
TRAIN += ["--set", "duration=0.2", "--budget", "4000", "--episodes", "50", "--no-figure"]


def start(*arguments) -> subprocess.Popen:
    output = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, "-c", CLI, *map(str, arguments)], **output)


def finish(process) -> str:
    with process:
        said = process.communicate()[1]
    assert process.returncode == 0, said
    return said


def kill(process, folder: Path, rng: random.Random) -> bool:
    """Kill a process, mostly while it trains, now and then while it starts; whether it lived until then."""
    file, before = folder / "progress.csv", folder.exists() and time.time()
    if rng.random() < 0.85:  # from the rewriting of progress.csv on
        while process.poll() is None and not (file.exists() and file.stat().st_mtime > before):
            time.sleep(0.002)
        time.sleep(rng.choice([rng.uniform(0, 0.05), rng.uniform(0, 1.5)]))
    else:
        time.sleep(rng.uniform(0, 4))
    lived = process.poll() is None
    process.send_signal(signal.SIGKILL)
    with process:
        process.communicate()
    return lived


def numbers(folder: Path):
    with (folder / "progress.csv").open() as file:
        rows = [{name: x for name, x in row.items() if name != "seconds"} for row in csv.DictReader(file)]
    report = json.loads((folder / "report.json").read_text())
    weights = {name: (folder / f"{name}.msgpack").read_bytes() for name in ("best", "last", "state")}
    return rows, weights, report["evaluation"], report["best_update"]


@pytest.mark.slow
def test_a_training_that_is_killed_at_random_moments_has_the_numbers_of_one_that_was_not(tmp_path):
    finish(start(*TRAIN, "--output", tmp_path / "whole"))
    rng, kills, trainings = random.Random(os.environ.get("TEST_SEED", 0)), 0, 0
    while kills < KILLS:
        folder = tmp_path / str(trainings)
        trainings += 1
        for _ in range(rng.randrange(1, 8)):
            process = start(*again(folder))
            kills += kill(process, folder, rng)
        while not Run(folder).finished:
            finish(start(*again(folder)))
        assert numbers(folder) == numbers(tmp_path / "whole"), folder
        left = {file.name for file in folder.iterdir() if ".new" in file.name}
        assert not left
    print(f"{kills} kills in {trainings} trainings")


def again(folder: Path) -> list:
    """The command that starts a training or, as soon as there is a state, continues it."""
    if Run(folder).started:
        return ["train", "hover", "--resume", "--no-figure", "--output", folder]
    return [*TRAIN, "--overwrite", "--output", folder]


def test_a_folder_is_locked_by_one_process_at_a_time_and_free_when_that_is_killed(tmp_path):
    folder = tmp_path / "runs" / "hover"
    hold = "import sys, time; from pathlib import Path; from jaxdrones.training.lock import locked\n"
    hold += f"with locked(Path({str(folder)!r}), print): print('locked', flush=True); time.sleep(100)"
    process = subprocess.Popen([sys.executable, "-c", hold], stdout=subprocess.PIPE, text=True)
    with process:
        assert process.stdout.readline() == "locked\n"
        with pytest.raises(
            ValueError, match=rf"hover is in use by process {process.pid} on .*another --output"
        ) as held:
            with locked(folder, print):
                pass
        assert "\n" not in str(held.value)
        process.kill()
        process.wait()
    assert (folder / ".lock").exists()  # left behind, and nobody's
    with locked(folder, print):
        with pytest.raises(ValueError, match=f"in use by process {os.getpid()} on "), locked(folder, print):
            pass
        assert (folder / ".lock").exists()
        (folder / "progress.csv").touch()
    assert [file.name for file in folder.iterdir()] == ["progress.csv"]


def test_a_lock_leaves_no_empty_folder_and_says_where_it_is_not_possible(tmp_path, monkeypatch):
    with pytest.raises(KeyboardInterrupt), locked(tmp_path / "a" / "b", print):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []

    def no_locks(*_):
        raise OSError(38, "Function not implemented")

    said = []
    monkeypatch.setattr("fcntl.flock", no_locks)
    with locked(tmp_path / "a", said.append):
        pass
    assert said == [f"the file system of {tmp_path / 'a'} has no locks; start no second training into this folder"]
