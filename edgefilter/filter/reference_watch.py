"""Whether the reference is one: it is there, it comes before its echo, and the robot that is heard is found in it."""

from __future__ import annotations

import sys
from typing import Literal

import numpy as np

from edgefilter.alignment.aligner import COARSE_MARGIN
from edgefilter.alignment.delay_line import Aligned, Tape
from edgefilter.alignment.lag_search import CERTAIN, WINDOW, LagSearch
from edgefilter.alignment.utterances import FLOOR, OnsetDetector
from edgefilter.filter.microphones import SILENT
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, EventKind, Samples

LATEST = SAMPLE_RATE
"""Samples by which a reference may be late and is still recognised as such."""
SEARCH_STRIDE = SAMPLE_RATE // 4
"""Samples of an utterance between two looks for it in what the microphone heard before."""
IN_VAIN = 6
"""Looks, 1.5 s of speech, after which an utterance that is found nowhere is taken for one that is not heard."""
ARRIVES = 32
"""Samples, 2 ms, by which a reference must be late to count as late: devices that share a buffer are as exact."""
DOUBT = SAMPLE_RATE // 2
"""Samples for which speech that begins while the reference is silent waits for it, until it is known to come in time: an
onset of the robot's is no human's if the reference follows."""
UNFOUND, LOUDER = 5 * SAMPLE_RATE, 10.0
"""Samples of a reference that is not found, and by how much more power the microphone must have then than while the
reference is silent, for the robot to be heard: 10 dB, more than people who talk half of the time bring about."""
MISSING, HEARD = 60 * SAMPLE_RATE, 10 * SAMPLE_RATE
"""Samples without any reference, of which so many were not silent at the microphone, SILENT of full scale: a level of the
converter, since there is nothing else to compare with. 16 bits by themselves are 41 dB softer."""
LITTLE_DB = 4.0
"""Removed of the robot below which its echo counts as unpredicted. Of 36 simulated conversations the least was 9 dB, of six
loudspeakers with humans as far below the echo as theirs 10; microphones that process their sound have -0.1 to 4."""
Verdict = Literal["unknown", "fits", "late"]


class ReferenceWatch:
    """Looks at both channels beside the aligner, hop by hop, and says once what is wrong with the reference.

    The aligner finds echoes that come after the reference. Here each utterance that it has not found is looked for in
    what the microphone heard before, in the same way with the channels exchanged. A robot often says what resembles an
    earlier utterance, whose echo the microphone may still hear: so what is found there must not be found as well, at the
    same lag, in the reference that the aligner has delayed. hop: samples a step. verdict: "unknown" until an utterance
    was found by either, or by neither for long; "fits" and "late" then.

    >>> watch = ReferenceWatch(256)
    >>> watch.verdict, watch.wait
    ('unknown', 8000)
    """

    def __init__(self, hop: int) -> None:
        self._hop = hop
        self._search = LagSearch(LATEST)
        self._mic, self._ref, self._earlier = (Tape(self._search.span) for _ in range(3))
        self._onsets = OnsetDetector(hop)
        self.verdict: Verdict = "unknown"
        self._late = self._stage = self._looks = 0
        self._to_search = SEARCH_STRIDE
        self._idle = True
        self._power = {"unfound": [0.0, 0], "idle": [0.0, 0]}
        self._unfound_said = self._missing_said = self._unpredicted_said = self._ever = False
        self._silent = self._heard = 0

    @property
    def suspect(self) -> bool:
        """Whether what is heard may be the robot, whose reference comes later."""
        return self.verdict == "late" and not self._idle

    @property
    def wait(self) -> int:
        """Samples for which what sounds like a human has to be waited with: the reference may still show it to be the robot."""
        if self.verdict == "fits":
            return 0
        if not self._idle:  # what has begun is told once it is found that the reference fits, never if it is late
            return sys.maxsize
        return max(DOUBT, self._late + SEARCH_STRIDE)

    def step(
        self, mic: Samples, ref: Samples, aligned: Aligned, removed_db: float | None
    ) -> list[tuple[EventKind, str]]:
        """Take a hop (hop,) of both channels, what the aligner made of it, and what is removed of the robot; what is to be said."""
        self._mic.push(mic)
        self._ref.push(ref)
        self._earlier.push(aligned.reference)
        if self._onsets.step(ref):
            self._stage, self._to_search, self._looks = 0, SEARCH_STRIDE, 0
        self._idle = aligned.state in ("idle", "announced")  # what was announced is no reference before it is heard
        said = self._look(aligned)
        power = float(mic.dot(mic)) / self._hop
        if unfound := self._weigh(power, aligned):
            said.append(("robot_unfound", unfound))
        if removed_db is not None and removed_db < LITTLE_DB and not self._unpredicted_said:
            self._unpredicted_said = True
            told = (
                f"the linear stage removes {removed_db:.1f} dB of the robot: the microphone seems to be processed, or the"
                " loudspeaker distorts; switch off noise suppression, gain control and echo cancellation of the device,"
                " and turn the volume down"
            )
            said.append(("echo_unpredicted", told))
        if missing := self._wait_for_any(power, float(ref.dot(ref))):
            said.append(("reference_missing", missing))
        return said

    def _look(self, aligned: Aligned) -> list[tuple[EventKind, str]]:
        """One step of a search, where one is due, and what it leads to."""
        if aligned.state in ("locked", "coarse") and self.verdict == "unknown":
            self.verdict = "fits"
        if not self._onsets.active:
            return []
        self._to_search -= self._hop
        stage, self._stage = self._stage, 0
        if stage == 2:
            return self._decide(aligned)
        if stage == 1:
            self._stage = 2
            self._listen()
        elif self._to_search <= 0 and not (aligned.state in ("locked", "coarse", "lost") and self.verdict == "fits"):
            self._to_search, self._stage = SEARCH_STRIDE, 1
            self._prepare(self._mic)
        return []

    def _decide(self, aligned: Aligned) -> list[tuple[EventKind, str]]:
        found = self._search.find()
        certain = found is not None and found.evidence > CERTAIN and found.lag >= ARRIVES
        if found is None or not certain or self._resembles_earlier(found.lag):
            self._looks += 1
            if self._looks >= IN_VAIN and (self.verdict == "unknown" or aligned.state == "locked"):
                self.verdict = "fits"
            return []
        known = self.verdict == "late"
        self.verdict, self._late, self._looks = "late", found.lag, 0
        told = (
            f"the reference comes {1000 * found.lag / SAMPLE_RATE:.0f} ms after the microphone has heard it: the robot is"
            " not removed, and nobody is noticed while it talks; hand the reference over earlier, or the microphone later"
        )
        return [] if known else [("reference_late", told)]

    def _resembles_earlier(self, lag: int) -> bool:
        """Whether the utterance resembles what the aligner says is heard of an earlier one, about that many samples before."""
        self._prepare(self._earlier)
        self._listen()
        found = self._search.find()  # the aligned reference comes somewhat before its echo
        return found is not None and abs(found.lag - lag) <= COARSE_MARGIN + PRE_ROLL

    def _prepare(self, tape: Tape) -> None:
        """Look in what that holds from LATEST before the utterance on."""
        self._search.prepare(tape, self._ref.end, self._onsets.current.start - LATEST)

    def _listen(self) -> None:
        """Look for the utterance."""
        now = self._ref.end
        self._search.listen({0: self._ref}, now, max(self._onsets.current.start, now - WINDOW))

    def _weigh(self, power: float, aligned: Aligned) -> str:
        """Compare the microphone while the reference is found nowhere with the microphone while it is silent."""
        if aligned.state == "locked":
            self._power["unfound"], self._unfound_said = [0.0, 0], False
        if aligned.state in self._power and self.verdict != "late":
            entry = self._power[aligned.state]
            entry[0] += power
            entry[1] += self._hop
        (unfound, samples), (idle, before) = self._power["unfound"], self._power["idle"]
        if self._unfound_said or samples < UNFOUND or before < SAMPLE_RATE:
            return ""
        ratio = (unfound / samples) / max(idle / before, 1e-12)
        if ratio < LOUDER:
            return ""
        self._unfound_said = True
        return (
            f"the microphone is {10 * np.log10(ratio):.0f} dB louder while the reference carries sound, which is not found"
            " in it: it is another sound than the loudspeaker's, too late, or processed on the way; 'edgefilter doctor'"
        )

    def _wait_for_any(self, power: float, ref_energy: float) -> str:
        """Count what is heard while no reference ever came."""
        self._ever = self._ever or ref_energy > FLOOR * self._hop
        if self._ever or self._missing_said:
            return ""
        self._silent += self._hop
        self._heard += self._hop if power > SILENT else 0
        if self._silent < MISSING or self._heard < HEARD:
            return ""
        self._missing_said = True
        return (
            f"the reference has been silent for {self._silent / SAMPLE_RATE:.0f} s, since the start: if the robot has"
            " spoken, it is the wrong one"
        )
