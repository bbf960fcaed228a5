"""The progress of a run on disk: a CSV file, and an event file for TensorBoard."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Sequence
from typing import IO

from jaxdrones import writing
from jaxdrones.training.events import EventFile
from jaxdrones.training.run import Run


class Progress:
    """progress.csv and the event file of a run, open for more rows."""

    def __init__(self, run: Run, columns: Sequence[str], update: int):
        """Continue after an update; the rows of later updates, which a killed process left, are dropped."""
        rows = [row for row in run.history() if row["update"] <= update] if update else []
        self._columns, path = columns, run.folder / "progress.csv"
        with writing.replaced(path) as new, new.open("w", newline="") as file:
            csv.DictWriter(file, columns).writeheader()
            self._write(file, rows)
        self._file = path.open("a", newline="")
        older, self._events = run.event_files(), EventFile(run.folder)
        self._add_events(rows)
        for events in older:
            events.unlink()

    def add(self, rows: list[dict[str, float]]) -> None:
        """Write rows, each with at least `update`; a number that is NaN was not measured and stays empty."""
        rows = [{name: x for name, x in row.items() if not math.isnan(x)} for row in rows]
        self._write(self._file, rows)
        self._file.flush()
        self._add_events(rows)

    def synchronize(self) -> None:
        """Wait until all rows are on the disk."""
        os.fsync(self._file.fileno())

    def _write(self, file: IO[str], rows: list[dict[str, float]]) -> None:
        writer = csv.DictWriter(file, self._columns)
        for row in rows:
            writer.writerow(row | {name: int(row[name]) for name in ("update", "steps") if name in row})

    def _add_events(self, rows: list[dict[str, float]]) -> None:
        for row in rows:
            self._events.add(int(row["update"]), {name: x for name, x in row.items() if name != "update"})
        self._events.flush()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_) -> None:
        self._file.close()
        self._events.close()
