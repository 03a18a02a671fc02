"""When the human begins and stops speaking: what a robot that can be interrupted waits for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

from edgefilter.errors import UsageError
from edgefilter.types import EventKind

Judge: TypeAlias = Literal["engine", "network"]
INTERRUPTIONS: frozenset[EventKind] = frozenset({"speech_started"})
"""The events at which a robot should stop."""
ODDS_RANGE = (-2.0, 8.0)
"""Bounds on the network's log-odds of one hop, so that none outweighs a tenth of a second."""
ODDS_MEMORY_S = 0.0133
"""Time constant over which they are averaged: a voiced sound is longer, a burst of the loudspeaker is not."""
CENTRE, SLOPE = 3.5, 1.25
"""Averaged log-odds of the network at which a human is as likely as not, without a profile, and the slope of the logistic
around it. By hand, near what a logistic fits to robots alone and to humans laid on them 0 to 26 dB below, steeper, so that
few hops lie near the threshold. Checked without a profile, on validation speakers: of 39 humans in recordings of 6 real
loudspeakers all are noticed, 20 within 0.5 s; of 24 in simulated conversations 23, 20 of them within 0.5 s. 7 minutes of
the real robots alone and 8 of the simulated ones start nothing."""
CENTRE_CALIBRATED = 2.25
"""The same with a profile: the network was trained on what a calibrated path leaves, and is wrong less often."""


@dataclass(frozen=True)
class BargeInSettings:
    """When speech counts as begun and as ended.

    threshold: probability that must be reached. Higher (0.985) for a robot that must not be stopped by its own
    loudspeaker or a running tap, at the price of the softest humans and some 20 ms; lower (0.9) for one that would
    rather stop once too often. release: probability below which a hop counts as silent; lower than the threshold, so
    that soft syllables do not end a sentence. min_speech_s: how long the threshold is held before speech has begun; the
    probability is smoothed already, so that 0 will do, and every 0.1 s comes on top of the delay. min_silence_s: how
    long the silence lasts before speech has ended; 0.5 s bridges the pauses within a sentence, 0.2 s tells a recogniser
    sooner. judge: "engine", or "network" to let crnn's network judge beside an engine that judges no speech (`ss`,
    `linear`), at what crnn costs.
    Raises UsageError for probabilities outside 0 to 1, a release above the threshold, negative times, or another judge.
    """

    threshold: float = 0.97
    release: float = 0.4
    min_speech_s: float = 0.0
    min_silence_s: float = 0.5
    judge: Judge = "engine"

    def __post_init__(self) -> None:
        if not 0.0 < self.release <= self.threshold < 1.0:
            found = f"release {self.release} and threshold {self.threshold}"
            raise UsageError(f"barge-in got {found}, expected probabilities with 0 < release <= threshold < 1")
        if not (self.min_speech_s >= 0.0 and self.min_silence_s >= 0.0):
            found = f"min_speech_s {self.min_speech_s} and min_silence_s {self.min_silence_s}"
            raise UsageError(f"barge-in got {found}, expected seconds, 0 or more")
        if self.judge not in get_args(Judge):
            raise UsageError(f"barge-in got judge '{self.judge}', expected one of {', '.join(get_args(Judge))}")


class HumanJudge:
    """Smooths the network's probability that a human speaks, of one stream, with or without a profile; step once each hop_s."""

    def __init__(self, hop_s: float, calibrated: bool) -> None:
        self._centre = CENTRE_CALIBRATED if calibrated else CENTRE
        self._follow = 1.0 - math.exp(-hop_s / ODDS_MEMORY_S)
        self._odds = 0.0

    def step(self, probability: float, suspect: bool = False) -> float:
        """Probability that a human speaks, 0 to 1; 0 where it may be the robot (suspect): its lag is not found yet, or it is late."""
        if suspect:
            self._odds = 0.0
            return 0.0
        odds = math.log(max(probability, 1e-9) / max(1.0 - probability, 1e-9))
        self._odds += self._follow * (min(max(odds, ODDS_RANGE[0]), ODDS_RANGE[1]) - self._odds)
        return 1.0 / (1.0 + math.exp(-SLOPE * (self._odds - self._centre)))


class BargeIn:
    """Turns one stream's probabilities into beginnings and ends of speech.

    hop_s: seconds between two probabilities. settings: None for the defaults.

    >>> talk = BargeIn(0.016)
    >>> [talk.note(probability) for probability in (0.2, 0.99)]
    [None, 'speech_started']
    """

    def __init__(self, hop_s: float, settings: BargeInSettings | None = None) -> None:
        self.settings = settings = settings or BargeInSettings()
        self._least = max(1, round(settings.min_speech_s / hop_s))
        self._pause = max(1, round(settings.min_silence_s / hop_s))
        self._sure = self._silent = self._waited = 0
        self._begun = self.speaking = False

    @property
    def waited(self) -> int:
        """Hops since speech began, in the hop in which that is told."""
        return self._waited - 1

    def end(self) -> bool:
        """The recording is over; whether somebody was speaking."""
        was, self.speaking, self._begun = self.speaking, False, False
        self._sure = self._silent = self._waited = 0
        return was

    def note(self, probability: float | None, wait: int = 0) -> EventKind | None:
        """Take the probability of a hop, None where the engine does not judge it.

        wait: hops for which speech that has begun is not told yet; if it has ended by then it never is.
        """
        probability = probability or 0.0
        self._sure = self._sure + 1 if probability >= self.settings.threshold else 0
        self._silent = self._silent + 1 if probability < self.settings.release else 0
        if not self._begun and self._sure >= self._least:
            self._begun, self._waited = True, 0
        if self._silent >= self._pause:
            told, self._begun, self.speaking = self.speaking, False, False
            return "speech_stopped" if told else None
        self._waited += 1
        if self._begun and not self.speaking and self._waited > wait:
            self.speaking = True
            return "speech_started"
        return None
