"""Streaming alignment of the reference to the microphone: each utterance's lag, the clocks' drift, dropped buffers."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from edgefilter.alignment.belief import LOOK, REACH, Belief, believed
from edgefilter.alignment.coarse_lag import CoarseLag
from edgefilter.alignment.delay_line import HALF_WIDTH, WAIT, DelayBuffer, kernel_table, read_delayed, read_line
from edgefilter.alignment.delay_tracker import DRIFTED, FAINT, SIZE, STRIDE, DelayMeasurement, DelayMeter, DriftFilter
from edgefilter.alignment.lag_search import ALIKE, CERTAIN, EVEN, MINIMUM, MOST_LAG_S, SAME, WINDOW, Found, LagSearch
from edgefilter.alignment.utterances import AHEAD, Announcements, FirstSounds, OnsetDetector, Playback, Utterance
from edgefilter.profile.data import Profile
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, AlignmentCounts, AlignmentState, AlignmentStats, Samples

UNLOCATED: tuple[AlignmentState, ...] = ("begun", "announced")
"""States of the alignment in which the reference may lie elsewhere than the microphone hears it."""
LIKELY_LAG_S = 2.0
"""Longest lag, seconds, for which an utterance is waited for: where it is not heard by then, it is likelier that the loudspeaker is muted."""
LATE = SAMPLE_RATE // 10
"""Samples by which a reference may come after its echo and is still found for an utterance; with LATEST they are found .15 s later."""
LATEST, FURTHEST = 2 * SAMPLE_RATE, 5 * SAMPLE_RATE
"""Range of a look, which is a search for the lag that needs no beginning of an utterance: by how many samples the reference may come
after its echo, and the longest lag. A lag beyond MOST_LAG_S is reported to the user, and its echo is not cancelled."""
LOOKS, FIRST_LOOK = 12, SAMPLE_RATE // 2
"""Looks that are remembered, and samples of an utterance after which there is one; each LOOK another, and one more at each realignment.
Speech that begins while the reference is silent waits for as long until it is nobody's but a human's: the reference may follow."""
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


class Past(NamedTuple):
    """The last seconds of microphone and reference, and the utterances in the reference."""

    mic: DelayBuffer
    ref: DelayBuffer
    onsets: OnsetDetector


class Aligned(NamedTuple):
    """The reference as an aligner delivers it for one hop of the microphone.

    reference: (hop,) float32, delayed so that the robot's direct sound lies PRE_ROLL samples behind it; zeros while no
    delay is known. delay: samples, of the direct sound at the end of the hop, nan if unknown. ppm: by how much the delay shrinks,
    1e-6 samples per sample. confidence: probability that the delay is right, 0 to 1. realigned: the delay was switched
    discontinuously in this hop. state: of the utterance that may be heard now. "idle": nothing of the reference can be
    audible. "announced": it is waited for, and may begin at any time or never. "begun": it has begun and is not found yet;
    delay is that of the utterance before, or nan. "unfound": as "begun", but it should have been heard by now, whatever its lag.
    "coarse": no sharp arrival was found yet, the delay is known to within 25 ms; the reference is read 25 ms early. "lost":
    it was found, but the latest searches missed it, since a human is loud or the lag jumped; delay is extrapolated with its
    drift. "locked": its delay is followed. at_any_lag: what is heard may be an utterance at an unknown lag: it was not found so
    far, and no delay is known, or that of the utterance before was refuted; or FirstSounds finds it too loud to be anybody but
    the robot. wait: samples by which the microphone must be delayed because the echo comes too early for the reference, WAIT
    at most. past: the last seconds of both channels. belief: probabilities of the lags after the latest searches, in a hop in
    which one of them has ended; else None.
    """

    reference: Samples
    delay: float
    ppm: float
    confidence: float
    state: AlignmentState
    realigned: bool
    at_any_lag: bool = False
    wait: int = 0
    past: Past = Past(DelayBuffer(WAIT), DelayBuffer(WAIT), OnsetDetector(WAIT))
    belief: Belief | None = None


class Aligner:
    """Finds the total delay of the robot's voice in the microphone and delivers the reference at that delay.

    A new utterance is looked for over all lags; the old delay holds until it is confirmed or replaced, but where the
    microphone is far too quiet for it, nothing is delivered. Between utterances delay and drift are carried on. hop:
    samples per step. profile: its impulse responses tell the shape of the arrival.
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

    def __init__(self, hop: int, profile: Profile | None = None) -> None:
        self.hop = hop
        # samples from the beginning of an utterance until it is heard, most likely and at most
        self._likely, self._latest = (int((s + 0.35) * SAMPLE_RATE) for s in (LIKELY_LAG_S, MOST_LAG_S))
        self._calibrated = None if profile is None else list(profile.running_responses())
        self._first = FirstSounds(hop, self._calibrated[0] if self._calibrated else None)
        kernel_table()
        self._used = [0]
        self._listen_for(self._calibrated)
        self._ref = DelayBuffer(self._lags.span + SAMPLE_RATE)
        self._mics = [DelayBuffer(self._ref.capacity)]
        self._onsets = OnsetDetector(hop)
        self._drift = DriftFilter()
        self._open: deque[Utterance] = deque(maxlen=32)
        self._announced = Announcements()
        self._expected: Playback | None = None
        self._steps: Iterator[bool] = iter(())  # of the search that is under way
        self._looks: deque[Found] = deque(maxlen=LOOKS)
        self._seen: Found | None = None  # by a look that is no part of the belief yet
        self._next_look = self._looked = 0
        self._belief = believed(self._looks)
        self._read_at, self._wait = float("nan"), 0
        self._to_search, self._to_measure = SEARCH_STRIDE, STRIDE // 2
        self._gain: float | None = None
        self._by_bands = None if self._calibrated else CoarseLag(hop, REACH)
        self._margin = PRE_ROLL
        self._log_odds = 0.0  # of the delay; below 0 also where none is known and an utterance was not heard
        self._lost = 0  # measurements in a row that have not seen the robot
        self._counts = AlignmentCounts(
            utterances=0, realignments=0, jumps=0, searches=0, announced=0, announced_heard=0
        )

    def _listen_for(self, responses: Sequence[Samples] | None) -> None:
        """What an arrival looks like from now on: the microphones' impulse responses (taps,); None: anything."""
        self._responses = responses
        self._lags = LagSearch(REACH, responses or (), LATE, (FURTHEST, LATEST, LATEST + LOOK))
        self._meter = self._new_meter()

    def _new_meter(self) -> DelayMeter:
        return DelayMeter(None if self._responses is None else self._responses[self._used[0]])

    def hear_by(self, used: Sequence[int]) -> None:
        """Use these microphones of an array from now on; the delay stays, since their calibrated paths share one time origin."""
        self._mics += [DelayBuffer(self._ref.capacity) for _ in range(len(self._mics), max(used) + 1)]
        first, self._used = self._used[0], list(used)
        if self._responses is not None and self._used[0] != first:
            self._meter = self._new_meter()

    def announce(self, utterance: Samples) -> bool:
        """Say what will be played (n,), at any time or never: `Announcements`. False where too many wait already: then it is not announced."""
        kept = self._announced.add(utterance)
        self._counts["announced"] += kept
        return kept

    def step(self, mic: Samples, ref: Samples) -> Aligned:
        """Align the next hop: ref (hop,) with mic (hop,), or (microphones, hop) of an array."""
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
            self._next_look = self._ref.end + FIRST_LOOK
            if self._expected is not None:
                self._steps, self._to_search, self._expected = iter(()), 0, None
        if self._open:
            self._expire()
        before, jumped = self._read_at, None
        if self._located:
            self._drift.advance(self.hop)
            jumped = self._measure()
        moved = self._by_bands and not self._known and self._look_coarsely(mic, ref, self._by_bands)
        self._to_search -= self.hop
        found = jumped is None and self._search()  # both cost too much for one hop
        aligned = self._deliver(mic, before, bool(jumped or moved or found))
        past = Past(self._mics[self._used[0]], self._ref, self._onsets)
        return aligned._replace(past=past, belief=self._believe(aligned))

    def _believe(self, aligned: Aligned) -> Belief | None:
        """Probabilities of the lags after one more search, or after a second of following a lag; None in other hops."""
        seen, self._seen, now = self._seen, None, self._ref.end
        if self._follows(aligned.state):
            if not aligned.realigned and now < self._next_look:
                return None
            seen, self._next_look = Found.followed(round(aligned.delay), aligned.confidence, now), now + LOOK
        if seen is None:
            return None
        self._looks.append(seen)
        lags = np.array([look.lag for look in self._looks])
        alike = np.count_nonzero(np.abs(lags - lags[:, None]) <= SAME, axis=0) > 1
        # where a robot says something again, so does chance: what is more likely wrong than right is not believed if it agrees
        doubted = [look if look.clearness > EVEN else replace(look, clearness=0.0) for look in self._looks]
        # but speaks for the robot, of a path with several arrivals alike say, against its not being heard at all
        there = [look if agrees else unsure for look, unsure, agrees in zip(self._looks, doubted, alike, strict=True)]
        self._belief = replace(believed(doubted), evidence=believed(there).evidence)
        return self._belief

    def _follows(self, state: AlignmentState) -> bool:
        """Whether the lag that is followed counts as the result of a search: not if the robot was heard at one that is not when it was found."""
        return state in ("locked", "coarse") and not self._displaced

    @property
    def _displaced(self) -> bool:
        """Whether the robot is rather heard at a lag that is not followed."""
        return bool((self._belief.late[-1:] + self._belief.beyond[-1:] > 0.5).any())

    def _certain(self, found: Found) -> bool:
        """Whether the lag of a search is accepted; while the robot is rather heard at a lag that is not followed, it needs the square of the odds."""
        return self._odds(found) > CERTAIN * (CERTAIN if self._displaced else 1.0)

    def _odds(self, found: Found) -> float:
        """The odds of a lag that a search found, lower for an utterance that seems to begin at another lag: robots repeat earlier utterances."""
        if not self._open or self._open[0].lost or not abs(found.lag - self._drift.delay) > SAME:
            return found.odds
        followed = (look for look in self._looks if not look.heard and look.odds > CERTAIN)
        now = [round(look.lag + self._drift.slope * (found.at - look.at)) for look in followed]
        return found.odds / (ALIKE if any(abs(lag - found.lag) <= SAME for lag in now) else 1.0)

    @property
    def _known(self) -> bool:
        """Whether the lag that is followed is that of a sharp arrival."""
        return self._drift.shared == 0.0

    @property
    def _located(self) -> bool:
        """Whether a lag is followed, sharp or coarse."""
        return self._drift.shared < math.inf

    @property
    def _coarse(self) -> bool:
        return self._located and not self._known

    @property
    def _refuted(self) -> bool:
        """Whether the oldest utterance that is looked for does not come at the lag that is followed."""
        return bool(self._open) and self._open[0].refuted

    def _look_coarsely(self, mic: Samples, ref: Samples, by_bands: CoarseLag) -> bool:
        """Find where the reference is to be read as long as nothing sharper is known; True if that is elsewhere than before."""
        by_bands.step(mic, ref)
        found = by_bands.find()
        if found is None:
            return False
        moved = not self._coarse or abs(found[0] - self._drift.delay) > COARSE_MARGIN
        if moved:
            self._meter, self._margin = DelayMeter(), COARSE_MARGIN
            self._drift.restart(float(found[0]))
        self._drift.shared = found[1]
        return moved

    def history(self, count: int) -> Samples:
        """The last count aligned samples (count,) float32, the present hop included, as if the present delay had always held."""
        if not self._located or self._refuted:
            return np.zeros(count, np.float32)
        return read_line(self._ref, self._ref.end, count, self._read_at, self._drift.slope, chunk=512)

    def stats(self) -> AlignmentStats:
        """Delay, drift, how sure both are, state and what happened so far, ready for JSON."""
        return {
            "method": "tracking",
            "state": self._state(),
            "delay_samples": round(self._drift.delay, 3) if self._located else None,
            "deviation_samples": round(self._drift.deviation, 3) if self._located else None,
            **self._counts,
            "ppm": round(-1e6 * self._drift.slope, 2),
            "probability": round(self._probability, 3),
            "confidence": round(self._probability, 3),
        }

    @property
    def _probability(self) -> float:
        """That the delay is right, 0 to 1; of a coarse one as much as of a lag that a search is just certain of."""
        if self._coarse:
            return CERTAIN / (CERTAIN + 1.0)
        return 1.0 / (1.0 + math.exp(-self._log_odds)) if self._known else 0.0

    def _state(self) -> AlignmentState:
        """The present state, one of those that `Aligned` describes."""
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
        return "locked" if self._known and self._log_odds >= 0.0 else "unfound"

    def _audible(self) -> bool:
        """Whether the microphone may still hear some of the reference, which takes the lag and its reverberation to fade."""
        reach = REACH if not self._known else max(int(self._drift.delay), 0) + SAMPLE_RATE // 4
        return self._onsets.current.end + reach >= self._ref.end

    def _expire(self) -> None:
        """Give up utterances that would have been heard by now."""
        end = self._open[1].start if len(self._open) > 1 else self._onsets.current.end
        if self._ref.end > end + self._likely:
            self._log_odds = min(self._log_odds, -UNSEEN)
            if not self._known and self._responses is not None:  # it may stand elsewhere than where it was calibrated
                self._steps = iter(())
                self._listen_for(None)
        if self._ref.end > end + self._latest:
            self._resolve()

    def _resolve(self) -> None:
        self._open.popleft()
        self._steps = iter(())

    def _search(self) -> bool:
        """A step of a search over all lags each hop, to be looked at by itself or for an utterance; True if the delay was switched."""
        switched = next(self._steps, None)
        if switched is None:
            now = self._ref.end
            heard = now - self._onsets.current.end <= FURTHEST  # as long as it may be, however late
            due = heard and now >= self._next_look and not self._follows(self._state())
            if due:
                self._next_look += LOOK
            elif self._to_search > 0:
                return False
            self._steps = self._look_anywhere() if due else self._look_for_utterance()
            switched = next(self._steps, None)
        return bool(switched)

    def _look_anywhere(self) -> Iterator[bool]:
        """Search the latest sound over the full range of lags, without a prior; each step yields whether the delay was switched."""
        sounds = self._ref.end - self._onsets.current.end <= SEARCH_STRIDE
        self._lags.prepare(self._ref, self._ref.end)
        yield False
        self._lags.listen({0: self._mics[self._used[0]]}, self._ref.end, self._looked)
        yield False
        # in a silent microphone the robot is not heard: a search without a result
        found = self._lags.find() or Found(0, 0.0, self._ref.end)
        # where nothing sounds any more, others do: that it is not found says nothing then
        if sounds or found.clearness > EVEN:
            self._seen = found
        # so that the next search uses sound that this one has not used
        self._looked = self._ref.end + min(found.lag, 0)
        sure = -WAIT <= found.lag <= REACH and self._certain(found)
        yield sure and bool(self._open) and not self._known and self._take(found)

    def _look_for_utterance(self) -> Iterator[bool]:
        """Search for the oldest utterance whose lag is unknown, or for an announced one; each step yields whether the delay was switched.

        A sequential test (Wald 1945): each earlier window of the microphone changes the odds, until the lag is accepted or rejected.
        """
        now = self._ref.end
        self._expected = None if self._open else self._announced.expected(now)
        too_soon = self._open and now + 2 * self.hop - self._open[0].start < MINIMUM and not self._open[0].nearby
        if too_soon or (not self._open and self._expected is None):
            return
        self._to_search = SEARCH_STRIDE
        self._counts["searches"] += 1
        if self._open and self._open[0].nearby > 0:
            self._open[0].nearby -= 1
            before = SIZE if self._open[0].nearby else SAMPLE_RATE // 2
            self._open[0].start = now - int(self._drift.delay) - before
        ref = self._expected or self._ref
        self._lags.prepare(ref, now, self._expected.start if self._expected else self._open[0].start)
        yield False
        sure = self._known and self._log_odds > 0.0
        before = self._open[0].after + int(self._drift.delay) if self._open and sure else 0
        together = self._used if self._responses is not None else self._used[:1]
        self._lags.listen({at: self._mics[at] for at in together}, self._ref.end, before)
        yield False
        found, looked_back = self._lags.find(), False
        while found is not None:
            # a reference that comes after its echo is rare: two windows must show it
            if self._certain(found) and (looked_back or (found.lag >= -WAIT and not found.old)):
                yield self._take(found)
                return
            yield False
            # where the reference lacks samples, earlier windows had other lags
            alike = self._responses is not None or self._coarse or self._belief.lossy > 1.0
            if not found.old or found.odds <= (CERTAIN * ALIKE if alike else 1.0 / CERTAIN) or (alike and looked_back):
                return
            first, looked_back = self._used[0], True
            found = self._lags.before(first, self._mics[first], ref, found)
        yield False

    def _take(self, found: Found) -> bool:
        """Accept this lag as the robot's; return whether the delay of the reference has changed."""
        self._log_odds = min(math.log(self._odds(found)), SUREST)
        if self._expected is not None:  # heard: from now on it is the reference
            playback, now = self._announced.begin(self._expected.start + found.lag), self._ref.end
            self._counts["announced_heard"] += 1
            self._ref.rewrite(playback.start, playback.read(playback.start, now))
            self._onsets.current = Utterance(playback.start, now)
            return self._switch(float(AHEAD))
        was_refuted = self._refuted
        self._resolve()
        if not self._known or abs(found.lag - self._drift.delay) > SAME:
            return self._switch(float(found.lag))
        if self._gain is None:
            # searches agree on the lag, but no measurement finds a peak: the arrival is spread over time, so its shape is learned
            self._meter = self._new_meter()
            drift, now = self._drift, self._ref.end
            self._meter.study(self._mics[self._used[0]], self._ref, now - WINDOW, now, drift.delay, drift.slope)
        return was_refuted

    def _switch(self, delay: float) -> bool:
        if self._coarse and not math.isnan(self._read_at):  # the canceller has learned what arrives behind that lag
            self._margin = max(round(delay - self._read_at), PRE_ROLL)
            self._meter = DelayMeter()  # the other has learned what arrives around the coarse lag
            self._gain = None
        self._drift.restart(delay)
        return self._switched()

    def _switched(self) -> bool:
        self._counts["realignments"] += 1
        self._lost = 0
        self._to_measure = min(self._to_measure, 2 * self.hop)
        return True

    def _measure(self) -> bool | None:
        """Now and then measure the error of the present delay; True if it jumped, None in other hops."""
        self._to_measure -= self.hop
        if self._to_measure > 0:
            self._meter.learn()
            return None
        self._to_measure = STRIDE
        if self._ref.end - self._drift.delay - STRIDE > self._onsets.current.end:
            return False
        far = bool(self._lost or (self._open and self._open[0].nearby))
        mic, drift = self._mics[self._used[0]], self._drift
        found = self._meter.measure(mic, self._ref, self._ref.end, drift.delay, drift.slope, far)
        seen = found and drift.where_seen(found, found.gain if self._gain is None else self._gain, far)
        if found is None or seen == "drowned":
            return False
        if seen == "there":
            return self._accept(found)
        if self._coarse:  # without an arrival there is nothing to see until what is heard around this delay is learned
            self._meter.confirm(0.0)
            return False
        if seen == "jumped":
            if abs(found.offset) < DRIFTED:
                return self._accept(found)
            self._counts["jumps"] += 1
            self._log_odds = math.log(CERTAIN)
            if self._open and self._ref.end - drift.delay > self._open[0].start + STRIDE:
                self._resolve()
            drift.step(found)
            return self._switched()
        if seen == "elsewhere":
            self._to_measure = STRIDE // 2
        self._note_loss(found)
        return False

    def _accept(self, found: DelayMeasurement) -> bool:
        step = self._drift.delay
        self._drift.correct(found)
        self._meter.confirm(found.offset)
        self._lost = 0
        self._log_odds = min(max(self._log_odds, 0.0) + THERE, SUREST)
        before = found.gain if self._gain is None else self._gain
        self._gain = before + 0.1 * (min(found.gain, 2 * before) - before)
        was_refuted = self._refuted
        heard_out = self._open and self._ref.end - self._drift.delay > self._open[0].start + STRIDE
        if self._known and heard_out:
            self._resolve()
        return was_refuted or abs(self._drift.delay - step) > 0.5

    def _note_loss(self, found: DelayMeasurement) -> None:
        """Speech of the robot should be heard but is not where it was expected: in the end, search everything."""
        if self._open or (self._gain is not None and found.gain < FAINT * self._gain):
            return
        self._lost += 1
        self._to_measure = STRIDE // 2
        self._log_odds = max(self._log_odds - UNSEEN, -SUREST)
        if self._gain is not None and self._lost >= LOST_BLOCKS:
            self._lost = 0
            self._open.append(Utterance(self._ref.end, self._ref.end, nearby=NEARBY_SEARCHES, lost=True))
        elif self._gain is None and self._log_odds < 0.0:  # no measurement ever confirmed this lag
            self._open.append(Utterance(self._onsets.current.start, self._onsets.current.end, lost=True))

    def _deliver(self, mic: Samples, before: float, switched: bool) -> Aligned:
        state, end, delay, slope = self._state(), self._ref.end, self._drift.delay, self._drift.slope
        reference = np.zeros(self.hop, np.float32)
        if self._located:
            if not HALF_WIDTH // 2 < delay + self._wait < PRE_ROLL:
                self._wait = min(max(HALF_WIDTH - round(delay), 0), WAIT)
            self._read_at = max(delay + self._wait - self._margin, 0.0)
            start = self._read_at - slope * self.hop if switched else before
            if self._read_at < HALF_WIDTH:
                start = self._read_at = float(round(self._read_at))
            if abs(start - self._read_at) > 0.5:
                start, switched = self._read_at - slope * self.hop, True
            # a lost utterance may only have become softer, as the robot moves; where samples are missing (`belief.lost`) it has begun at a longer lag
            begun = self._known and self._open and (not self._open[0].lost or self._belief.lost)
            if begun and self._gain is not None and end - delay > self._open[0].start:
                brought = self._ref.read(end - round(delay) - self.hop, end - round(delay))
                heard = float(np.dot(mic, mic))  # is that 10 dB below the echo of the reference at that delay?
                self._open[0].refuted |= heard < 0.1 * self._gain * float(np.dot(brought, brought))
            if not self._refuted:
                reference = read_delayed(self._ref, end, self.hop, start, self._read_at)
        anywhere = self._at_any_lag(mic, reference, state)
        return Aligned(reference, delay, -1e6 * slope, self._probability, state, switched, anywhere, self._wait)

    def _at_any_lag(self, mic: Samples, reference: Samples, state: AlignmentState) -> bool:
        """What `Aligned` says of it, for a hop of the microphone and the reference at the delay of before.

        Never after an utterance that failed to arrive: the loudspeaker may be muted, or be headphones.
        """
        waits = False
        if self._open and self._log_odds >= 0.0 and self._ref.end <= self._open[0].start + self._likely:
            waits = self._refuted or not (self._coarse or self._open[0].lost)
        unknown = self._calibrated is None and (self._refuted or not self._known)
        expected = waits or self._expected is not None
        loud = self._first.step(mic, reference, self._onsets.peak, state, expected)
        return loud or (waits and unknown and self._onsets.varies)
