"""When the human begins and stops speaking: what a robot that can be interrupted waits for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

from edgefilter.errors import UsageError
from edgefilter.profile.while_moving import WhileMoving
from edgefilter.types import EventKind

Judge: TypeAlias = Literal["engine", "network"]
INTERRUPTIONS: frozenset[EventKind] = frozenset({"speech_started"})
"""The events at which a robot should stop talking."""
SUSPICIONS: frozenset[EventKind] = frozenset({"speech_suspected", "speech_dismissed"})
"""Those at which it may lower its voice, or raise it again: somebody may speak, and nobody did."""
CENTRE, SLOPE = 3.5, 1.25
"""Log-odds of the network at which a human is as likely as not, and the slope of the logistic around it. By hand, near what a
logistic fits to robots alone and to humans laid on them 0 to 26 dB below, steeper, so that few hops lie near the threshold."""
ERROR = 0.1
"""Rate of Wald's sequential test, were the hops independent: of robots taken for a human, and of humans for the robot. Chosen on
half of 19 real and simulated devices; on the others false starts fall from 20 to 9 (12 of them and 6 by motors) in 11 minutes,
and of 49 humans noticed within 0.5 s 48 still are, of whom the median one waits 24 ms longer. With 0.2 there are 12 false
starts, with 0.03 there are 7, and 47 humans in time."""
USUAL_S, LEARNED_S = 40.0, 120.0
"""Seconds of its own voice in which a robot is expected to be taken once for a human with more than even odds, and over which it learns
how often it is, beside as many of a usual robot. Most of 200 simulated robots (12 s each) and 8 of 14 real devices never are, some
every second or two: once in 13 s in the mean. Of simulated robots, and of real humans in time, 20 s and a minute give as many."""
FALL = 2.0
"""Rise of the threshold, in log-odds, with which a robot that talks alone exceeds it 2.7 times (e) as rarely: 1.8 to 2.6 measured at
log-odds from 1 to 3, of real and simulated robots."""
UNASKED = 1e-4
"""Error rate of that test, log-odds of 9.2, at which a calibrated robot believes in a human without waiting for its lower voice to be
heard. 124 simulated robots alone (recipe `field`, 25 minutes, closed loop): no sum that the lower voice has dismissed exceeded
8.7; false starts 9 with this bound and without it, 17 without lowering. Of 55 interruptions 51 % are believed within 0.4 s, 29
without this bound, 60 without lowering. Without a calibration it would give back 3 of the 5 false starts that lowering
prevents (75 robots), so these robots always wait."""
QUESTIONS_S = 1.0
"""Seconds from one lowering of the voice within which the robot does so again only for good reason, since a voice that falls more often sounds
broken: by definition. Of 52 humans laid on 13 real recordings 38 are noticed within a second, 34 if nobody were suspected
meanwhile, and the robot itself 8 times in 9.5 minutes either way."""


@dataclass(frozen=True)
class BargeInSettings:
    """When speech counts as begun and as ended.

    threshold: probability at which somebody is suspected to speak beside a usual robot; later hops above it count for a human,
    those below for the robot. A robot that is often taken for a human soon needs more, one that hardly ever is needs less, so the
    threshold stands for a rate of false starts (`at_rate`): 16 an hour with 0.97. Higher (0.985) for a robot that must not be
    stopped by its own loudspeaker or a running tap, at the price of the softest humans and some 20 ms; lower (0.9) for one that
    would rather stop once too often. confirm_s: how long the later hops are weighed at most until speech has begun, or was none;
    half of all beginnings are clear after 50 ms. With 0 the suspicion is the beginning: sooner, and more than twice as often the
    robot itself, or a door.
    release: probability below which a hop counts as silent; lower than the threshold, so that soft syllables do not end a
    sentence. min_silence_s: how long the silence lasts before speech has ended; 0.5 s bridges the pauses within a
    sentence, 0.2 s tells a recogniser sooner. judge: "engine", or "network" to let crnn's network judge beside an engine
    that judges no speech (`ss`, `linear`), at what crnn costs. ask_db: by how much the robot lowers its voice, dB, while
    somebody is suspected to speak; 0, never. What is heard with the lower voice then decides, unless a calibrated robot is
    certain before. It needs a player that follows `EgoFilter.voice_gain`; 12 dB is what one person does when another begins
    to talk.
    Raises UsageError for a setting beyond these bounds.
    """

    threshold: float = 0.97
    release: float = 0.4
    confirm_s: float = 0.3
    min_silence_s: float = 0.5
    judge: Judge = "engine"
    ask_db: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.release <= self.threshold < 1.0:
            found = f"release {self.release} and threshold {self.threshold}"
            raise UsageError(f"barge-in got {found}, expected probabilities with 0 < release <= threshold < 1")
        if not (0.0 <= self.confirm_s < math.inf and 0.0 <= self.min_silence_s < math.inf):
            found = f"confirm_s {self.confirm_s} and min_silence_s {self.min_silence_s}"
            raise UsageError(f"barge-in got {found}, expected seconds, 0 or more")
        if not 0.0 <= self.ask_db < math.inf:
            raise UsageError(f"barge-in got ask_db {self.ask_db}, expected decibels, 0 or more")
        if self.judge not in get_args(Judge):
            raise UsageError(f"barge-in got judge '{self.judge}', expected one of {', '.join(get_args(Judge))}")

    @classmethod
    def at_rate(cls, false_starts_per_hour: float, **others: Any) -> BargeInSettings:
        """Settings with the threshold for so many false starts in an hour in which the robot talks alone; others: as of the class.

        The mean of many robots has about this rate; most robots have fewer, since a few have many. The lower the rate, the more humans
        are missed. Raises UsageError for a rate that is not above 0 and below 90, that of a threshold of 0.5.

        >>> round(BargeInSettings.at_rate(9.0).threshold, 3)
        0.99
        """
        if not 0.0 < false_starts_per_hour < 3600.0 / USUAL_S:
            expected = f"expected more than 0 and less than {3600.0 / USUAL_S:.0f}"
            raise UsageError(f"barge-in got {false_starts_per_hour} false starts an hour, {expected}")
        odds = (3600.0 / USUAL_S / false_starts_per_hour) ** FALL
        return cls(threshold=odds / (1.0 + odds), **others)


class OwnVoice:
    """Learns how often a robot is taken for a human, and so which odds tell a human from this one.

    Moments with more than even odds that end without a human are counted while the robot is heard, and each further suspicion within
    such a moment. Their rate has a gamma distribution, a priori that of LEARNED_S of a usual robot (Gelman et al., "Bayesian data
    analysis", 2.6). hop_s: seconds between two hops. before: what its calibration has counted.
    """

    def __init__(self, hop_s: float, before: WhileMoving | None = None) -> None:
        self._hop_s, self._memory = hop_s, LEARNED_S / hop_s
        self._even = self._apart = round(BargeInSettings.confirm_s / hop_s)
        self._open = self._suspected = False
        self._peaks, self._hops = (before.moments, before.seconds / hop_s) if before else (0.0, 0.0)

    @property
    def higher(self) -> float:
        """By how much this robot raises the threshold, log-odds, so that its own voice causes no more false suspicions than a usual robot's."""
        return FALL * math.log((1.0 + self._peaks / (LEARNED_S / USUAL_S)) / (1.0 + self._hops / self._memory))

    @property
    def counted(self) -> tuple[float, float]:
        """False suspicions that were counted, and the seconds of the robot's voice in which they came; both are forgotten alike."""
        return self._peaks, self._hops * self._hop_s

    def note(self, odds: float, open_: bool) -> None:
        """Take the log-odds of a hop in which nobody is believed to speak. open_: whether somebody is suspected to."""
        forget = 1.0 - 1.0 / self._memory
        self._hops, self._peaks = forget * self._hops + 1.0, forget * self._peaks
        self._peaks += open_ and self._suspected and not self._open
        self._open, self._suspected = open_, open_ or self._suspected
        if odds >= 0.0:
            self._even = 0
        elif not open_ or self._even + 1 < self._apart:
            self._even += 1
            self._peaks += self._even == self._apart
            self._suspected &= self._even < self._apart

    def believed(self) -> None:
        """What was heard is a human."""
        self._even, self._open, self._suspected = self._apart, False, False


class BargeIn:
    """Turns one stream's probabilities into beginnings and ends of speech.

    Speech is suspected in the first hop that reaches the threshold, which `OwnVoice` raises or lowers for this robot. By how much
    the log-odds of the hops that follow exceed it is added up (Wald 1945, "Sequential tests of statistical hypotheses"): at the
    bounds of an ERROR, or by the sum's sign when the time to confirm is over, speech has begun, or the suspicion is dismissed. Where the
    robot lowers its voice to ask who speaks, those bounds only tell whether anybody does, human or robot. It is a human where the sum reaches the
    bound of UNASKED, or where speech goes on once the lower voice is heard at the microphone: from that moment on the sum begins
    anew and never falls below 0 (Page 1954, "Continuous inspection schemes"); if it does not reach the upper bound within
    the time to confirm, it was the robot. Within QUESTIONS_S of such a question the sum begins at the lower bound,
    the odds that the question left, and only where it reaches the upper one the robot asks again.
    hop_s: seconds between two probabilities. settings: None for the defaults. calibrated: whether the robot is. before: how often it
    was taken for a human during its calibration, for `own` to go on from.

    >>> talk = BargeIn(0.016)
    >>> [talk.note(probability) for probability in (0.2, 0.98, 0.99, 0.995, 0.995)]
    [None, 'speech_suspected', None, 'speech_started', None]
    """

    def __init__(
        self,
        hop_s: float,
        settings: BargeInSettings | None = None,
        calibrated: bool = False,
        before: WhileMoving | None = None,
    ) -> None:
        self.settings = settings = settings or BargeInSettings()
        self._pause = max(1, round(settings.min_silence_s / hop_s))
        self._longest = round(settings.confirm_s / hop_s)
        self._between, self._rest = round(QUESTIONS_S / hop_s), 0
        self.own = OwnVoice(hop_s, before)
        self._threshold = self._needed = log_odds(settings.threshold)
        self._bound, self._sure = log_odds(1.0 - ERROR), log_odds(1.0 - UNASKED) if calibrated else math.inf
        self._silent = 0
        self._forget()

    def _forget(self) -> None:
        self._hops, self._anew, self._asks = 0, 0, False
        self._evidence, self._prior, self._somebody, self._certain = 0.0, 0.0, False, False
        self._told: EventKind | None = None

    @property
    def speaking(self) -> bool:
        """Whether speech has begun and not ended."""
        return self._told == "speech_started"

    @property
    def asking(self) -> bool:
        """Whether the robot should speak more softly now, so that what is heard tells whether it was the robot."""
        return self._asks and not self._certain

    @property
    def waited(self) -> int:
        """Hops since speech was suspected, in the hop in which its beginning is told."""
        return self._hops - 1

    def end(self) -> EventKind | None:
        """The recording is over, and so is what was begun; what is to be told of that."""
        told, self._silent = self._told, 0
        self._forget()
        if told == "speech_started":
            return "speech_stopped"
        return "speech_dismissed" if told else None

    def note(
        self, probability: float | None, wait: int = 0, heard_after: int = 0, robot: bool = False
    ) -> EventKind | None:
        """Take the probability of a hop, None where the engine does not judge it.

        wait: hops for which speech that has begun is not told yet, nor suspected; if it has ended by then it never is.
        If the wait falls to 0 because the robot's lag was found, the evidence is summed anew, as once a lowered voice is heard.
        heard_after: hops after which a voice that is lowered now would be heard lower; 0 where it cannot be lowered.
        robot: whether the robot's voice is heard, so that the hop teaches how often it is taken for a human.
        """
        probability, before = probability or 0.0, self._certain
        told = self._judge(probability, wait, heard_after)
        if before or self._certain:
            self.own.believed()
        elif robot:
            self.own.note(log_odds(probability), self._hops > 0)
        return told

    def _judge(self, probability: float, wait: int, heard_after: int) -> EventKind | None:
        self._silent = self._silent + 1 if probability < self.settings.release else 0
        self._rest = max(0, self._rest - 1)
        if not self._hops:
            self._needed = self._threshold + self.own.higher
            if log_odds(probability) < self._needed:
                return None
        if not self._hops or (self._certain and not self._told and not wait):  # suspected, or the wait is over
            self._evidence = self._prior = -self._bound if self._rest else 0.0
            self._anew, self._asks, self._certain = self._hops, False, False
            if not self._rest:
                self._ask(heard_after)
        self._hops += 1
        if self._silent >= self._pause or not self._holds(probability):
            return self.end()
        if self._certain and self._rest and not (self.speaking or self._asks or self._evidence >= self._sure):
            self._ask(heard_after)
        now: EventKind = "speech_started" if self._certain else "speech_suspected"
        if self._hops <= wait or self._told in (now, "speech_started"):
            return None
        self._told = now
        return now

    def _ask(self, heard_after: int) -> None:
        """Let the robot lower its voice, if it is soon heard lower: what is heard from then on decides."""
        if 0 < heard_after <= self._longest:
            self._rest, self._anew = self._between, self._hops + heard_after
            self._asks, self._certain = True, False

    def _holds(self, probability: float) -> bool:
        """Whether what was suspected is not dismissed by another hop."""
        if self._certain:
            return True
        if self._hops == self._anew + 1 > 1:
            self._evidence = 0.0
        if self._hops > 1:  # the first was chosen for its odds
            self._evidence += log_odds(probability) - self._needed
        # a human goes on speaking, be it after a pause; a robot that is softer does not
        if self._hops > self._anew > 0:
            self._evidence = max(self._evidence, 0.0)
            self._certain = self._evidence >= self._bound
            return self._certain or self._hops < self._anew + self._longest
        late = self._hops >= self._longest
        self._somebody |= self._evidence >= (0.0 if late else self._bound)
        # while the robot lowers its voice, only what follows tells whether it was the robot
        self._certain = self._somebody and (not self._asks or self._evidence >= self._sure)
        return self._somebody or (self._evidence > self._prior - self._bound and not late)


def human_probability(probability: float) -> float:
    """Calibrated probability that a human speaks in a hop, of that of the network's head, both 0 to 1.

    >>> [round(human_probability(said), 3) for said in (0.5, 0.97, 0.999)]
    [0.012, 0.493, 0.986]
    """
    return 1.0 / (1.0 + math.exp(SLOPE * (CENTRE - log_odds(probability))))


def log_odds(probability: float) -> float:
    """Logarithm of the odds of a probability, 0 to 1; at 0 and 1 those of 1e-9 and of 1 - 1e-9."""
    return math.log(max(probability, 1e-9) / max(1.0 - probability, 1e-9))
