"""Whether what a recogniser heard is the robot itself: its text held against what the robot has just said.

A guard behind the filter: whatever of the robot still gets through is often recognised as the robot's own words.
"""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgefilter.errors import UsageError

LEAST = 9
"""Score from which a passage counts as found: so many letters and blanks in a row, each wrong, missing or additional one
made up for by a right one more. "and the" has 9 with the blanks around it. Of sentences that have nothing to do with each
other a fiftieth is found so, at most a third; texts that are shorter than that have to be found whole."""
REACH_S = 2.0
"""Seconds by which the times of what was said and heard may differ: lag of the playback, the recogniser's own times."""
SURE = 0.02
"""Bound on what either witness may say where both are weighed, so that none decides alone."""


class Said(NamedTuple):
    """Words of the robot, and the seconds at which they begin and end, on the clock of what was heard."""

    text: str
    start: float
    end: float


def score(
    hypothesis: str,
    said: str | Iterable[str | Said],
    heard: tuple[float, float] | None = None,
    speech_probability: float | None = None,
) -> float:
    """How much of what the recogniser heard are the robot's own recent words, 0 to 1.

    Nothing is deleted: people do repeat the robot's words, so the application decides what to do.

    Parameters
    ----------
    hypothesis : str
        What the recogniser heard.
    said : str, or iterable of str or Said
        What the robot said lately, as it was handed to its voice. Pieces without times always count.
    heard : (float, float), optional
        Seconds between which the hypothesis was heard; of pieces with times only those within `REACH_S` of it count.
    speech_probability : float, optional
        Probability that a human spoke meanwhile: the mean of `EgoFilter.speech_probability` over the time between
        `heard`, or by any other detector.

    Returns
    -------
    float
        The part of the hypothesis' words, weighed by their letters, that lie in passages which the robot said: 0 where
        nothing was heard or said. With a probability of speech, the two as independent witnesses (Bayes' rule with even
        odds): with one of 0.5 the score stays what it is.

    Raises
    ------
    UsageError
        For a probability outside 0 to 1, or times that end before they begin.

    Notes
    -----
    Both texts are compared as letters, digits and blanks, without case, accents and punctuation. A passage is a local
    alignment (Smith & Waterman 1981), so that misheard, split and joined words count as far as they sound alike on
    paper. Two words in common prove nothing, and a short answer that the robot has just said itself ("yes", "at nine")
    is found whole: there the probability of speech has to decide.

    Examples
    --------
    >>> said = "The kitchen light is on. Shall I turn it off?"
    >>> score("the kitchen light as on", said)
    1.0
    >>> score("No, leave it on please", said)
    0.0
    >>> round(score("kitchen light is on, no, leave it please", said), 2)
    0.52
    >>> round(score("turn it off", said, speech_probability=0.9), 2)
    0.84
    """
    if heard is not None and not (math.isfinite(heard[0]) and heard[0] <= heard[1] < math.inf):
        raise UsageError(f"heard is {heard}, expected (start, end) in seconds with start <= end")
    if speech_probability is not None and not 0.0 <= speech_probability <= 1.0:
        raise UsageError(f"speech_probability is {speech_probability}, expected 0 to 1")
    words = normalise(hypothesis).split()
    robot = normalise(recent(said, heard))
    if not words or not robot:
        return 0.0
    part = explained(words, robot)
    if speech_probability is None:
        return part
    for_robot, for_human = (min(max(p, SURE), 1.0 - SURE) for p in (part, speech_probability))
    robots, humans = for_robot * (1.0 - for_human), (1.0 - for_robot) * for_human
    return robots / (robots + humans)


def normalise(text: str) -> str:
    """Lower case without accents; all but letters and digits are blanks, one between words.

    >>> normalise("Café — it's 9 o'clock!")
    'cafe its 9 oclock'
    """
    plain = "".join(c for c in unicodedata.normalize("NFKD", text.casefold()) if not unicodedata.combining(c))
    return " ".join("".join(c if c.isalnum() else " " for c in plain if c not in "'\u2019").split())


def recent(said: str | Iterable[str | Said], heard: tuple[float, float] | None) -> str:
    """The robot's words that can have been heard then."""
    texts = []
    for piece in [said] if isinstance(said, str) else said:
        if isinstance(piece, str):
            texts.append(piece)
        elif heard is None or (piece.start - REACH_S <= heard[1] and piece.end + REACH_S >= heard[0]):
            texts.append(piece.text)
    return " ".join(texts)


def explained(words: list[str], robot: str) -> float:
    """Part of the words, weighed by their letters, at least half of whose letters lie in a passage of the robot's text."""
    heard = f" {' '.join(words)} "
    found = passages(heard, f" {robot} ", min(LEAST, len(heard)))
    letters, at = 0, 1
    for word in words:
        if 2 * np.count_nonzero(found[at : at + len(word)]) >= len(word):
            letters += len(word)
        at += len(word) + 1
    return letters / sum(map(len, words))


def passages(heard: str, robot: str, least: int) -> NDArray[np.bool_]:
    """Whether each letter is found in a passage of the robot's text that scores `least` or more, (len(heard),)."""
    found = np.zeros(len(heard), bool)
    a, b = (np.array([ord(c) for c in text]) for text in (heard, robot))
    parts = [(0, a.size)]
    while parts:  # the best passage first, then what is left before and behind it
        start, end = parts.pop()
        if end - start < least:
            continue
        equal = a[start:end, None] == b
        best = best_until(equal)
        row, column = divmod(int(np.argmax(best)), best.shape[1])
        if best[row, column] >= least:
            letters = traced(best, equal, row, column)
            found[start + np.array(letters)] = True
            parts += [(start, start + letters[-1]), (start + row, end)]
    return found


def best_until(equal: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Score of the best alignment of letters that ends behind the first i and j, (n + 1, m + 1); equal: (n, m)."""
    steps = np.arange(equal.shape[1] + 1)
    best = np.zeros((equal.shape[0] + 1, equal.shape[1] + 1), np.int64)
    for row, same in enumerate(equal):
        above, here = best[row], best[row + 1]
        np.maximum(above[1:] - 1, above[:-1] + np.where(same, 1, -1), out=here[1:])
        np.maximum(here, 0, out=here)
        # letters that the robot alone has: the best place to the left, less what the way from there costs
        here[:] = np.maximum.accumulate(here + steps) - steps
    return best


def traced(best: NDArray[np.int64], equal: NDArray[np.bool_], row: int, column: int) -> list[int]:
    """The letters, last first, that are the same in both texts along the alignment that ends there."""
    same = []
    while best[row, column] > 0:
        paired = equal[row - 1, column - 1]
        if best[row, column] == best[row - 1, column - 1] + (1 if paired else -1):
            row, column = row - 1, column - 1
            same += [row] if paired else []
        elif best[row, column] == best[row - 1, column] - 1:
            row -= 1
        else:
            column -= 1
    return same
