"""Recorder of a flight in real time."""

from __future__ import annotations

import collections
from typing import Any

import numpy as np

from jaxdrones.firmware.drone import Sample
from jaxdrones.flights.log import FlightLog, LoggedConditions
from jaxdrones.params import Params, repeat

_MOST_ROWS = 360_000  # an hour at 100 rows per second


class Recorder:
    """Rows of a flight of one drone; of a long flight the last 360,000."""

    def __init__(self) -> None:
        self._rows: collections.deque[tuple[Any, ...]] = collections.deque(maxlen=_MOST_ROWS)

    def __len__(self) -> int:
        """Number of rows."""
        return len(self._rows)

    def add(self, t: float, now: Sample, target: Any = None) -> None:
        """Add a row: time (s), sample of the drone and target position (3,) (m, world), if it has one."""
        unknown = np.full(3, np.nan)
        arrays = (now.pos, now.quat, now.vel, now.omega, now.rpm, unknown if target is None else target)
        self._rows.append((t, *(np.array(x, np.float32) for x in arrays)))

    def log(self, params: Params, conditions: dict[str, Any], about: str) -> FlightLog:
        """Log of the flight; the conditions, with `vehicle`, are for JSON, and `about` is the title."""
        t, *arrays = map(np.array, zip(*self._rows, strict=True))
        pos, quat, vel, omega, rpm, target = (x[:, None] for x in arrays)
        known = np.isfinite(target).all()  # a log has targets in all rows or in none
        return FlightLog(
            t=t.astype(float),
            pos=pos,
            quat=quat,
            vel=vel,
            omega=omega,
            rpm=rpm,
            target_pos=target if known else np.asarray(np.nan),
            conditions=LoggedConditions(conditions, about),
            params=repeat(params, 1),
        )
