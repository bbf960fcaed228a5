"""What the README and the pages say runs: the README's Python from top to bottom, and every command, in short form."""

import re
import tomllib
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from documents import PAGES, ROOT, blocks, run_python

from jaxdrones.cli import main
from jaxdrones.training.trainer import Trainer

ELSEWHERE = {  # page -> the tests that try its commands
    "docs/export.md": "tests/export/test_page.py",
    "docs/firmware.md": "tests/firmware/test_cli_firmware.py",
    "docs/leaderboard.md": "tests/test_leaderboard.py",
    "docs/own-policy.md": "tests/test_cli_user_code.py",
    "docs/own-task.md": "tests/test_cli_user_code.py",
    "docs/own-vehicle.md": "tests/test_cli_user_code.py",
    "docs/reality.md": "tests/flights/test_fit.py",
    "docs/ros2.md": "tests/ros2/test_cli_ros2.py",
    "docs/viewer.md": "tests/visualization/test_viewer.py",
}
BLOCKS = [
    block
    for page in PAGES
    if str(page.relative_to(ROOT)) not in ELSEWHERE
    for block in blocks(page, "sh")
    if not block.reason
]


@pytest.mark.slow
def test_the_python_of_the_readme_runs_from_top_to_bottom():
    names = run_python(ROOT / "README.md", [])
    assert (names["slope"] < 0).all()  # heavier drones fall
    assert names["heights"].shape == (1000,)
    assert (np.diff(names["heights"]) < 0).all()


@pytest.mark.slow
def test_the_python_of_the_first_ten_minutes_runs_from_top_to_bottom():
    names = run_python(ROOT / "docs" / "first-ten-minutes.md", [])
    assert names["trajectory"].pos.shape == (1440, 4, 3)
    assert names["many"][1].pos.shape == (100, 1440, 4, 3)
    assert np.isfinite(names["d_mass"])


class Short(NamedTuple):
    """How a command is tried, and what it prints."""

    prints: str
    """Patterns, which `...` joins: one after the other, with anything between."""
    more: str = ""
    """Arguments that make it short."""
    needs: tuple[str, ...] = ()
    """Optional libraries."""


FLIGHT, TRAINING = "--duration 0.2", "--set worlds=8 --set horizon=4 --budget 2 --episodes 8"
BULLET, FILM = ("pybullet",), ("pybullet", "imageio_ffmpeg")
LOGGED = r"wrote \S+/log\.npz, \S+/flight\.png"
TRAINED = "compiled in ... trained in ... success ... wrote runs/ ... /best.msgpack, ... /report.json ... fly it: "
FLIGHTS = {
    "fly circle": Short(f"circle: 4 x cf2x, pid at 120 Hz ... drone 3 ... {LOGGED}", FLIGHT),
    "fly circle --drones 4 --output runs/circle": Short(
        "circle: 4 x cf2x ... wrote runs/circle/log.npz, runs/circle/flight.png", FLIGHT
    ),
    "fly velocity": Short(f"velocity: 4 x cf2x ... {LOGGED}", FLIGHT),
    "fly ground-effect": Short(f"ground-effect: 2 x cf2x ... {LOGGED}", FLIGHT),
    "fly downwash": Short(f"downwash: 2 x cf2x ... {LOGGED}", FLIGHT),
    "fly circle --drones 8 --vehicle racer --effects drag,downwash --duration 20 --json": Short(
        r'"vehicle": "racer", "drones": 8, "effects": \["drag", "downwash"\]', FLIGHT
    ),
    "fly circle --backend bullet --obstacles --video circle.mp4": Short(
        "circle: 4 x cf2x ... Bullet at 240 Hz ... wrote .*circle.mp4", FLIGHT, FILM
    ),
    "compare circle": Short(r"circle: explicit against bullet ... t \(s\)  position ... 0\.20 ", FLIGHT, BULLET),
    "compare circle --output runs/compare": Short(
        r"circle: explicit against bullet ... wrote runs/compare/explicit/log\.npz, .*/compare\.png", FLIGHT, BULLET
    ),
    "compare circle --controllers pid,geometric,lqr --output runs/controllers": Short(
        r"circle: pid, geometric, lqr, largest ... lqr +0\.\d+ ... wrote runs/controllers/pid/log\.npz", FLIGHT
    ),
    "explain hover": Short(
        "hover: fly to the goal ... x of the target, from the drone +m +world ... speed of rotor 0 +RPM ... position "
        "+-1 ... lost ... semi_implicit_euler ... 0.027 kg"
    ),
    "demo": Short(r"wrote runs/demo\.html \(2\.\d MB\)", "--no-open"),
    "fly circle --controller my_controller.py": Short(rf"circle: 4 x cf2x, my_controller\.py ... {LOGGED}", FLIGHT),
    "compare circle --controllers geometric,my_controller.py": Short(
        r"circle: geometric, my_controller, largest ... my_controller +0\.\d+", FLIGHT
    ),
    "list": Short("flights +circle, velocity ... vehicles +agilicious, bebop, cf21, cf21_brushless"),
}
FLIGHTS |= {
    "fly circle --controller lqr": Short(f"circle: 4 x cf2x, lqr ... {LOGGED}", FLIGHT),
    "doctor": Short("versions ... devices ... self-test"),
    "bench": Short("jaxdrones", "--worlds 64 --seconds 1"),
}
QUICK = ("list", "explain hover")
TRAININGS = {
    "train hover": Short(TRAINED, TRAINING),
    "train leader-follower --algo ppo --seeds 3 --budget 60s": Short(
        TRAINED.replace("trained", "seed 2:\ntrained"), TRAINING
    ),
    "train gates --set level=2": Short(f"gates by ppo, level 2: ... {TRAINED}", TRAINING),
    "train gates --stop-at 0.99 --output runs/stopped": Short(TRAINED, f"{TRAINING} --episodes 400"),
    "train tracking --realistic --set period=5 --set worlds=512": Short(TRAINED, TRAINING),
    "train hover --realistic any --output runs/any": Short(
        f"hover by bptt, realistic, any vehicle: ... {TRAINED}", TRAINING
    ),
    "train --config examples/fast_lap.toml --output runs/lap": Short(
        f"gates by ppo, time_penalty ... {TRAINED}", TRAINING.replace("--budget 2", "--set updates=2")
    ),
    "train --config examples/faster_lap.toml --output runs/lap2": Short(
        f"gates by ppo, time_penalty ... {TRAINED}", TRAINING.replace("--budget 2", "--set updates=2")
    ),
    "train forest": Short(f"forest by bptt ... {TRAINED}", TRAINING),
    "train crowd": Short(f"crowd by bptt ... {TRAINED}", f"{TRAINING} --set horizon=4"),
    "fly --policy runs/crowd --drones 64": Short(f"crowd by bptt, drones 64, policy of runs/crowd ... {LOGGED}"),
    "eval runs/crowd --drones 64 --episodes 32": Short("crowd by bptt ... success", "--episodes 2"),
    "train race": Short(f"race by bptt ... {TRAINED}", f"{TRAINING} --set horizon=4"),
    "train race --algo league --output runs/league": Short(
        f"race by league ... {TRAINED}", f"{TRAINING} --set horizon=4"
    ),
    "train sling": Short(f"sling by bptt ... {TRAINED}", TRAINING),
    "train recovery --set recurrent_size=32": Short(f"recovery by bptt ... {TRAINED}", TRAINING),
    "train hover --from hover --vehicle hb --output runs/hb": Short(
        TRAINED, "--set worlds=8 --set horizon=4 --budget 2"
    ),
    "train hover --resume": Short(TRAINED),
    "train hover --resume --budget 100": Short("updates: 102, 2 of them made ... " + TRAINED.split(" ... ", 1)[1]),
    "train hover --overwrite": Short(TRAINED, TRAINING),
    "eval runs/hover --episodes 10000 --json": Short('"run": "runs/hover" ... "episodes": 8', "--episodes 8"),
    "eval runs/hover --episodes 100 --backend bullet": Short(
        "hover by bptt: policy of update .* on the bullet backend ... success", "--episodes 2", BULLET
    ),
    "fly --policy runs/hover": Short(f"hover by bptt, policy of runs/hover ... {LOGGED}"),
    "fly --policy runs/hover --backend bullet --video hover.mp4": Short(
        "hover by bptt, policy of runs/hover, on Bullet ... wrote .*hover.mp4", needs=FILM
    ),
    "view runs/hover --output hover.html": Short(r"wrote hover\.html \([01]\.\d MB\)"),
    "view runs/circle --output circle.html": Short(r"wrote circle\.html \([01]\.\d MB\)"),
}


def commands(block) -> list[str]:
    """The commands of a block, without comments; `jaxdrones` first where it is ours."""
    lines = [re.sub(r"\s+#.*", "", line) for line in block.code.splitlines()]
    return [part.strip().removeprefix(".venv/bin/") for line in lines for part in line.split("&&") if part.strip()]


def ours(block) -> list[str]:
    return [command.removeprefix("jaxdrones ") for command in commands(block) if command.startswith("jaxdrones ")]


def tried(command: str, short: Short, capsys) -> None:
    """Run a command, and compare what it prints."""
    code = main([*command.split(), *short.more.split()])
    printed = capsys.readouterr()
    assert code == 0, printed.err
    assert re.search(short.prints.replace(" ... ", "(?s:.*)"), printed.out), printed.out


def test_every_command_of_a_page_is_tried():
    assert {command for block in BLOCKS for command in ours(block)} == FLIGHTS.keys() | TRAININGS.keys()
    assert [
        page for page, tests in ELSEWHERE.items() if not ((ROOT / page).is_file() and (ROOT / tests).is_file())
    ] == []


def test_what_sets_the_project_up_is_there():
    others = [c for block in BLOCKS for c in commands(block) if not c.startswith("jaxdrones ")]
    targets = re.findall(r"(?m)^([\w-]+):", (ROOT / "Makefile").read_text())
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    recipe = (ROOT / "Makefile").read_text()
    for command in others:
        program, *arguments = command.split()
        if program == "make":
            assert set(arguments) <= set(targets)
        elif program == "pip":
            assert "-c" not in arguments or (ROOT / arguments[arguments.index("-c") + 1]).is_file()
            assert set(re.search(r"\[(.*)\]", command)[1].split(",")) <= set(extras)
        else:
            assert program in ("python3", "pytest")
            assert program == "python3" or f"$(BIN)/{command}" in recipe  # as `make test` has it


@pytest.mark.float32
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # of imageio-ffmpeg's pipes
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(
    "command",
    [
        pytest.param(c, marks=(pytest.mark.needs(*short.needs), *((pytest.mark.slow,) if c not in QUICK else ())))
        for c, short in FLIGHTS.items()
    ],
)
def test_a_flight_of_a_page_prints_what_it_is_for(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    if "my_controller.py" in command:
        own = next(b for b in blocks(ROOT / "docs" / "controllers.md", "python") if "def control" in b.code)
        Path("my_controller.py").write_text(own.code)
    tried(command, FLIGHTS[command], capsys)


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # of imageio-ffmpeg's pipes
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(
    "block",
    {tuple(ours(b)): b for b in BLOCKS if set(ours(b)) & TRAININGS.keys()}.values(),  # each once
    ids=lambda b: b.name,
)
def test_the_trainings_of_a_page_can_be_interrupted_resumed_evaluated_and_flown(block, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("examples").symlink_to(ROOT / "examples")
    here = ours(block)
    shorts = {command: (TRAININGS | FLIGHTS)[command] for command in here}
    for library in sorted({library for short in shorts.values() for library in short.needs}):
        pytest.importorskip(library)
    for command, short in shorts.items():
        if command == "train hover" and "train hover --resume" in here:
            with monkeypatch.context() as patch:
                interrupt(patch)
                assert main([*command.split(), *short.more.split()]) == 130
            assert "--resume" in capsys.readouterr().err
        else:
            tried(command, short, capsys)


def interrupt(patch) -> None:
    """Ctrl-C, when the trainer goes on for the second time."""
    advance, calls = Trainer.advance, []

    def interrupted(self, state, updates):
        calls.append(updates)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return advance(self, state, updates)

    patch.setattr(Trainer, "advance", interrupted)
