"""Live view of flights in the browser, streamed by a local server."""

import contextlib
import dataclasses
import math
import threading
import time
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import numpy as np

from jaxdrones.arguments import checked, whole
from jaxdrones.errors import UserError
from jaxdrones.flights.log import OPTIONAL, STATE, FlightLog
from jaxdrones.visualization.viewer.payload import check_size, encode, encode_rows
from jaxdrones.visualization.viewer.server import Server
from jaxdrones.visualization.viewer.show import LAYOUTS, records_of

_RELOADING = 2.0  # s, wait for a viewer that left
_ALIVE = 0.5  # s between keep-alive messages, to detect closed viewers
_FLUSHING = 5.0  # s, time for viewers to receive the rest at the end
_ROWS = ("t", *STATE, *OPTIONAL)  # growing arrays of a log


class Live(contextlib.AbstractContextManager["Live"]):
    """Context with a server that shows flights live to any number of viewers.

    It is reachable only from this machine, by the secret in `url`. A late viewer can see the whole flight.

    Args:
        port: port of the server; 0 for a free one.
        title: title of the page; by default the conditions of the flight.
        wait: longest wait of `add` for the first viewer, s.
        say: function to print a line.

    Raises:
        ValueError: an invalid port, or one in use.
        ImportError: the viewer's page is not built.
    """

    @checked
    def __init__(
        self,
        port: Annotated[int, whole(minimum=0, limit=65535)] = 0,
        title: str | None = None,
        wait: float = 60.0,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        try:
            self._server = Server(port, "jaxdrones", self._stream)
        except OSError as error:
            raise UserError(
                f"port {port} cannot be used: {error.strerror}; give another, or 0 for a free one"
            ) from None
        self.url = self._server.url
        self._title, self._wait, self._say = title, wait, say
        self._changed = threading.Condition()
        self._parts: list[FlightLog] = []  # of the current flight
        self._flight = 0  # its number; 0 before the first
        self._header: dict[str, Any] = {}
        self._viewers = 0
        self._paced: bool | None = None  # whether real time is kept; None before the first flight
        self._start = 0.0  # when the flight began, on the clock of `time.monotonic`
        self._closed = False
        threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True).start()

    @property
    def viewers(self) -> int:
        """Number of open pages."""
        return self._viewers

    def add(self, part: Any, end: float) -> None:
        """Show the next part of a flight in real time.

        The first part waits for a viewer, for `wait` seconds at most. Without viewers there is no wait.

        Args:
            part: an argument of `show` with one world; a part that begins before the last one ended starts a new
                flight.
            end: latest end of the flight, s.
        """
        (record,) = records_of(part, {})
        if not self._parts or record.t[0] <= self._parts[-1].t[-1]:
            if self._paced is None:
                self._await_first()
            rows = max(1, round(len(record.t) * end / float(record.t[-1])))  # row 0 is one step after the start
            self._begin(record, {"rows": rows, "end": end, "running": True})
            self._start = time.monotonic() - float(record.t[0])
        else:
            with self._changed:
                self._parts.append(record)
                self._changed.notify_all()
        self._pace(self._start + float(record.t[-1]))

    def show(self, flight: Any, title: str, curve: Sequence[tuple[float, float]] = (), label: str = "success") -> None:
        """Show a whole flight in a loop until the next one, without waiting.

        Args:
            flight: an argument of `show` with one world.
            title: new title of the page.
            curve: points of a learning curve: numbers of updates, and evaluated values.
            label: name of the value; `success` is a fraction, 0 to 1.
        """
        (record,) = records_of(flight, {})
        self._title = title
        points = [[float(x), float(y)] for x, y in curve if math.isfinite(y)]
        live = {"rows": len(record.t), "end": float(record.t[-1]), "running": False}
        self._begin(record, live | {"curve": {"label": label, "points": points}})

    def close(self) -> None:
        """Send the rest to the viewers, and end. Their pages stay open."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
            self._changed.wait_for(lambda: not self._viewers, _FLUSHING)
        self._server.shutdown()
        self._server.server_close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _begin(self, record: FlightLog, live: dict[str, Any]) -> None:
        check_size(np.broadcast_to(0.0, (live["rows"], *record.pos.shape[1:])))
        title = str(record.conditions) if self._title is None else self._title
        with self._changed:
            self._parts = [record]
            self._header = {"title": title, "live": live, "layout": LAYOUTS["hidden"]}
            self._flight += 1
            self._changed.notify_all()

    def _await_first(self) -> None:
        """Wait for the first viewer."""
        with self._changed:
            if not self._viewers:
                self._say(f"waiting for a viewer, {self._wait:g} s at most")
            self._paced = self._changed.wait_for(lambda: self._viewers > 0, self._wait)
        if not self._paced:
            self._say("no viewer came; the flight continues without one")

    def _pace(self, due: float) -> None:
        """Wait until a time, unless there is no viewer."""
        with self._changed:
            while self._paced and (left := due - time.monotonic()) > 0:
                if self._viewers:
                    self._changed.wait(min(left, _ALIVE))
                elif not self._changed.wait_for(lambda: self._viewers > 0, _RELOADING):
                    self._paced = False
                    self._say("the viewer has left; the flight continues without one")

    @property
    def _news(self) -> tuple[int, int]:
        """Number of the current flight, and of its parts."""
        return self._flight, len(self._parts)

    def _await_news(self, had: tuple[int, int]) -> None:
        """Wait for news for a viewer, with a timeout."""
        self._changed.wait_for(lambda: self._closed or self._news != had, _ALIVE)

    def _stream(self, send: Callable[[str, str], None]) -> None:
        """Stream events to one viewer by a function of event and data, until the end.

        The events are `begin` (a payload), `rows` (further rows) and `end`.
        """
        with self._changed:
            self._viewers += 1
            self._changed.notify_all()
        had = (0, 0)  # number of the viewer's flight, and of its parts
        try:
            while True:
                with self._changed:
                    self._await_news(had)
                    news, parts, header, closed = self._news, list(self._parts), self._header, self._closed
                if news[0] != had[0]:
                    send("begin", encode([_joined(parts)], ["flight"], **header))
                elif news != had:
                    send("rows", encode_rows(_joined(parts[had[1] :])))
                elif closed:
                    send("end", "{}")
                    return
                else:
                    send("alive", "{}")
                had = news
        except OSError:  # the viewer has left
            pass
        finally:
            with self._changed:
                self._viewers -= 1
                self._changed.notify_all()


def _joined(parts: Sequence[FlightLog]) -> FlightLog:
    """Concatenate successive parts of a flight."""
    rows: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ROWS}
    return dataclasses.replace(parts[0], **rows | {"images": {}})
