"""Which policy a training keeps."""

import pytest

from jaxdrones.learning.evaluation import score_of
from jaxdrones.training.plan import best_of


@pytest.mark.parametrize(
    ("scores", "episodes", "kept"),
    [
        ([(0.999, 5.0), (1.0, 4.0)], 1000, 0),  # one episode in a thousand is chance: the return decides
        ([(1.0, 4.0), (0.999, 5.0)], 1000, 1),
        ([(1.0, 4.0), (0.995, 5.0)], 1000, 0),  # five are not
        ([(0.5, 4.0), (0.52, 3.0)], 1000, 0),
        ([(0.5, 4.0), (0.55, 3.0)], 1000, 1),
        ([(0.9999, 4.0), (0.999, 5.0)], 100_000, 0),  # the more episodes, the finer
        ([(0.0, -3.0), (0.0, -2.0)], 100, 1),  # a task without success
        ([(1.0, 4.0), (1.0, 4.0)], 1000, 0),  # the first of equals
        ([score_of(0.0, float("nan")), (0.0, -1e9)], 8, 1),
    ],
)
def test_near_ties_in_success_go_to_the_return(scores, episodes, kept):
    assert best_of(scores, episodes) == kept


def test_small_losses_of_success_do_not_add_up():
    best, highest = (1.0, 0.0), 1.0
    for i in range(1, 200):
        new = (1.0 - i / 1000, float(i))  # each is near the one before, with a higher return
        if best_of([best, new], 1000, highest) == 1:
            best = new
    assert best[0] >= 0.998


def test_the_first_policy_of_the_highest_success_replaces_one_that_is_no_longer_near():
    assert best_of([(0.9, 10.0), (0.99, 1.0)], 1000, highest_success=0.99) == 1
