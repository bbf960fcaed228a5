"""Option --budget of `jaxdrones train`: a number, or a time and the deadlines that follow from it."""

import argparse
import time

from jaxdrones.cli.common import print_warning
from jaxdrones.errors import UserError
from jaxdrones.limits import LARGEST_COUNT

_MAX_SECONDS = 3.6e6
_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}
_FIGURE_SECONDS = 2.0  # to draw the learning curves
_TOLERANCE = 1.1  # times the budget from which on it was missed


def parse_budget(text: str | None) -> tuple[int | None, float | None]:
    """The number of updates, or the seconds, that --budget gives; the other is `None`."""
    if text is None:
        return None, None
    try:
        if text[-1:] in _UNITS:
            seconds = float(text[:-1]) * _UNITS[text[-1]]
            if 0 < seconds <= _MAX_SECONDS:
                return None, seconds
        elif 0 < int(text) <= LARGEST_COUNT:
            return int(text), None
    except ValueError:
        pass
    raise UserError(
        f"--budget is {text!r}; give updates, for example 300, or a time up to 1000h, for example 60s, 5m or 2h"
    )


class Deadlines:
    """The times at which the training of each seed has to be over, of a budget that all of them share evenly."""

    def __init__(self, options: argparse.Namespace, begin: float, seconds: float | None, runs: int):
        """Prepare.

        Args:
            options: options of the command line.
            begin: time of `time.perf_counter` at which the command began, s.
            seconds: time per run, s; `None` without a limit.
            runs: number of runs.
        """
        self.seconds, self._text, self._begin = seconds, options.budget, begin
        self._end = begin + runs * (seconds or 0.0)
        self._figure = 0.0 if options.no_figure else _FIGURE_SECONDS
        self._left = runs

    def start(self) -> None:
        """Say so if compiling took the time of a whole run."""
        if self.seconds is not None and time.perf_counter() - self._begin > self.seconds:
            print_warning(f"compiling took all of --budget {self._text}; one update is made, --resume continues it")

    def next(self) -> float | None:
        """The time of `time.perf_counter` at which the next training has to be over, s; `None` without a limit."""
        if self.seconds is None:
            return None
        now = time.perf_counter()
        deadline = now + (self._end - self._figure - now) / self._left
        self._left -= 1
        return deadline

    def warn_if_missed(self) -> None:
        """Say so if everything took longer than the budget."""
        spent, budget = time.perf_counter() - self._begin, self._end - self._begin
        if self.seconds is not None and spent > _TOLERANCE * budget + 1:
            print_warning(
                f"everything took {spent:.0f} s, more than {budget:.0f} s by --budget {self._text}: compiling, one "
                "update and three evaluations are the least; give a longer --budget or fewer --episodes"
            )
