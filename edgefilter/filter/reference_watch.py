"""Whether the reference is one: it is there, it comes before its echo, and the robot that is heard is found in it."""

from __future__ import annotations

import math
import sys
from typing import Literal

import numpy as np

from edgefilter.alignment.aligner import COARSE_MARGIN
from edgefilter.alignment.belief import SAME
from edgefilter.alignment.delay_line import WAIT, Aligned, Tape
from edgefilter.alignment.lag_search import CERTAIN, SEEN_ODDS, WINDOW, Found, LagSearch
from edgefilter.alignment.utterances import FLOOR, NEVER, OnsetDetector
from edgefilter.dsp import fourier
from edgefilter.dsp.lag import one_signal
from edgefilter.filter.microphones import SILENT
from edgefilter.filter.playback_faults import LENGTH, SPEEDS, GrowingLag, other_speed
from edgefilter.filter.removal import Removal
from edgefilter.filter.robot_sound import LOUD, RobotSound
from edgefilter.filter.volume import pre_emphasised
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, EventKind, Frame, Samples

LATEST = SAMPLE_RATE
"""Samples by which a reference may be late and is still recognised as such."""
SEARCH_STRIDE = SAMPLE_RATE // 4
"""Samples of an utterance between two looks for it in what the microphone heard before."""
IN_VAIN = 6
"""Looks, 1.5 s of speech, after which an utterance that is found nowhere is taken for one that is not heard."""
IN_TIME = SAMPLE_RATE
"""Samples of an echo that is followed behind the reference, after which that is not late, whatever a look has found."""
DOUBT = SAMPLE_RATE // 2
"""Samples for which speech that begins while the reference is silent waits for it, until it is known to come in time: an
onset of the robot's is no human's if the reference follows."""
UNFOUND, LOUDER = 5 * SAMPLE_RATE, 10.0
"""Samples of reference, 5 s, that must have played without being found, and the ratio of the microphone's power meanwhile to its power
while the reference is silent, 10 dB, from which on the robot is heard: people who talk half of the time cause less."""
MISSING, HEARD = 60 * SAMPLE_RATE, 10 * SAMPLE_RATE
"""Samples without any reference, of which so many were not silent at the microphone, SILENT of full scale: a level of the
converter, since there is nothing else to compare with. 16 bits by themselves are 41 dB softer."""
FELL_SILENT = 1e-3
"""Power of the reference, over its power while the robot talks, below which it is silent, -30 dB: the noise of a loopback is."""
SPEED_STRIDE, SPEED_LOOKS = SAMPLE_RATE, 8
"""Samples of speech between two comparisons of the speed, and how many there are at most: the echo is not found meanwhile, and
each costs half a hop."""
SAME_S = 2.0
"""Seconds of sound after which microphone and reference are compared sample by sample."""
Verdict = Literal["unknown", "fits", "late"]


class ReferenceWatch:
    """Looks at both channels beside the aligner, hop by hop, and says once what is wrong with the reference.

    The aligner finds echoes that come after the reference. Here each utterance that it has not found is looked for in
    what the microphone heard before, in the same way with the channels exchanged. A robot often says what resembles an
    earlier utterance, whose echo the microphone may still hear: so what is found there must not be found as well, at the
    same lag, in the reference that the aligner has delayed. hop: samples a step. bins: of a spectrum. verdict: "unknown"
    until an utterance was found by either, or by neither for long; "fits" and "late" then. without: whether the robot is
    heard while the reference is silent. same: whether microphone and reference are one signal.

    >>> watch = ReferenceWatch(256, 257)
    >>> watch.verdict, watch.wait
    ('unknown', 8000)
    """

    def __init__(self, hop: int, bins: int) -> None:
        self._hop = hop
        self._search = LagSearch(LATEST)
        self._mic, self._ref, self._earlier = (Tape(self._search.span + LENGTH) for _ in range(3))
        self._onsets = OnsetDetector(hop)
        self.verdict: Verdict = "unknown"
        self.without = self.same = False
        self._late = self._stage = self._looks = self._in_time = 0
        self._seen_at, self._seen_apart, self._seen_last = NEVER, 0, NEVER
        self._growing, self._lacks = GrowingLag(), False
        self._speed: float | None = None
        self._off_speed, self._to_compare, self._compared = False, 0, 0
        self._to_search = SEARCH_STRIDE
        self._idle = True
        self._power = {"unfound": [0.0, 0], "idle": [0.0, 0]}
        self._sound = RobotSound(hop, bins)
        self._played, self._played_at = 0.0, -LATEST
        self._products, self._sounding = np.zeros(3), 0
        self._said: set[str] = set()
        self._ever = False
        self._silent = self._heard = 0

    @property
    def suspect(self) -> bool:
        """Whether what is heard may be the robot, whose reference comes later or not at all."""
        return self.without or (self._displaced and not self._idle)

    @property
    def _displaced(self) -> bool:
        """Whether a fault of the reference is known: it is late, lacks samples or has another speed."""
        return self.verdict == "late" or self._lacks or self._off_speed

    @property
    def wait(self) -> int:
        """Samples for which what sounds like a human has to be waited with: the reference may still show it to be the robot."""
        if self.verdict == "fits":
            return 0
        if not self._idle:  # what has begun is told once it is found that the reference fits, never if it is late
            return sys.maxsize
        return max(DOUBT, self._late + SEARCH_STRIDE)

    def step(
        self, mic: Samples, ref: Samples, aligned: Aligned, frame: Frame, removal: Removal, speaking: bool
    ) -> list[tuple[EventKind, str]]:
        """Take a hop (hop,) of both channels and what was made of it; what is to be said. speaking: whether a human is."""
        self._mic.push(mic)
        self._ref.push(ref)
        self._earlier.push(aligned.reference)
        if self._onsets.step(ref):
            self._stage, self._to_search, self._looks = 0, SEARCH_STRIDE, 0
        self._idle = aligned.state in ("idle", "announced")  # what was announced is no reference before it is heard
        said = self._look(aligned)
        power, played = float(mic.dot(mic)) / self._hop, float(ref.dot(ref)) / self._hop
        checks: tuple[tuple[EventKind, str], ...] = (
            ("robot_unfound", self._weigh(power, aligned)),
            ("echo_unpredicted", self._unpredicted(removal)),
            ("same_signal", self._same(pre_emphasised(mic), pre_emphasised(ref))),
            ("reference_gaps", self._lacks_samples(aligned)),
            ("rate_mismatch", self._compare_speed(aligned)),
            (
                "reference_missing",
                self._wait_for_any(power, played) or self._listen_without(played, aligned, frame, speaking),
            ),
        )
        return said + [(kind, detail) for kind, detail in checks if detail]

    def _once(self, what: str) -> bool:
        """Whether this is the first time."""
        first = what not in self._said
        self._said.add(what)
        return first

    def _unpredicted(self, removal: Removal) -> str:
        """Say that hardly anything of the robot can be subtracted."""
        holds = self._growing.holds(self._ref.end)  # of a lag that has just changed nothing is learned yet
        if not removal.unpredicted or self._displaced or not holds or not self._once("unpredicted"):
            return ""
        return (
            f"the linear stage removes only {removal.removed_db:.1f} dB of the robot: the microphone seems to be processed, the"
            " loudspeaker distorts, or the reference is of another recording; switch off noise suppression, gain control and"
            " echo cancellation of the device, and turn the volume down"
        )

    def _lacks_samples(self, aligned: Aligned) -> str:
        """Say that the lag grows again and again."""
        if aligned.realigned:
            self._growing.step(self._ref.end, aligned.delay)
        grown = self._growing.grown(self._ref.end)
        self._lacks = grown > 0
        if not self._lacks or not self._once("gaps"):
            return ""
        return (
            f"samples are missing in the reference: its echo comes later and later, by {1000 * grown / SAMPLE_RATE:.0f} ms in"
            " the last 10 s; little of the robot is removed, and nobody is noticed while it talks; use a loopback that loses"
            " nothing, or larger buffers"
        )

    def _compare_speed(self, aligned: Aligned) -> str:
        """While the echo is not found, look for it at other speeds; believe what two looks in a row find."""
        if aligned.state == "locked":
            self._off_speed, self._speed = False, None
            return ""
        start = self._ref.end - round(SPEEDS[0] * LENGTH)
        if not self._onsets.active or start < self._onsets.current.start or self._compared == SPEED_LOOKS:
            return ""
        self._to_compare -= self._hop
        if self._to_compare > 0:
            return ""
        self._to_compare, self._compared = SPEED_STRIDE, self._compared + 1
        before = self._speed
        self._speed = other_speed(self._mic.read(start, start + LENGTH), self._ref.read(start, self._ref.end))
        if self._speed is None or self._speed != before:
            return ""
        self._off_speed = True
        if not self._once("speed"):
            return ""
        taken, has = ("44.1", "48") if self._speed > 1.0 else ("48", "44.1")
        return (
            f"the loudspeaker plays the reference {100 * abs(self._speed - 1.0):.1f} % {'faster' if self._speed > 1.0 else 'slower'}"
            f" than it is given: {taken} kHz seem to be played as {has} kHz; nothing of the robot is removed, and nobody is"
            " noticed while it talks; give the player the rate that its sound has"
        )

    def _same(self, mic: Samples, ref: Samples) -> str:
        """Add up products of both channels until they hold enough sound to tell whether they are one signal."""
        products = float(mic.dot(ref)), float(mic.dot(mic)), float(ref.dot(ref))
        if min(products[1:]) > FLOOR * self._hop:
            self._products += products
            self._sounding += self._hop
        if self._sounding < SAME_S * SAMPLE_RATE:
            return ""
        self.same = one_signal(*self._products)
        self._products, self._sounding = np.zeros(3), 0
        if not self.same or not self._once("same"):
            return ""
        return (
            "the microphone and the reference are the same signal: all of it is taken for the robot and removed; give the"
            " microphone's own recording or device, and for the reference what the loudspeaker plays"
        )

    def _listen_without(self, played: float, aligned: Aligned, frame: Frame, speaking: bool) -> str:
        """Learn the spectrum of the robot at the microphone, and look for it there while the reference is silent."""
        now = self._ref.end
        if played > FELL_SILENT * self._played:
            self._played_at, self.without = now, False
            self._sound.forget()
        if aligned.state in ("locked", "coarse") and not speaking:
            brought = float(aligned.reference.dot(aligned.reference)) / self._hop
            if brought > LOUD * self._onsets.peak:
                self._played += 0.01 * (brought - self._played) if self._played else brought
                self._sound.learn(fourier.power(frame.mic))
        lag = LATEST if math.isnan(aligned.delay) else int(aligned.delay)
        if now - self._played_at < lag + SAMPLE_RATE // 4:
            return ""
        robot = self._sound.compare(fourier.power(frame.mic), frame.noise_psd)
        if robot is None or robot == self.without:
            return ""
        self.without = robot
        return robot * (
            f"the reference has been silent for {(now - self._played_at) / SAMPLE_RATE:.0f} s, while the microphone hears what"
            " sounds like the robot: it is not removed, and no speech is reported; was the robot's output moved to another"
            " device?"
        )

    def _look(self, aligned: Aligned) -> list[tuple[EventKind, str]]:
        """One step of a search, where one is due, and what it leads to."""
        if aligned.state == "locked" and aligned.delay < -WAIT:
            self._stage = 0  # a search that rests would compare what lies further apart than it looks
            return self._found_late(round(-aligned.delay))
        if aligned.state in ("locked", "coarse") and self.verdict != "fits":
            self._in_time += self._hop
            if self.verdict == "unknown" or self._in_time >= IN_TIME:
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
        if found and self._agrees(found) and not self._resembles_earlier(found.lag):
            self._looks = 0
            return self._found_late(found.lag)
        self._looks += 1
        if self._looks >= IN_VAIN and (self.verdict == "unknown" or aligned.state == "locked"):
            self.verdict = "fits"
        return []

    def _agrees(self, found: Found) -> bool:
        """Whether the lateness that a look found is certain by what it and those before it saw at the same lag.

        A look that shares no sound with one that saw the lag before makes it SEEN_ODDS more likely; one that is more likely
        wrong than right does not contradict them.
        """
        if found.lag >= WAIT and abs(found.lag - self._seen_at) <= SAME:
            if found.at - self._seen_last >= WINDOW:
                self._seen_apart, self._seen_last = self._seen_apart + 1, found.at
            self._seen_at = found.lag
            return found.odds * SEEN_ODDS**self._seen_apart > CERTAIN
        if found.odds > 1.0:
            self._seen_at, self._seen_apart, self._seen_last = found.lag, 0, found.at
        return False

    def _found_late(self, samples: int) -> list[tuple[EventKind, str]]:
        """The reference is late by so many samples; what is to be said."""
        self.verdict, self._late, self._in_time = "late", samples, 0
        told = (
            f"the reference comes {1000 * samples / SAMPLE_RATE:.0f} ms after the microphone has heard it: the robot is"
            " not removed, and nobody is noticed while it talks; hand the reference over earlier, or the microphone later;"
            " or are the two swapped?"
        )
        return [("reference_late", told)] if self._once("late") else []

    def _resembles_earlier(self, lag: int) -> bool:
        """Whether the utterance resembles what the aligner says is heard of an earlier one, about that many samples before."""
        self._prepare(self._earlier)
        self._listen()
        found = self._search.find()  # the aligned reference comes somewhat before its echo
        return found is not None and abs(found.lag - lag) <= COARSE_MARGIN + PRE_ROLL

    def _prepare(self, tape: Tape) -> None:
        """Begin a search for the present utterance in that tape, from LATEST before its beginning on."""
        self._search.prepare(tape, self._ref.end, self._onsets.current.start - LATEST)

    def _listen(self) -> None:
        """Give the search the utterance's latest WINDOW of the reference."""
        now = self._ref.end
        self._search.listen({0: self._ref}, now, max(self._onsets.current.start, now - WINDOW))

    def _weigh(self, power: float, aligned: Aligned) -> str:
        """Compare the microphone's power while the reference plays but is not found with that while the reference is silent."""
        if aligned.state == "locked":
            self._power["unfound"] = [0.0, 0]
            self._said.discard("unfound")
        if aligned.state in self._power and not self._displaced:
            entry = self._power[aligned.state]
            entry[0] += power
            entry[1] += self._hop
        (unfound, samples), (idle, before) = self._power["unfound"], self._power["idle"]
        if samples < UNFOUND or before < SAMPLE_RATE:
            return ""
        ratio = (unfound / samples) / max(idle / before, 1e-12)
        if ratio < LOUDER or not self._once("unfound"):
            return ""
        return (
            f"the microphone is {10 * np.log10(ratio):.0f} dB louder while the reference carries sound, which is not found"
            " in it: it is another sound than the loudspeaker's, too late, or processed on the way; 'edgefilter doctor'"
        )

    def _wait_for_any(self, power: float, played: float) -> str:
        """Count what is heard while no reference ever came."""
        self._ever = self._ever or played > FLOOR
        if self._ever:
            return ""
        self._silent += self._hop
        self._heard += self._hop if power > SILENT else 0
        if self._silent < MISSING or self._heard < HEARD or not self._once("missing"):
            return ""
        return (
            f"the reference has been silent for {self._silent / SAMPLE_RATE:.0f} s, since the start: if the robot has"
            " spoken, it is the wrong one"
        )
