"""Selection of the best policy of a training."""

from __future__ import annotations

import math
from collections.abc import Sequence

from jaxdrones.learning.evaluation import wilson_interval

SELECTION_STREAM, REPORT_STREAM = 2**31, 2**31 + 1
"""Numbers to fold into the key of a seed, for the episodes of the selection and of the final report.
They are distinct from the streams 0, 1, 2, ... of a split."""

_STANDARD_ERRORS = 1.0  # half width of the intervals, in standard errors, for a statistical tie of two success rates

Score = tuple[float, float]
"""Success rate and mean return of an evaluation."""


def score_of(success: float | None, mean_return: float) -> Score:
    """Score of an evaluation; missing success is 0, a return that is NaN is the worst."""
    return success or 0.0, mean_return if math.isfinite(mean_return) else -math.inf


def best_of(scores: Sequence[Score], episodes: int, highest_success: float = 0.0) -> int:
    """Index of the policy to keep.

    It is the first one with the highest return among policies whose success rate is statistically tied for first. Two
    success rates are tied if their Wilson intervals of one standard error overlap: for 1,000 episodes, a difference of
    1 is a tie, and a difference of 5 is not.

    Args:
        scores: scores of all policies to choose from.
        episodes: number of episodes of each evaluation.
        highest_success: highest success rate of earlier evaluations, with as many episodes. It keeps small losses from
            accumulating over selections.
    """

    def interval(success: float) -> tuple[float, float]:
        return wilson_interval(round(success * episodes), episodes, _STANDARD_ERRORS)

    least = max(interval(success)[0] for success in (highest_success, *(success for success, _ in scores)))
    near = [i for i, (success, _) in enumerate(scores) if interval(success)[1] >= least]
    return max(near or range(len(scores)), key=lambda i: scores[i][1])
