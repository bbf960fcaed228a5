"""Schedule of evaluations, end of a training by updates, success rate or time, and choice of its best policy."""

import dataclasses
import math
import time
from collections.abc import Sequence

from jaxdrones.errors import UserError
from jaxdrones.learning.evaluation import Score, wilson_interval
from jaxdrones.training import distributed

EVALUATIONS = 10
"""Number of evaluations of a training."""
STOPPING_EVALUATIONS = 30
"""Number of evaluations of a training with `stop_at`."""
IN_A_ROW = 3
"""Number of consecutive evaluations at `stop_at` that end a training."""
_EVALUATION_SHARE = 0.25  # largest fraction of a time budget for evaluations, except for the first and the last two

SELECTION_STREAM, REPORT_STREAM = 2**31, 2**31 + 1
"""Numbers to fold into the key of a seed, for the episodes of the selection and of the final report.
They are distinct from the streams 0, 1, 2, ... of a split."""

_STANDARD_ERRORS = 1.0  # half width of the intervals, in standard errors, for a statistical tie of two success rates


def check_stop_at(stop_at: float | None, has_success: bool, episodes: int) -> None:
    """Raise unless evaluations with this number of episodes can reach a lower bound of the success rate."""
    if stop_at is None:
        return
    if not 0 < stop_at < 1:
        raise UserError(f"stop_at is {stop_at:g}; give a success rate between 0 and 1, for example 0.99")
    if not has_success:
        raise UserError(f"stop_at is {stop_at:g}, but the task has no criterion of success; leave it out")
    highest = wilson_interval(episodes, episodes)[0]
    if highest < stop_at:
        enough = math.ceil(1.96**2 * stop_at / (1 - stop_at))
        raise UserError(
            f"stop_at is {stop_at:g}, but the 95 % interval of {episodes:,} successes of {episodes:,} begins at "
            f"{highest:.4f}; give at least {enough:,} episodes"
        )


def next_evaluation(updates: int, made: int, evaluations: int) -> int:
    """Next update with an evaluation, for evenly spaced evaluations."""
    return next(update for i in range(evaluations) if (update := updates * (i + 1) // evaluations) > made)


@dataclasses.dataclass
class TimePlan:
    """Allocation of the time until a deadline to updates, evaluations and the final report."""

    deadline: float
    """End of the training, s on the clock of `time.perf_counter`."""
    evaluated: int
    """Update of the last evaluation."""
    evaluations: int = EVALUATIONS
    """Number of remaining evaluations, without the final report."""
    evaluation_seconds: float = 0.0
    """Duration of an evaluation, including writing its results, s."""
    _calls: int = 0
    _updates: int = 0
    _seconds: float = 0.0

    def add_updates(self, updates: int, seconds: float) -> None:
        """Record the duration of updates, s; the second call replaces the first."""
        if self._calls == 1:
            self._updates, self._seconds = 0, 0.0
        self._calls, self._updates, self._seconds = self._calls + 1, self._updates + updates, self._seconds + seconds

    def add_evaluation(self, update: int, seconds: float) -> None:
        """Record the duration of the evaluation after an update, s."""
        self.evaluated, self.evaluations, self.evaluation_seconds = update, self.evaluations - 1, seconds

    def updates(self, made: int) -> int:
        """Total number of updates until the deadline, at least the completed ones."""
        left = distributed.from_first_host(self.deadline - time.perf_counter())
        evaluation = distributed.from_first_host(self.evaluation_seconds)
        for_updates = max(0.0, left - 2 * evaluation)  # the last evaluation and the report have to follow
        if evaluation > 0:
            self.evaluations = min(self.evaluations, 1 + int(_EVALUATION_SHARE * for_updates / evaluation))
        self.evaluations = max(self.evaluations, 1)
        for_updates -= (self.evaluations - 1) * evaluation
        return made + int(for_updates * self._updates / max(self._seconds, 1e-9))

    def next_evaluation(self, updates: int, made: int) -> int:
        """Next update with an evaluation, of `updates` in total."""
        return max(made + 1, self.evaluated + math.ceil((updates - self.evaluated) / self.evaluations))


def best_of(scores: Sequence[Score], episodes: int, highest_success: float = 0.0) -> int:
    """Index of the policy to keep, of evaluations with the same number of episodes.

    It is the first one with the highest return among policies whose success rate is statistically tied for first. Two
    success rates are tied if their Wilson intervals of one standard error overlap: 1,000 and 999 successes in 1,000
    episodes are tied, 1,000 and 995 are not. `highest_success` is the highest success rate of earlier evaluations; it
    keeps small losses from accumulating over selections.
    """

    def interval(success: float) -> tuple[float, float]:
        return wilson_interval(round(success * episodes), episodes, _STANDARD_ERRORS)

    least = max(interval(success)[0] for success in (highest_success, *(success for success, _ in scores)))
    near = [i for i, (success, _) in enumerate(scores) if interval(success)[1] >= least]
    return max(near or range(len(scores)), key=lambda i: scores[i][1])
