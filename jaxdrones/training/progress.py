"""Progress of a run: CSV file and loggers."""

from __future__ import annotations

import csv
import itertools
import math
import os
from collections.abc import Sequence
from typing import IO

from jaxdrones import writing
from jaxdrones.learning.result import Callback
from jaxdrones.training.run import Run


class Progress:
    """Writer of progress.csv of a run, and of the same rows to loggers."""

    def __init__(self, run: Run, columns: Sequence[str], update: int, loggers: Sequence[Callback] = ()):
        """Continue after an update; rows of later updates are dropped."""
        rows = [row for row in run.history() if row["update"] <= update] if update else []
        self._columns, self._loggers, path = columns, loggers, run.folder / "progress.csv"
        with writing.replaced(path) as new, new.open("w", newline="") as file:
            csv.DictWriter(file, columns).writeheader()
            self._write(file, rows)
        self._file = path.open("a", newline="")

    def add(self, rows: list[dict[str, float]]) -> None:
        """Write rows, each with at least `update`; NaN is written as an empty field."""
        rows = [{name: x for name, x in row.items() if not math.isnan(x)} for row in rows]
        self._write(self._file, rows)
        self._file.flush()
        for logger, row in itertools.product(self._loggers, rows):
            logger(int(row["update"]), {name: x for name, x in row.items() if name != "update"}, None)

    def synchronize(self) -> None:
        """Flush all rows to the disk."""
        os.fsync(self._file.fileno())

    def _write(self, file: IO[str], rows: list[dict[str, float]]) -> None:
        writer = csv.DictWriter(file, self._columns)
        for row in rows:
            writer.writerow(row | {name: int(row[name]) for name in ("update", "steps") if name in row})

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_) -> None:
        self._file.close()
