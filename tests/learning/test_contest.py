"""A candidate takes over only on clear evidence."""

import numpy as np
import pytest

from edgefilter.errors import UsageError
from edgefilter.learning.path_learner import SCHEDULE, CandidatePath, Schedule

LEAST, MOST = SCHEDULE.least, SCHEDULE.most


def candidate(gains):
    return CandidatePath(None, "a test", gains_db=list(gains))


def test_a_clear_and_steady_gain_wins():
    assert candidate([0.5, 0.6] * LEAST).won


def test_nothing_is_said_of_a_rival_without_a_comparison():
    assert not candidate([]).won and not candidate([]).over


def test_few_blocks_small_gains_and_scattered_ones_do_not():
    assert not candidate([1.0] * (LEAST - 1)).won
    assert not candidate([0.1, 0.12] * LEAST).won
    assert not candidate([6.0, -5.0] * LEAST).won


def test_a_loss_never_wins_and_ends():
    lost = candidate(np.full(MOST, -0.5))
    assert not lost.won
    assert lost.over


def test_a_standing_rival_is_scored_by_its_latest_blocks_and_never_given_up():
    standing = CandidatePath(None, "a test", stays=True, gains_db=[-1.0] * MOST)
    assert not standing.over
    standing.gains_db = [0.4, 0.5] * LEAST
    assert standing.won
    standing.restart()
    assert not standing.won


def test_a_schedule_that_would_never_end_is_refused():
    with pytest.raises(UsageError, match="factor is 0, expected more than 0"):
        Schedule(factor=0)
