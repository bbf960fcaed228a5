"""Viewers of a live flight without a browser, and flights in parts."""

import dataclasses
import threading
import urllib.request

import numpy as np
from viewer_payload import decode

ARRAYS = ("t", "pos", "quat", "vel", "omega", "rpm")


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
