"""Whether the reference is one: it is there, it comes before its echo, and the robot that is heard is found in it."""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Iterator
from typing import Literal

import numpy as np

from edgefilter.alignment.aligner import FIRST_LOOK, LOOKS, Aligned, Past
from edgefilter.alignment.belief import LOOK, Belief
from edgefilter.alignment.lag_search import CERTAIN, MOST_LAG_S
from edgefilter.alignment.utterances import LAST_BIT, VARIES, Sustained
from edgefilter.dsp import fourier
from edgefilter.dsp.lag import one_signal
from edgefilter.filter.microphones import SILENT
from edgefilter.filter.playback_faults import AHEAD, BEHIND, CLEAR, LENGTH, STEP, other_rates, speeds
from edgefilter.filter.removal import Removal
from edgefilter.filter.robot_sound import RobotSound
from edgefilter.filter.volume import AUDIBLE, pre_emphasised
from edgefilter.types import SAMPLE_RATE, EventKind, Frame, Samples

OTHERS = 0.2
"""Share of the looks in which the microphone hears something where the robot plays unheard, into headphones, say: people take turns with
it; and of those in which it hears nothing where a sound is played."""
NONE_CAME, SOUNDED = 60 * SAMPLE_RATE, 10 * SAMPLE_RATE
"""Samples without any reference, of which so many were not silent at the microphone, SILENT of full scale: a level of the
converter, since there is nothing else to compare with. 16 bits by themselves are 41 dB softer."""
FELL_SILENT = 1e-3
"""Power of the reference, over its power while the robot talks, below which it is silent, -30 dB: the noise of a loopback is."""
SPEED_LOOKS = 8
"""Most looks at the speed, each after another LOOK of the robot's speech. There are looks only while the echo is not found."""
SAME_S = 2.0
"""Seconds of sound after which microphone and reference are compared sample by sample."""
Verdict = Literal["unknown", "fits", "late"]


class ReferenceWatch:
    """Reports each fault of the reference once, when it begins, from the aligner's belief and the levels of both channels.

    hop: samples a step. bins: their number in a spectrum. verdict: "unknown" until it is certain that the reference fits or is
    late. without: whether the robot is heard while the reference is silent. same: whether microphone and reference are one signal.

    >>> watch = ReferenceWatch(256, 257)
    >>> watch.verdict, watch.wait
    ('unknown', 8000)
    """

    def __init__(self, hop: int, bins: int) -> None:
        self._hop = hop
        self.verdict: Verdict = "unknown"
        self.without = self.same = False
        self._late = self._behind = 0
        self._missing, self._grew, self._another = "", False, False
        self._off_speed = False
        # of each search: logarithm of the playback speed that was found, and how far its peak stands out
        self._seen_speeds: list[tuple[float, float]] = []
        self._speeds: Iterator[tuple[float, float] | None] = iter(())  # of the look that is under way
        self._to_compare, self._looks_left = LENGTH, SPEED_LOOKS
        self._steady = 0  # samples of the robot's speech that were heard at one lag
        self._idle, self._begun_displaced = True, False
        self._sustained, self._loudest, self._least = Sustained(), 0.0, float("inf")
        self._rise = 10 ** (hop / (10 * SAMPLE_RATE))
        self._levels: deque[float] = deque(maxlen=LOOKS)
        self._sound = RobotSound(hop, bins)
        self._played, self._played_at = 0.0, -LOOK
        self._products, self._sounding = np.zeros(3), 0
        self._said: set[str] = set()
        self._ever = False
        self._silent = self._heard = 0

    @property
    def suspect(self) -> bool:
        """Whether the sound at the microphone may be the robot although no reference explains it: that comes late or never, or was late so far."""
        return self.without or self._begun_displaced or (self._displaced and not self._idle)

    @property
    def _displaced(self) -> bool:
        """Whether a fault of the reference is known: it is late, far ahead, lacks samples or has another speed."""
        return self.verdict == "late" or bool(self._behind or self._missing) or self._off_speed

    @property
    def wait(self) -> int:
        """Samples for which what sounds like a human has to be waited with: the reference may still show it to be the robot."""
        if self.verdict == "fits":
            return 0
        if not self._idle:  # what has begun is told once it is found that the reference fits, never if it is late
            return sys.maxsize
        return max(FIRST_LOOK, self._late)

    def step(
        self, mic: Samples, ref: Samples, aligned: Aligned, frame: Frame, removal: Removal, speaking: bool
    ) -> list[tuple[EventKind, str]]:
        """Take a hop (hop,) of microphone and reference, and what the filter made of it; the events to report. speaking: whether a human is."""
        begun = aligned.past.onsets.current
        if begun.end - begun.start == 2 * self._hop:
            self._loudest = 0.0
        self._begun_displaced = aligned.state == "begun" and (self._begun_displaced or self._displaced)
        self._idle = aligned.state in ("idle", "announced")  # announced speech is no reference before its echo is heard
        power, played = float(mic.dot(mic)) / self._hop, float(ref.dot(ref)) / self._hop
        self._loudest = max(self._loudest, self._sustained.step(power))
        if power > LAST_BIT:
            self._least = min(power, self._rise * self._least)
        # each fault, and its message while it lasts, "" once it has certainly ended, None while that is unknown
        causes: tuple[tuple[EventKind, str | None], ...] = (
            ("reference_late", self._late_by(aligned.belief, aligned.past)),
            ("robot_unfound", self._far_behind()),
            ("robot_unfound", self._unheard(aligned)),
            ("echo_unpredicted", self._unpredicted(removal)),
            ("same_signal", self._same(pre_emphasised(mic), pre_emphasised(ref))),
            ("reference_gaps", self._lacks_samples()),
            ("rate_mismatch", self._compare_speed(aligned)),
            ("reference_missing", self._wait_for_any(power, played)),
            ("reference_missing", self._listen_without(played, aligned, frame, speaking)),
        )
        began = [(kind, detail) for kind, detail in causes if detail and kind not in self._said]
        self._said = {kind for kind, detail in causes if detail or (detail is None and kind in self._said)}
        return began

    def _unpredicted(self, removal: Removal) -> str | None:
        """Say that hardly anything of the robot can be subtracted; an echo that is predicted after all is linear for good."""
        if not removal.unpredicted or self._displaced or self._grew:
            return None
        return (
            f"the linear stage removes only {removal.removed_db:.1f} dB of the robot: the microphone seems to be processed, the"
            " loudspeaker distorts, or the reference is of another recording; switch off noise suppression, gain control and"
            " echo cancellation of the device, and turn the volume down"
        )

    def _lacks_samples(self) -> str | None:
        """Say that the lag grows again and again, and not because the reference is played more slowly."""
        if not self._missing or not self._seen_speeds or self._off_speed:
            return None if self._missing else ""
        return (
            f"{self._missing}; little of the robot is removed, and nobody is noticed while it talks; use a loopback that loses"
            " no samples, or larger buffers"
        )

    def _compare_speed(self, aligned: Aligned) -> str | None:
        """While the echo is not found, look for it at other speeds, one of them a hop; add up what looks have found."""
        heard, ref, onsets = aligned.past
        if aligned.state == "locked":
            self._off_speed, self._seen_speeds, self._speeds = False, [(0.0, CLEAR)], iter(())
            self._steady = 0 if aligned.realigned else self._steady + self._hop * onsets.active
            if self._steady < LENGTH:  # at another speed one lag after the other is found for a moment
                return None
            self._looks_left = SPEED_LOOKS
            return ""
        self._steady = 0
        self._to_compare = LENGTH if self._idle else self._to_compare - self._hop * onsets.active
        found = next(self._speeds, False)
        if not isinstance(found, tuple):  # a look is under way, or none is
            start = ref.end - AHEAD - LENGTH
            if found is False and onsets.active and self._to_compare <= 0 < self._looks_left:
                self._to_compare, self._looks_left = LOOK, self._looks_left - 1
                self._speeds = speeds(heard.read(start, start + LENGTH), ref.read(start - BEHIND, ref.end))
                next(self._speeds)  # while both are as they were read
            return None
        speed = math.log(found[0])
        self._seen_speeds.append((speed, found[1]))
        right = sum(clear for at, clear in self._seen_speeds if abs(at) <= STEP / 2)
        alike = sum(clear for at, clear in self._seen_speeds if abs(at) > STEP / 2 and abs(at - speed) < STEP)
        if abs(speed) <= STEP / 2 or alike - right < CLEAR:
            return None
        self._off_speed = True
        off, way = 100 * abs(found[0] - 1.0), "faster" if speed > 0.0 else "slower"
        return (
            f"the loudspeaker plays the reference {off:.1f} % {way} than it is given{other_rates(found[0])}; nothing of the"
            " robot is removed, and nobody is noticed while the robot talks; set the player to the sample rate of its sound"
        )

    def _same(self, mic: Samples, ref: Samples) -> str | None:
        """Add up products of both channels until they hold enough sound to tell whether they are one signal."""
        products = float(mic.dot(ref)), float(mic.dot(mic)), float(ref.dot(ref))
        if min(products[1:]) > LAST_BIT * self._hop:
            self._products += products
            self._sounding += self._hop
        if self._sounding < SAME_S * SAMPLE_RATE:
            return None
        self.same = one_signal(*self._products)
        self._products, self._sounding = np.zeros(3), 0
        if not self.same:
            return ""
        return (
            "the microphone and the reference are the same signal: all of it is taken for the robot and removed; give the"
            " microphone's own recording or device, and for the reference what the loudspeaker plays"
        )

    def _listen_without(self, played: float, aligned: Aligned, frame: Frame, speaking: bool) -> str | None:
        """Learn the spectrum of the robot at the microphone, and look for it there while the reference is silent."""
        now = aligned.past.ref.end
        if played > FELL_SILENT * self._played:
            self._played_at, self.without = now, False
            self._sound.forget()
        if aligned.state in ("locked", "coarse") and not speaking:
            brought = float(aligned.reference.dot(aligned.reference)) / self._hop
            if brought > AUDIBLE * aligned.past.onsets.peak:
                self._played += 0.01 * (brought - self._played) if self._played else brought
                self._sound.learn(fourier.power(frame.mic))
        lag = LOOK if math.isnan(aligned.delay) else int(aligned.delay)
        if now - self._played_at < lag + SAMPLE_RATE // 4:
            return ""
        robot = self._sound.compare(fourier.power(frame.mic), frame.noise_psd)
        if robot is None:
            return None
        self.without = robot
        return robot * (
            f"the reference has been silent for {(now - self._played_at) / SAMPLE_RATE:.0f} s, while the microphone hears what"
            " sounds like the robot: it is not removed, and no speech is reported; was the robot's output moved to another"
            " device?"
        )

    def _late_by(self, belief: Belief | None, past: Past) -> str | None:
        """Take in what is believed after another look; say that the reference is late."""
        if belief is None:
            return None
        self._grew, late = bool((belief.steps[0][-1:] > 0).any()), belief.late[-1]
        if belief.missing or belief.lossy <= 1.0:  # once certain, as long as any look speaks for it
            self._missing = belief.missing
        if past.onsets.varies:
            self._levels.append(self._loudest / self._least)
        # of a robot that is heard some looks show the lag, of one that is not few a voice: where neither is so, it is another sound
        sounding = 2 * sum(level > VARIES for level in self._levels) - len(self._levels)
        unlike = np.logaddexp(belief.evidence, sounding * math.log(OTHERS / (1.0 - OTHERS)))
        self._another, self._loudest = bool(unlike < -math.log(CERTAIN)), 0.0
        self._behind = int(belief.lags[-1]) * bool(belief.beyond[-1] > CERTAIN / (CERTAIN + 1.0))
        if late > CERTAIN / (CERTAIN + 1.0):
            self.verdict = "late"
        elif late < 1.0 / (CERTAIN + 1.0):
            self.verdict = "fits"
        self._late = -int(belief.lags[-1]) if self.verdict == "late" else 0
        if self.verdict != "late":
            return ""
        return (
            f"the reference comes {1000 * self._late / SAMPLE_RATE:.0f} ms after the microphone has heard it: the robot is"
            " not removed, and nobody is noticed while it talks; hand the reference over earlier, or the microphone later;"
            " or are the two swapped?"
        )

    def _far_behind(self) -> str:
        """Say that the robot is heard later than its lag is followed."""
        if not self._behind:
            return ""
        return (
            f"the microphone hears the reference {self._behind / SAMPLE_RATE:.1f} s after it comes, and a lag of {MOST_LAG_S:g} s is the most"
            " that is followed: the robot is not removed, and nobody is noticed while it talks; hand the reference over later, or"
            " shorten what the player has waiting"
        )

    def _unheard(self, aligned: Aligned) -> str | None:
        """Say that the microphone hears something while the reference plays, but not the reference."""
        if aligned.state == "locked":  # what was believed before is refuted
            self._another = False
            return ""
        if not self._another or self._displaced:
            return None
        return (
            f"the microphone is {10 * math.log10(max(self._levels)):.0f} dB louder than its silence while the reference carries"
            " sound, which is not found in it: it is another sound than the loudspeaker's, too late, or processed on the way,"
            " or the loudspeaker is muted; 'edgefilter doctor'"
        )

    def _wait_for_any(self, power: float, played: float) -> str:
        """Count what the microphone hears while no reference has come yet; return the message, "" for none."""
        self._ever = self._ever or played > LAST_BIT
        if self._ever:
            return ""
        self._silent += self._hop
        self._heard += self._hop if power > SILENT else 0
        if self._silent < NONE_CAME or self._heard < SOUNDED:
            return ""
        return (
            f"the reference has been silent for {self._silent / SAMPLE_RATE:.0f} s, since the start: if the robot has"
            " spoken, it is the wrong one"
        )
