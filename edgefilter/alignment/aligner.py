"""Streaming alignment of the reference to the microphone: each utterance's lag, the clocks' drift, dropped buffers."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from edgefilter.alignment.coarse_lag import CoarseLag
from edgefilter.alignment.delay_line import (
    HALF_WIDTH,
    WAIT,
    Aligned,
    DelayBuffer,
    kernel_table,
    read_delayed,
    read_line,
)
from edgefilter.alignment.delay_tracker import DRIFTED, FAINT, SIZE, STRIDE, DelayMeasurement, DelayMeter, DriftFilter
from edgefilter.alignment.lag_search import ALIKE, CERTAIN, MINIMUM, MOST_LAG_S, REFLECTIONS, Found, LagSearch
from edgefilter.alignment.utterances import AHEAD, Announcements, FirstSounds, OnsetDetector, Playback, Utterance
from edgefilter.profile.data import Profile
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, AlignmentCounts, AlignmentState, AlignmentStats, Samples

LIKELY_LAG_S = 2.0
"""Lag of the playback up to which an utterance is waited for: one that is heard later is rarer than a loudspeaker that is muted."""
LATE = SAMPLE_RATE // 10
"""Samples by which a reference may come after its echo and is still found, to be told of."""
SEARCH_STRIDE = 768
"""Samples between two searches of the whole range."""
COARSE_MARGIN = 400
"""Samples, 25 ms, by which the reference is read earlier than at a coarse lag, so that a canceller holds all that arrives, and
from which on a coarse lag is another one."""
THERE, UNSEEN, SUREST = 1.7, 0.5, 6.0
"""What a look that sees the robot where it is expected adds to the log odds of the delay, what one that does not takes off, and the most
that they become. In 40 measured rooms, beside humans and noise, looks at the right delay see it in 47 %, at a wrong one in 9 %."""
LOST_BLOCKS, NEARBY_SEARCHES = 3, 10
"""Measurements in speech without a credible peak after which all lags are searched again, so often as if the present delay
had ceased SIZE samples ago, which finds jumps of up to 200 ms, then as if the utterance had begun half a second before. A delay
that no measurement has ever seen is doubted once it is more likely wrong than right, from the beginning of the utterance on."""


class Aligner:
    """Finds the total delay of the robot's voice in the microphone and delivers the reference at that delay.

    A new utterance is looked for over all lags; the old delay holds until it is confirmed or replaced, but where the
    microphone is far too quiet for it, nothing is delivered. Between utterances delay and drift are carried on. hop:
    samples per step. profile: its impulse responses tell the shape of the arrival. max_lag_s: of the playback, seconds.
    Of a calibrated array all microphones are searched together, and the delay is measured in the first that is used.

    >>> rng = np.random.default_rng(0)
    >>> voice = rng.standard_normal(16384).astype(np.float32) / 10
    >>> mic = np.concatenate((np.zeros(2000, np.float32), voice[:-2000]))
    >>> aligner = Aligner(256)
    >>> for at in range(0, 16384, 256):
    ...     aligned = aligner.step(mic[at : at + 256], voice[at : at + 256])
    >>> aligned.state, round(aligned.delay)
    ('locked', 2000)
    """

    def __init__(self, hop: int, profile: Profile | None = None, max_lag_s: float = MOST_LAG_S) -> None:
        self.hop = hop
        self._max_lag = int((max_lag_s + 0.1) * SAMPLE_RATE)
        # samples from the beginning of an utterance until it is heard, most likely and at most
        self._likely, self._latest = (int((s + 0.35) * SAMPLE_RATE) for s in (min(max_lag_s, LIKELY_LAG_S), max_lag_s))
        self._calibrated = None if profile is None else list(profile.running_responses())
        self._first = FirstSounds(hop, self._calibrated[0]) if self._calibrated else None
        kernel_table()
        self.reset()

    def _listen_for(self, responses: Sequence[Samples] | None) -> None:
        """What an arrival looks like from now on: the microphones' impulse responses (taps,); None: anything."""
        self._responses = responses
        early = None if responses is None else [one[: PRE_ROLL + REFLECTIONS] for one in responses]
        self._lags = LagSearch(self._max_lag, early, LATE)
        self._meter = DelayMeter(None if responses is None else responses[self._used[0]])

    def reset(self) -> None:
        """Forget everything, as after construction."""
        self._used = [0]
        if self._first:
            self._first.reset()
        self._listen_for(self._calibrated)
        self._ref = DelayBuffer(self._lags.span + SAMPLE_RATE)
        self._mics = [DelayBuffer(self._ref.capacity)]
        self._onsets = OnsetDetector(self.hop)
        self._drift = DriftFilter()
        self._open: deque[Utterance] = deque(maxlen=32)
        self._announced = Announcements()
        self._expected: Playback | None = None
        self._found: Found | None = None
        self._read_at, self._wait = float("nan"), 0
        self._to_search, self._to_measure, self._stage, self._far = SEARCH_STRIDE, STRIDE // 2, 0, False
        self._gain: float | None = None
        self._by_bands = None if self._calibrated else CoarseLag(self.hop, self._max_lag)
        self._coarse = False  # whether a lag is followed at which nothing sharp arrives
        self._margin = PRE_ROLL
        self._known = self._refuted = self._trusted = self._measured = self._missed = False
        self._log_odds, self._lost = -SUREST, 0
        self._counts = AlignmentCounts(
            utterances=0, realignments=0, jumps=0, searches=0, announced=0, announced_heard=0
        )

    def hear_by(self, used: Sequence[int]) -> None:
        """Use these microphones of an array from now on; the delay stays, since their calibrated paths share one time origin."""
        self._mics += [DelayBuffer(self._ref.capacity) for _ in range(len(self._mics), max(used) + 1)]
        first, self._used = self._used[0], list(used)
        if self._responses is not None and self._used[0] != first:
            self._meter = DelayMeter(self._responses[self._used[0]])

    def announce(self, utterance: Samples) -> bool:
        """Say what will be played (n,); it may begin at any time or never, and several are played in the order of announcing.

        A sound in the reference channel is the reference, and drops announcements. While there is none, the announced
        utterance is looked for in the microphone for 30 s, and from where it is heard on it is the reference.
        False where too many wait already: then it is not announced.
        """
        kept = self._announced.add(utterance)
        self._counts["announced"] += kept
        return kept

    def step(self, mic: Samples, ref: Samples) -> Aligned:
        """Take the next hop (hop,) of microphone and reference, of an array (microphones, hop)."""
        ref = self._announced.reference(ref, self._ref.end)
        heard = np.atleast_2d(mic)
        for buffer, samples in zip(self._mics, heard, strict=True):
            buffer.push(samples)
        mic = heard[self._used[0]]
        self._ref.push(ref)
        started = self._onsets.step(ref)
        if started:
            self._open.append(started)
            self._counts["utterances"] += 1
            if self._expected is not None:
                self._stage, self._to_search, self._expected = 0, 0, None
        if self._open:
            self._expire()
        before = self._read_at
        self._measured = False
        switched = False
        if self._known or self._coarse:
            self._drift.advance(self.hop)
            switched = self._measure()
        if self._by_bands and not self._known:
            switched = self._look_coarsely(mic, ref, self._by_bands) or switched
        switched = self._search() or switched
        return self._deliver(mic, before, switched)

    def _look_coarsely(self, mic: Samples, ref: Samples, by_bands: CoarseLag) -> bool:
        """Find where the reference is to be read as long as nothing sharper is known; True if that is elsewhere than before."""
        by_bands.step(mic, ref)
        found = by_bands.find()
        if found is None or (self._coarse and abs(found - self._drift.delay) <= COARSE_MARGIN):
            return False
        self._coarse, self._margin = True, COARSE_MARGIN
        self._meter = DelayMeter()
        self._drift.restart(float(found), 3.0)
        return True

    def history(self, count: int) -> Samples:
        """The last count aligned samples (count,) float32, the present hop included, as if the present delay had always held."""
        if not (self._known or self._coarse) or self._refuted:
            return np.zeros(count, np.float32)
        return read_line(self._ref, self._ref.end, count, self._read_at, self._drift.slope, chunk=512)

    def stats(self) -> AlignmentStats:
        """Delay, drift, how sure both are, state and what happened so far, ready for JSON."""
        return {
            "method": "tracking",
            "state": self._state(),
            "delay_samples": round(self._drift.delay, 3) if self._known else None,
            "deviation_samples": round(self._drift.deviation, 3) if self._known else None,
            **self._counts,
            "ppm": round(-1e6 * self._drift.slope, 2),
            "probability": round(self._probability, 3),
            "confidence": round(self._probability, 3),
        }

    @property
    def _probability(self) -> float:
        """That the delay is right, 0 to 1."""
        return 1.0 / (1.0 + math.exp(-self._log_odds)) if self._known else 0.0

    def _state(self) -> AlignmentState:
        """What `Aligned` says of each."""
        if self._expected is not None:
            return "announced"
        if self._coarse:
            return "coarse" if self._audible() else "idle"
        begun = [utterance.start for utterance in self._open if not utterance.lost]
        if begun and (self._known or self._audible()):
            return "begun" if self._ref.end <= begun[-1] + self._likely else "unfound"
        if not self._audible():
            return "idle"
        if self._open and self._known:
            return "lost"
        return "unfound" if self._missed or not self._known else "locked"

    def _audible(self) -> bool:
        """Whether something of the reference can still be heard."""
        reach = self._max_lag if not self._known else int(self._drift.delay) + SAMPLE_RATE // 4
        return self._onsets.current.end + reach >= self._ref.end

    def _expire(self) -> None:
        """Give up utterances that would have been heard by now."""
        end = self._open[1].start if len(self._open) > 1 else self._onsets.current.end
        if self._ref.end > end + self._likely:
            self._missed = True
            if not self._known and self._responses is not None:  # it may stand elsewhere than where it was calibrated
                self._stage = 0
                self._listen_for(None)
        if self._ref.end > end + self._latest:
            self._resolve(found=False)
            self._missed = True

    def _resolve(self, found: bool = True) -> None:
        self._open.popleft()
        self._trusted = found
        self._stage = 0
        self._refuted = self._missed = False

    def _search(self) -> bool:
        """Look for the oldest unresolved utterance, or an announced one, a step each hop; True if the delay was switched."""
        self._to_search -= self.hop
        if self._measured or (self._stage == 0 and self._to_search > 0):
            return False
        now, stage, self._stage = self._ref.end, self._stage, 0
        if stage == 0:
            self._expected = None if self._open else self._announced.expected(now)
            too_soon = self._open and now + 2 * self.hop - self._open[0].start < MINIMUM and not self._open[0].nearby
            if too_soon or (not self._open and self._expected is None):
                return False
            self._to_search, self._stage = SEARCH_STRIDE, 1
            self._counts["searches"] += 1
            if self._open and self._open[0].nearby > 0:
                self._open[0].nearby -= 1
                before = SIZE if self._open[0].nearby else SAMPLE_RATE // 2
                self._open[0].start = now - int(self._drift.delay) - before
            since = self._expected.start if self._expected else self._open[0].start
            self._lags.prepare(self._expected or self._ref, now, since)
        elif stage == 1:
            self._stage = 2
            heard_out = self._open[0].after + int(self._drift.delay) if self._open and self._trusted else 0
            together = self._used if self._responses is not None else self._used[:1]
            self._lags.listen({at: self._mics[at] for at in together}, now, heard_out)
        elif stage == 2:
            found = self._lags.find()
            return found is not None and self._weigh(found, looked_back=False)
        elif found := self._found:
            first, ref = self._used[0], self._expected or self._ref
            return self._weigh(self._lags.before(first, self._mics[first], ref, found), looked_back=True)
        return False

    def _weigh(self, found: Found, looked_back: bool) -> bool:
        """Believe a lag, give it up, or look back at what was heard before, if anything was; True if the delay was switched.

        A sequential test (Wald 1945): each window that is looked back at changes the odds, until they are certain or too low.
        """
        # a reference that comes after its echo is rare: two windows must show it
        alone = found.lag >= -WAIT and not found.old
        if found.odds > CERTAIN and (looked_back or alone):
            return self._take(found)
        alike = self._responses is not None or self._known or self._coarse
        least = CERTAIN * ALIKE if alike else 1.0 / CERTAIN
        if found.old and found.odds > least and not (alike and looked_back):
            self._found, self._stage = found, 3
        return False

    def _take(self, found: Found) -> bool:
        """Accept this lag as the robot's; return whether the delay of the reference has changed."""
        self._log_odds = min(math.log(found.odds), SUREST)
        if self._expected is not None:
            return self._begin(self._expected.start + found.lag)
        was_refuted = self._refuted
        self._resolve()
        if self._known and abs(found.lag - self._drift.delay) < 24:
            return was_refuted
        return self._switch(float(found.lag), 3.0)

    def _begin(self, heard_at: int) -> bool:
        """What was announced is heard since heard_at: from now on it is the reference."""
        playback, now = self._announced.begin(heard_at), self._ref.end
        self._counts["announced_heard"] += 1
        self._ref.rewrite(playback.start, playback.read(playback.start, now))
        self._onsets.current = Utterance(playback.start, now)
        return self._switch(float(AHEAD), 3.0)

    def _switch(self, delay: float, deviation: float) -> bool:
        if self._coarse and not math.isnan(self._read_at):  # the canceller has learned what arrives behind that lag
            self._margin = max(round(delay - self._read_at), PRE_ROLL)
            self._meter = DelayMeter()  # the other has learned what arrives around the coarse lag
            self._gain = None
        self._drift.restart(delay, deviation)
        return self._switched()

    def _switched(self) -> bool:
        self._known, self._coarse = True, False
        self._counts["realignments"] += 1
        self._lost, self._refuted, self._missed = 0, False, False
        self._to_measure = min(self._to_measure, 2 * self.hop)
        return True

    def _measure(self) -> bool:
        """Now and then measure the error of the present delay; True if it jumped."""
        self._to_measure -= self.hop
        self._measured = self._to_measure <= 0
        if not self._measured:
            self._meter.learn()
            return False
        self._to_measure = STRIDE
        if self._ref.end - self._drift.delay - STRIDE > self._onsets.current.end:
            return False
        self._far = bool(self._lost or (self._open and self._open[0].nearby))
        mic, drift = self._mics[self._used[0]], self._drift
        found = self._meter.measure(mic, self._ref, self._ref.end, drift.delay, drift.slope, self._far)
        return found is not None and self._take_look(found)

    def _take_look(self, found: DelayMeasurement) -> bool:
        """Take a look into account; True if the delay was switched."""
        seen = self._drift.where_seen(found, found.gain if self._gain is None else self._gain, self._far)
        if seen == "there":
            return self._accept(found)
        if seen == "drowned":
            return False
        if self._coarse:  # without an arrival there is nothing to see until what is heard around this delay is learned
            self._meter.confirm(0.0)
            return False
        if seen == "jumped":
            return self._accept(found) if abs(found.offset) < DRIFTED else self._jump(found.offset)
        if seen == "elsewhere":
            self._to_measure = STRIDE // 2
        self._note_loss(found)
        return False

    def _jump(self, offset: float) -> bool:
        """Follow a jump of the delay by `offset` samples; True, as the delay was switched."""
        self._counts["jumps"] += 1
        self._log_odds = math.log(CERTAIN)
        if self._open and self._ref.end - self._drift.delay > self._open[0].start + STRIDE:
            self._resolve()
        self._drift.step(offset, 0.3)
        return self._switched()

    def _accept(self, found: DelayMeasurement) -> bool:
        step = self._drift.delay
        self._drift.correct(found)
        self._meter.confirm(found.offset)
        self._lost, self._missed = 0, False
        self._log_odds = min(self._log_odds + THERE, SUREST)
        before = found.gain if self._gain is None else self._gain
        self._gain = before + 0.1 * (min(found.gain, 2 * before) - before)
        was_refuted = self._refuted
        heard_out = self._open and self._ref.end - self._drift.delay > self._open[0].start + STRIDE
        if self._known and heard_out and found.dominance < 1.01:
            self._resolve()
        return was_refuted or abs(self._drift.delay - step) > 0.5

    def _note_loss(self, found: DelayMeasurement) -> None:
        """Speech of the robot should be heard but is not where it was expected: in the end, search everything."""
        if self._open or (self._gain is not None and found.gain < FAINT * self._gain):
            return
        self._lost += 1
        self._to_measure = STRIDE // 2
        self._log_odds = max(self._log_odds - UNSEEN, -SUREST)
        if (
            self._gain is None and self._log_odds < 0.0
        ):  # no look has ever seen it: it may have been wrong from the start
            self._trusted = False
            self._open.append(Utterance(self._onsets.current.start, self._onsets.current.end, lost=True))
        elif self._gain is not None and self._lost >= LOST_BLOCKS:
            self._lost = 0
            self._trusted = False
            self._open.append(Utterance(self._ref.end, self._ref.end, nearby=NEARBY_SEARCHES, lost=True))

    def _deliver(self, mic: Samples, before: float, switched: bool) -> Aligned:
        state = self._state()
        if not (self._known or self._coarse):
            nothing = self.history(self.hop)
            anywhere = self._at_any_lag(mic, nothing, state)
            return Aligned(nothing, float("nan"), 0.0, 0.0, state, switched, anywhere, self._wait)
        if not HALF_WIDTH // 2 < self._drift.delay + self._wait < PRE_ROLL:
            self._wait = min(max(HALF_WIDTH - round(self._drift.delay), 0), WAIT)
        self._read_at = max(self._drift.delay + self._wait - self._margin, 0.0)
        end = self._ref.end
        start = self._read_at - self._drift.slope * self.hop if switched else before
        if self._read_at < HALF_WIDTH:
            start = self._read_at = float(round(self._read_at))
        if abs(start - self._read_at) > 0.5:
            start, switched = self._read_at - self._drift.slope * self.hop, True
        reference = read_delayed(self._ref, end, self.hop, start, self._read_at)
        # one that is lost may only have moved away, and be softer there
        begun = self._known and self._open and not self._open[0].lost
        if begun and not self._refuted and end - self._drift.delay > self._open[0].start:
            self._refuted = self._cannot_be(mic)
        if self._refuted:
            reference = np.zeros(self.hop, np.float32)
        ppm = -1e6 * self._drift.slope
        anywhere = self._at_any_lag(mic, reference, state)
        return Aligned(reference, self._drift.delay, ppm, self._probability, state, switched, anywhere, self._wait)

    def _at_any_lag(self, mic: Samples, reference: Samples, state: AlignmentState) -> bool:
        """What `Aligned` says of it, for a hop of the microphone and the reference at the delay of before.

        Never after an utterance that failed to arrive: the loudspeaker may be muted, or be headphones.
        """
        waits = False
        if self._open and not self._missed and self._ref.end <= self._open[0].start + self._likely:
            waits = self._refuted or not (self._coarse or self._open[0].lost)
        if self._first is None:
            return waits and self._onsets.varies and (self._refuted or not self._known)
        waits = waits or self._expected is not None
        return self._first.step(mic, reference, self._onsets.peak, state, waits)

    def _cannot_be(self, mic: Samples) -> bool:
        """Whether the microphone holds 10 dB less than the reference at the old delay would bring there."""
        if self._gain is None:
            return False
        stop = self._ref.end - round(self._drift.delay)
        brought = self._ref.read(stop - self.hop, stop)
        return float(np.dot(mic, mic)) < 0.1 * self._gain * float(np.dot(brought, brought))
