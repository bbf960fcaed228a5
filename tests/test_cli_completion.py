"""The scripts that complete the command line, tried in a shell."""

import subprocess
import sys

import pytest

from jaxdrones.cli import main
from jaxdrones.cli.completion import SHELLS
from jaxdrones.envs import TASKS
from jaxdrones.errors import install

COMPLETE = """
COMP_WORDS=({words}); COMP_CWORD=$(( ${{#COMP_WORDS[@]}} - 1 ))
_shtab_jaxdrones
echo "${{COMPREPLY[@]}}"
"""


@pytest.fixture
def script(capsys):
    assert main(["completion", "bash"]) == 0
    return capsys.readouterr().out


def completed(script: str, words: str) -> list[str]:
    """What bash proposes for the last of the words."""
    lines = COMPLETE.format(words=words)
    done = subprocess.run(["bash", "-c", script + lines], capture_output=True, text=True, check=True)
    return done.stdout.split()


@pytest.mark.needs("shtab")
@pytest.mark.parametrize(
    ("words", "proposed"),
    [
        ("jaxdrones tr", ["train"]),
        ("jaxdrones train forest --alg", ["--algo"]),
        ("jaxdrones train forest --algo p", ["ppo"]),
        ("jaxdrones train gat", ["gates"]),
        ("jaxdrones explain hover-", [name for name in TASKS if name.startswith("hover-")]),
        ("jaxdrones fly circle --backend bul", ["bullet"]),
        ("jaxdrones fly circle --vehicle cf", ["cf21", "cf21_brushless", "cf21_thrust", "cf2p", "cf2x"]),
        ("jaxdrones train hover --realistic a", ["any"]),
        ("jaxdrones export runs/hover --to st", ["stablehlo"]),
        ("jaxdrones completion f", ["fish"]),
        ("jaxdrones eval mine.py:policy --task swap", ["swap-goals"]),
        ("jaxdrones view runs/circle --camera f", ["follow"]),
        ("jaxdrones ros2 --failsafe l", ["land"]),
    ],
)
def test_bash_completes(words, proposed, script):
    assert completed(script, words) == proposed


@pytest.mark.needs("shtab")
def test_bash_completes_the_folder_of_a_run(script, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "hover").mkdir(parents=True)
    (tmp_path / "running.txt").touch()
    assert completed(script, "jaxdrones eval run") == ["runs"]


@pytest.mark.needs("shtab")
def test_the_script_is_bash_and_there_is_one_for_every_shell(script, capsys):
    subprocess.run(["bash", "-n"], input=script, text=True, check=True)
    for shell in SHELLS:
        assert main(["completion", shell]) == 0
        printed = capsys.readouterr().out
        assert "jaxdrones" in printed and "leader-follower" in printed and "realistic" in printed


def test_what_completes_is_named_where_it_is_missing(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["completion", "bash"]) == 2
    assert install("cli") in capsys.readouterr().err
    assert main(["completion", "tcsh"]) == 2
    assert "unknown shell 'tcsh'" in capsys.readouterr().err
