"""What a viewer hears of a running flight is what is flown; viewers come, go and stay away."""

import dataclasses
import signal
import socket
import struct
import threading
import time
import urllib.error
import urllib.request

import numpy as np
import pytest

from jaxdrones.cli import live as live_option
from jaxdrones.cli import main
from jaxdrones.cli.common import lasting_interrupts
from jaxdrones.flights.fly import fly
from jaxdrones.visualization.viewer import live as module
from jaxdrones.visualization.viewer import server
from jaxdrones.visualization.viewer.live import Live
from jaxdrones.visualization.viewer.payload import decode
from jaxdrones.visualization.viewer.server import HOST

ARRAYS = ("t", "pos", "quat", "vel", "omega", "rpm")


@pytest.fixture(scope="module")
def record():
    return fly("circle", drones=2, duration=0.5)


def parts(record, length=4):
    """A record in parts of some rows."""
    names = (*ARRAYS, "target_pos", "target_vel")
    for first in range(0, len(record.t), length):
        rows = {name: getattr(record, name)[first : first + length] for name in names}
        yield dataclasses.replace(record, **rows)


def play(live, record):
    for part in parts(record):
        live.add(part, float(record.t[-1]))


class Viewer(threading.Thread):
    """A browser without a picture: it reads the stream, to its end or as many events as are asked for."""

    def __init__(self, live, events=10**9):
        super().__init__(daemon=True)
        self.url, self.most, self.heard = live.url + "events", events, []
        self.start()

    def run(self):
        with urllib.request.urlopen(self.url, timeout=20) as stream:
            event = ""
            for line in stream:
                name, _, value = line.decode().strip().partition(": ")
                if name == "event":
                    event = value
                elif name == "data" and event != "alive":
                    self.heard.append((event, decode(value) if value != "{}" else {}))
                    if len(self.heard) == self.most:
                        return

    @property
    def header(self):
        return next(data for event, data in reversed(self.heard) if event == "begin")

    def flight(self):
        """The rows that were heard, by name."""
        self.join(20)
        assert not self.is_alive() and self.heard[-1][0] == "end"
        tables = [data["rows"] if event == "rows" else data["worlds"][0] for event, data in self.heard[:-1]]
        return {name: np.concatenate([rows[name] for rows in tables]) for name in (*ARRAYS, "targets")}


def same(flight, record):
    np.testing.assert_allclose(flight["pos"], record.pos, rtol=0, atol=1e-4)
    np.testing.assert_allclose(flight["targets"], record.target_pos, rtol=0, atol=1e-4)
    np.testing.assert_allclose(flight["t"], record.t, rtol=1e-6)
    for name in ("quat", "vel", "omega", "rpm"):  # half a step of 65,536 over what each column takes
        half = np.ptp(getattr(record, name), axis=(0, 1)).max() / 65535 / 2
        np.testing.assert_allclose(flight[name], getattr(record, name), rtol=1e-6, atol=1.01 * half)


@pytest.mark.slow
def test_two_viewers_hear_the_flight_as_it_is_logged(record):
    with Live() as live:
        viewers = [Viewer(live), Viewer(live)]
        flown = fly("circle", drones=2, duration=0.5, watch=live.add)
    for viewer in viewers:
        same(viewer.flight(), flown)
        assert len(viewer.heard) > 3
        assert viewer.header["live"] == {"rows": len(flown.t), "end": pytest.approx(0.5), "running": True}
    np.testing.assert_allclose(flown.pos, record.pos, rtol=0, atol=1e-5)
    for name in ("t", "target_pos", "labels"):
        np.testing.assert_array_equal(getattr(flown, name), getattr(record, name))


def test_a_viewer_that_comes_late_hears_the_flight_from_its_start(record):
    with Live(wait=0.0) as live:
        play(live, record)
        viewer = Viewer(live)
        while not viewer.heard:
            time.sleep(0.01)
    same(viewer.flight(), record)
    assert [event for event, _ in viewer.heard] == ["begin", "end"]


def test_a_flight_that_is_watched_is_no_faster_than_real_time(record):
    with Live() as live:
        viewer, start = Viewer(live), time.monotonic()
        play(live, record)
        assert time.monotonic() - start >= 0.49
    same(viewer.flight(), record)


def test_without_a_viewer_the_flight_waits_for_a_while_and_goes_on(record):
    lines = []
    with Live(wait=0.1, say=lines.append) as live:
        play(live, record)
    assert lines == ["waiting for a viewer, 0.1 s at most", "no viewer came; the flight continues without one"]


def test_when_the_viewer_leaves_the_flight_goes_on_without_waiting(record, monkeypatch):
    monkeypatch.setattr(module, "_RELOADING", 0.05)
    slow, lines = dataclasses.replace(record, t=1000 * record.t), []  # ten minutes
    with Live(say=lines.append) as live:
        flight = parts(slow)
        pilot = threading.Thread(target=lambda: [live.add(part, float(slow.t[-1])) for part in flight], daemon=True)
        viewer = Viewer(live, events=1)
        pilot.start()
        viewer.join(20)
        pilot.join(20)
        assert not pilot.is_alive() and live.viewers == 0
    assert lines[-1] == "the viewer has left; the flight continues without one"


def test_a_page_that_is_loaded_again_sees_the_rest_in_real_time(record):
    with Live() as live:
        first = Viewer(live, events=1)
        pilot = threading.Thread(target=play, args=(live, record), daemon=True)
        pilot.start()
        first.join(20)
        second = Viewer(live)
        pilot.join(20)
    same(second.flight(), record)


def test_another_flight_begins_anew_and_a_whole_one_is_shown_with_its_learning_curve(record):
    with Live() as live:
        viewer = Viewer(live)
        play(live, record)
        play(live, record)
        live.show(record, "update 2", [(1, 0.0), (2, 0.5)])
        while not viewer.heard or viewer.header["title"] != "update 2":
            time.sleep(0.01)
    viewer.join(20)
    assert [event for event, _ in viewer.heard].count("begin") == 3
    assert viewer.header["live"]["running"] is False
    assert viewer.header["live"]["curve"] == {"label": "success", "points": [[1, 0.0], [2, 0.5]]}
    np.testing.assert_allclose(viewer.header["worlds"][0]["pos"], record.pos, rtol=0, atol=1e-4)


def status(live, path, **headers):
    """The status with which a request is answered; {} in a header is the port."""
    port = int(live.url.split(":")[2].split("/")[0])
    headers = {"Host": "127.0.0.1:{}"} | {name.replace("_", "-"): x for name, x in headers.items()}
    lines = [f"GET {path} HTTP/1.0", *(f"{name}: {x.format(port)}" for name, x in headers.items()), "", ""]
    with socket.create_connection((HOST, port), timeout=20) as connection:
        connection.sendall("\r\n".join(lines).encode())
        return int(connection.recv(4096).split()[1])


def test_the_page_is_for_this_machine_and_for_those_who_know_its_address():
    with Live() as live:
        secret = live.url.split("/")[3]
        assert live.url.startswith(f"http://{HOST}:") and HOST == "127.0.0.1" and len(secret) >= 20
        page, stream = f"/{secret}/", f"/{secret}/events"
        with urllib.request.urlopen(live.url) as opened:
            assert f"live:{stream}".encode() in opened.read()
        for path in (page, stream):
            for own in ({}, {"Origin": "http://127.0.0.1:{}"}, {"Host": "localhost:9", "Origin": "http://localhost:9"}):
                assert status(live, path, **own) == 200, own
            for host in ("example.org", "example.org:{}", "127.0.0.1.example.org:{}", ""):
                assert status(live, path, Host=host) == 403, host
            for origin in ("http://example.org", "null", "http://127.0.0.1:1", "https://127.0.0.1:{}"):
                assert status(live, path, Origin=origin) == 403, origin
        for site in ("cross-site", "same-site"):
            assert status(live, stream, Sec_Fetch_Site=site) == 403
        for path in ("/", "/events", f"/{secret[:-1]}/events", f"/{secret}x/events", f"/{'a' * len(secret)}/events"):
            assert status(live, path) == 403, path
        assert status(live, f"{page}etc/passwd") == 404


def threads_fall_to(most):
    """Whether there are at most so many threads within 20 s: a thread ends some time after its connection."""
    end = time.monotonic() + 20
    while threading.active_count() > most and time.monotonic() < end:
        time.sleep(0.02)
    return threading.active_count() <= most


def test_silent_connections_neither_pile_up_nor_keep_a_viewer_out(record, monkeypatch):
    monkeypatch.setattr(server, "_SILENT", 60.0)  # so that the limit of connections ends them, not their silence
    monkeypatch.setattr(server.Handler, "timeout", 60.0)
    with Live(wait=0.0) as live:
        play(live, record)
        before, port = threading.active_count(), int(live.url.split(":")[2].split("/")[0])
        silent = [socket.create_connection((HOST, port)) for _ in range(2 * server.CONNECTIONS)]
        silent[-1].sendall(b"GET / HTTP/1.1\r\nHost: ")  # and never a second line
        viewer = Viewer(live, events=1)
        viewer.join(10)
        assert viewer.heard[0][0] == "begin"
        assert threads_fall_to(before + server.CONNECTIONS)
        assert threading.active_count() > before + server.CONNECTIONS // 2  # the others may stay
        monkeypatch.setattr(server, "_SILENT", 0.5)
        assert threads_fall_to(before)
        for connection in silent:
            connection.close()


def test_a_browser_that_closes_before_the_answer_leaves_nothing_on_the_terminal(capfd):
    with Live() as live:
        for path in "/", f"/{live.url.split('/')[3]}/", f"/{live.url.split('/')[3]}/events":
            for _ in range(20):
                with socket.create_connection((HOST, live._server.server_port)) as client:
                    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # reset at close
                    client.sendall(f"GET {path} HTTP/1.1\r\nHost: {HOST}\r\n\r\n".encode())
        time.sleep(0.3)
    assert "Traceback" not in capfd.readouterr().err


def test_a_port_that_is_taken_is_refused_in_one_line(capsys):
    with socket.create_server((HOST, 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=f"port {port} cannot be used: .*; give another, or 0 for a free one"):
            Live(port)
        assert main(["fly", "circle", "--duration", "0.1", "--live", str(port), "--no-figure"]) == 2
        assert f"error: port {port} cannot be used" in capsys.readouterr().err
    with pytest.raises(ValueError, match="port is 70000"):
        Live(70000)


def test_a_flight_that_is_interrupted_ends_the_stream_and_the_server(record, capsys):
    with pytest.raises(KeyboardInterrupt), Live() as live:
        viewer = Viewer(live)
        for part in parts(record):
            live.add(part, 0.5)
            raise KeyboardInterrupt
    viewer.join(20)
    assert [event for event, _ in viewer.heard] == ["begin", "end"]
    with pytest.raises(OSError):
        urllib.request.urlopen(live.url, timeout=5)


def test_more_than_a_browser_plays_is_refused(record):
    with Live(wait=0.0) as live, pytest.raises(ValueError, match="more than a page plays"):
        live.add(next(parts(record)), 1e5)


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
