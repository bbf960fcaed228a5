"""The progress of a run on disk: a CSV file, and an event file for TensorBoard."""

from __future__ import annotations

import csv

from jaxdrones.training.events import EventFile
from jaxdrones.training.run import Run


class Progress:
    """progress.csv and the event file of a run, open for more rows."""

    def __init__(self, run: Run, columns: list[str], update: int):
        """Continue after an update; the rows of later updates, which a killed process left, are dropped."""
        rows = [row for row in run.history() if row["update"] <= update] if update else []
        for file in run.event_files():
            file.unlink()
        self._file = (run.folder / "progress.csv").open("w", newline="")
        self._csv = csv.DictWriter(self._file, columns)
        self._csv.writeheader()
        self._events = EventFile(run.folder)
        self.add(rows)

    def add(self, rows: list[dict[str, float]]) -> None:
        """Write rows, each with at least `update`."""
        for row in rows:
            self._csv.writerow(row | {name: int(row[name]) for name in ("update", "steps") if name in row})
            self._events.add(int(row["update"]), {name: x for name, x in row.items() if name != "update"})
        self._file.flush()
        self._events.flush()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_) -> None:
        self._file.close()
        self._events.close()
