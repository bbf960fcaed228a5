"""The server of a live view is for viewers on this machine, and withstands broken connections."""

import socket
import struct
import threading
import time
import urllib.request

import pytest
from live_viewer import Viewer, play

from jaxdrones.cli import main
from jaxdrones.visualization.viewer import server
from jaxdrones.visualization.viewer.live import Live
from jaxdrones.visualization.viewer.server import HOST


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
