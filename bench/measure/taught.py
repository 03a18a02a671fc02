"""Rows of the package's engines with and without calibration and learning.

What is learned does not depend on the engine: the lessons of a recording are kept for the row that comes next.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from edgefilter import PathLearner, Profile
from edgefilter.filter.echo_path import PathState
from edgefilter.filter.learner import Heard, Learner, Lesson

LEARNING, UNCALIBRATED = "-learning", "-uncalibrated"


class Row(NamedTuple):
    """What a row's name says: "crnn-uncalibrated-learning" is engine crnn without a profile, learning."""

    engine: str
    calibrated: bool
    learning: bool


def row(name: str) -> Row:
    """The row of that name."""
    base = name.removesuffix(LEARNING)
    engine = base.removesuffix(UNCALIBRATED)
    return Row(engine, engine == base, base != name)


class Kept:
    """A learner that learns a recording once, and then says again what it said; one stream only, from its first hop."""

    def __init__(self, profile: Profile | None) -> None:
        self._learner: Learner | None = PathLearner(profile)
        self._lessons: dict[int, Lesson] = {}
        self._at = 0

    @property
    def past(self) -> int:
        return PathLearner.past

    def start(self, path: PathState, hop: int) -> None:
        if self._at:
            self._learner, self._at = None, 0
        if self._learner:
            self._learner.start(path, hop)

    def hear(self, heard: Heard) -> Lesson | None:
        self._at += 1
        if self._learner and (lesson := self._learner.hear(heard)):
            self._lessons[self._at] = lesson
        return self._lessons.get(self._at)

    def stats(self) -> dict[str, object]:
        return {}

    def close(self) -> None: ...


_latest: tuple[tuple[str, bool], Kept] | None = None


def learner(wanted: Row, recording: str, profile: Callable[[], Profile | None]) -> Learner | None:
    """A learner for that row of a recording, told by its fingerprint: the one that has heard it just now, or a new one."""
    global _latest
    if not wanted.learning:
        return None
    key = (recording, wanted.calibrated)
    if _latest is None or _latest[0] != key:
        _latest = key, Kept(profile())
    return _latest[1]
