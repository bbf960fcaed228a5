"""Local server of the live page, with a secret address."""

import contextlib
import http.server
import secrets
import socket
import sys
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from typing import Any

from jaxdrones.visualization.viewer.page import Page

HOST = "127.0.0.1"
"""Address of the server: the loopback interface."""
STREAM = "events"
"""End of the path of the stream of server-sent events."""
CONNECTIONS = 32
"""Largest number of connections; above it the longest idle one is closed."""
_LOCAL_NAMES = ("127.0.0.1", "localhost")  # allowed in requests; others may be names of a foreign site
_OWN_SITE = ("none", "same-origin")  # header values of requests from the same site
_SILENT = 5.0  # s, timeout of a request
_STUCK = 30.0  # s, timeout of sending


class Server(http.server.ThreadingHTTPServer):
    """Server with a daemon thread for each connection."""

    request_queue_size = 4 * CONNECTIONS

    def __init__(self, port: int, title: str, stream: Callable[[Callable[[str, str], None]], None]) -> None:
        """Bind a port; `serve_forever` answers requests.

        Args:
            port: port; 0 for a free one.
            title: title of the page before the first flight.
            stream: function that streams to one viewer by its argument, a function `(event, data)`.

        Raises:
            OSError: the port is in use.
        """
        self.path = f"/{secrets.token_urlsafe(16)}/"
        self.page = Page(title, f"live:{self.path}{STREAM}").html.encode()
        self.stream = stream
        super().__init__((HOST, port), Handler)
        self.url = f"http://{HOST}:{self.server_port}{self.path}"
        self._lock = threading.Lock()
        self._connected: set[socket.socket] = set()
        self._silent: dict[socket.socket, float] = {}  # connections without a request yet, and their start

    def process_request(self, request: Any, client_address: Any) -> None:
        """Handle a connection in a thread; close an idle one if there are too many."""
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
        """Mark a connection as active."""
        with self._lock:
            self._silent.pop(request, None)

    def service_actions(self) -> None:
        """Close idle connections."""
        with self._lock:
            for request, since in list(self._silent.items()):
                if time.monotonic() - since > _SILENT:
                    self._end(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print the traceback of an error, but not of a connection that its peer closed."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)

    def _end(self, request: socket.socket) -> None:
        """End the thread of an idle connection."""
        del self._silent[request]
        self._connected.discard(request)
        with contextlib.suppress(OSError):  # already closed by the peer
            request.shutdown(socket.SHUT_RDWR)


class Handler(http.server.BaseHTTPRequestHandler):
    """Handler of a viewer's requests for the page and its stream."""

    server: Server
    server_version = "jaxdrones"
    sys_version = ""
    timeout = _SILENT

    def do_GET(self) -> None:
        """Send the page or its stream for a request with the secret."""
        self.server.heard(self.request)
        self.request.settimeout(_STUCK)
        path = self.server.path
        if not self._is_own():
            return self.send_error(HTTPStatus.FORBIDDEN, "this page is available only on this machine")
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
        """Disable logging."""

    def _is_own(self) -> bool:
        """Whether a request is addressed to this machine and not from another site."""
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")  # another port, if forwarded by ssh
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
