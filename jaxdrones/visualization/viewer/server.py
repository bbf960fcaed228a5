"""The server of the live page: for this machine alone, and for those who know its address."""

from __future__ import annotations

import contextlib
import http.server
import secrets
import socket
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from typing import Any

from jaxdrones.visualization.viewer.page import Page

HOST = "127.0.0.1"
"""The only address that is served: that by which a machine reaches itself."""
STREAM = "events"
"""End of the path of the stream of server-sent events."""
CONNECTIONS = 32
"""Connections at a time; beyond them the one that has been silent for longest is closed."""
_LOCAL_NAMES = ("127.0.0.1", "localhost")  # that a browser may ask for; others may be names of a foreign site
_OWN_SITE = ("none", "same-origin")  # what a browser says of a request that no page of another site makes
_SILENT = 5.0  # s, within which a connection has to ask for something
_STUCK = 30.0  # s, within which it has to take what it is sent


class Server(http.server.ThreadingHTTPServer):
    """A thread for each connection, of which there are few; none keeps the program from ending."""

    request_queue_size = 4 * CONNECTIONS

    def __init__(self, port: int, title: str, stream: Callable[[Callable[[str, str], None]], None]) -> None:
        """Take a port; nothing is answered before `serve_forever`.

        Args:
            port: port of this machine; 0 takes a free one.
            title: title of the page until there is a flight.
            stream: function that tells one viewer everything, by the function `(event, data)` that it is given.

        Raises:
            OSError: the port is taken.
        """
        self.path = f"/{secrets.token_urlsafe(16)}/"
        self.page = Page(title, f"live:{self.path}{STREAM}").html.encode()
        self.stream = stream
        super().__init__((HOST, port), Handler)
        self.url = f"http://{HOST}:{self.server_port}{self.path}"
        self._lock = threading.Lock()
        self._connected: set[socket.socket] = set()
        self._silent: dict[socket.socket, float] = {}  # those that have not asked for anything yet, and since when

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer a connection in a thread; close one that is silent, if there are too many."""
        with self._lock:
            if len(self._connected) >= CONNECTIONS and self._silent:
                self._end(next(iter(self._silent)))
            if len(self._connected) >= CONNECTIONS:
                return super().shutdown_request(request)
            self._connected.add(request)
            self._silent[request] = time.monotonic()
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection and forget it."""
        self.heard(request)
        with self._lock:
            self._connected.discard(request)
        super().shutdown_request(request)

    def heard(self, request: socket.socket) -> None:
        """Note that a connection has asked for something."""
        with self._lock:
            self._silent.pop(request, None)

    def service_actions(self) -> None:
        """Close connections that have been silent for too long."""
        with self._lock:
            for request, since in list(self._silent.items()):
                if time.monotonic() - since > _SILENT:
                    self._end(request)

    def _end(self, request: socket.socket) -> None:
        """Have the thread of a connection that is silent end."""
        del self._silent[request]
        self._connected.discard(request)
        with contextlib.suppress(OSError):  # the other end was faster
            request.shutdown(socket.SHUT_RDWR)


class Handler(http.server.BaseHTTPRequestHandler):
    """Answers a viewer's requests: the page, and its stream."""

    server: Server
    server_version = "jaxdrones"
    sys_version = ""
    timeout = _SILENT

    def do_GET(self) -> None:
        """Send the page or its stream to those who know their address."""
        self.server.heard(self.request)
        self.request.settimeout(_STUCK)
        path = self.server.path
        if not self._is_own():
            return self.send_error(HTTPStatus.FORBIDDEN, "this page is for this machine alone")
        if not secrets.compare_digest(self.path.encode()[: len(path)], path.encode()):
            return self.send_error(HTTPStatus.FORBIDDEN, "open the whole address that was printed")
        if self.path == path:
            self._begin("text/html; charset=utf-8")
            self.wfile.write(self.server.page)
        elif self.path == path + STREAM:
            self._begin("text/event-stream")
            self.server.stream(self._send)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""

    def _is_own(self) -> bool:
        """Whether a request names this machine, and comes from no page of another site."""
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")  # another port, where ssh forwards it
        embedded = self.path.endswith(STREAM) and self.headers.get("Sec-Fetch-Site", "none") not in _OWN_SITE
        return host.partition(":")[0] in _LOCAL_NAMES and origin in (None, f"http://{host}") and not embedded

    def _begin(self, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.send_header("Referrer-Policy", "no-referrer")
        self.end_headers()

    def _send(self, event: str, data: str) -> None:
        self.wfile.write(f"event: {event}\ndata: {data}\n\n".encode())
        self.wfile.flush()
