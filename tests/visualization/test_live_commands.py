"""Flights and trainings of the command line in the browser."""

import signal
import time

import pytest
from live_viewer import play

from jaxdrones.cli import live as live_option
from jaxdrones.cli import main
from jaxdrones.cli.common import lasting_interrupts
from jaxdrones.visualization.viewer.live import Live


class Dropped:
    """Its deletion is interrupted, which Python cannot raise: as in a callback of the garbage collector."""

    def __del__(self):
        raise KeyboardInterrupt


@pytest.fixture
def interruptible():
    """Ctrl-C raises, also in a process that was started in the background, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_ends_a_wait_for_a_viewer_also_where_python_drops_it(record, tmp_path, monkeypatch, capsys):
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt), lasting_interrupts(), Live(say=lambda line: Dropped() and None) as live:
        play(live, record)
    assert time.monotonic() - start < live_option.WAIT
    monkeypatch.setattr(live_option, "print", lambda *line, **to: Dropped() and None, raising=False)
    assert main(["fly", "circle", "--duration", "0.5", "--live", "--no-figure", "--output", str(tmp_path)]) == 130
    assert capsys.readouterr().err == "jaxdrones: interrupted\n"


@pytest.mark.slow
def test_the_command_line_flies_in_the_browser(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(live_option, "WAIT", 0.0)
    arguments = ["fly", "circle", "--duration", "0.2", "--live", "--no-figure", "--output", str(tmp_path)]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("open http://127.0.0.1:") and "no viewer came" in printed and "log.npz" in printed
    assert main([*arguments, "--json"]) == 0
    assert capsys.readouterr().out.startswith("{")


@pytest.mark.slow
def test_the_command_line_trains_in_the_browser(tmp_path, capsys, monkeypatch):
    shown = []
    monkeypatch.setattr(Live, "show", lambda self, *flight: shown.append(flight))
    settings = ["--set", "worlds=8", "--set", "horizon=4", "--budget", "2", "--episodes", "8", "--no-figure"]
    assert main(["train", "hover", "--live", *settings, "--output", str(tmp_path / "run")]) == 0
    assert "open http://127.0.0.1:" in capsys.readouterr().out
    assert [title for _, title, *_ in shown] == [f"hover by bptt, update {k} of 2: success 0.0 %" for k in (0, 1, 2)]
    assert [update for update, _ in shown[-1][2]] == [0, 1, 2]


def test_trainings_that_cannot_be_shown_are_refused(capsys):
    assert main(["train", "hover", "--live", "--no-figure", "--hosts", "2", "--host", "0", "--coordinator", "a:9"]) == 2
    assert "--live is given with" in capsys.readouterr().err
