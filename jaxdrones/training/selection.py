"""The choice of the policy that a training keeps."""

from __future__ import annotations

import math
from collections.abc import Sequence

from jaxdrones.learning.evaluation import wilson_interval

SELECTION_STREAM, REPORT_STREAM = 2**31, 2**31 + 1
"""Numbers to fold into the key of a seed, for the episodes that choose a policy and for those of the final report.
Splitting the key gives the streams 0, 1, 2, ..., which these numbers do not reach."""

_STANDARD_ERRORS = 1.0  # half the width of the intervals within which two success rates count as equal

Score = tuple[float, float]
"""Success rate and mean return of an evaluation."""


def score_of(success: float | None, mean_return: float) -> Score:
    """The score of an evaluation; a task without success counts as 0, a return that is not a number is the worst."""
    return success or 0.0, mean_return if math.isfinite(mean_return) else -math.inf


def best_of(scores: Sequence[Score], episodes: int, highest_success: float = 0.0) -> int:
    """Index of the policy to keep.

    Of the policies whose success rate is the highest up to chance, this is the one with the highest return; of equal
    returns it is the first. Two success rates are equal up to chance where their Wilson intervals of one standard error
    overlap: for 1,000 episodes, a difference of 1 decides nothing, and a difference of 5 decides.

    Args:
        scores: scores of all policies to choose from.
        episodes: number of episodes of each evaluation.
        highest_success: highest success rate of earlier evaluations, with as many episodes. With it, small losses do
            not add up from one choice to the next.
    """

    def interval(success: float) -> tuple[float, float]:
        return wilson_interval(round(success * episodes), episodes, _STANDARD_ERRORS)

    least = max(interval(success)[0] for success in (highest_success, *(success for success, _ in scores)))
    near = [i for i, (success, _) in enumerate(scores) if interval(success)[1] >= least]
    return max(near or range(len(scores)), key=lambda i: scores[i][1])
