"""What to play where several explanations of a recording remain, and which of them holds once that was heard."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations

import numpy as np
from scipy.special import log_ndtr

from edgefilter.calibration.multisine import BAND_HZ, SPEECH_DB
from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.diagnose import holds
from edgefilter.diagnosis.joint import fit_jointly
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.straightened import HOP, STEP, Score, Straightened, bands
from edgefilter.diagnosis.trials import Found
from edgefilter.dsp.convolution import convolve
from edgefilter.dsp.fractional_delay import delayed
from edgefilter.dsp.frames import decibels
from edgefilter.dsp.psd import GRID_BINS, coloured, frequencies
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.effects.gain_fit import loudest
from edgefilter.echo.measurement import Measurement
from edgefilter.echo.model import EchoModel
from edgefilter.errors import SignalError, UsageError
from edgefilter.profile.data import Profile
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

ENOUGH = 20.0
"""Odds at which a question is settled: the 5 % that a test is usually allowed."""
SOUND_S = 2.5
"""Seconds of one sound: two are what a robot plays without anybody asking why."""
MARK_S, GAP_S, END_S = 0.25, 0.15, 0.1
"""Each begins with a noise, by which its lag is found where it is silent itself, and a gap, and ends in silence, so that
its reverberation is evaluated as well."""
LINES = 150
"""Tones of one sound, drawn from the odd frequency bins, so that most products of two or three tones fall on bins without one."""
ERROR_TAPS = 64
"""Of the filter that gives a simulated explanation's error its spectrum; it keeps its sign for a HOP (16 ms)."""
LOOSE = 0.25
"""Part of how far two explanations expect to be apart by which either may be off. Right ones of 16 simulated robots
(bench/diagnosis/probe.py, voices of training) were off by a tenth to a half."""
NONE = 100.0
"""Times the variance that the best explanation expects: with so much more nothing is known. By the likelihood that is
nearer from ten times the expected power on. Chosen by hand, not tuned."""
TWINS = 1e-5
"""Least difference of two explanations, as a share of the voice's power (-50 dB): the fan hides less."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """Effects beyond the profile's, and the model with them.

    error (601,): part of the voice's power, 0 to 8 kHz, that the model leaves over what it expects of seconds that it
    was not fitted to: so far it may be off elsewhere.
    """

    effects: tuple[str, ...]
    model: EchoModel
    error: Array

    @property
    def name(self) -> str:
        """In one word."""
        return "+".join(self.effects)


@dataclass(frozen=True, eq=False)
class Sound:
    """One sound of the menu, in words and samples (n,), and what it is expected to tell (Inquiry.sounds)."""

    words: str
    samples: Samples
    expected: float


@dataclass(frozen=True, eq=False)
class Answer:
    """Explanations and their probabilities after those sounds, likely: (explanations + 1,), the last of none of them.

    holds: whether the first is what happened, and all that did, as a diagnosis judges it, of the recording and what was
    heard of the sounds as one. left_db: excess that it leaves in the worst of them; in_answer: whether that is a sound's.
    """

    explanations: tuple[Explanation, ...]
    likely: Array
    sounds: tuple[str, ...]
    holds: bool
    left_db: float
    in_answer: bool

    @property
    def first(self) -> Explanation:
        """The most probable one, none of them left aside."""
        return self.explanations[int(np.argmax(self.likely[:-1]))]

    @property
    def odds(self) -> float:
        """Of that against all else; at most a million."""
        most = float(np.max(self.likely[:-1]))
        return most / max(1.0 - most, 1e-6)

    @property
    def ranked(self) -> list[tuple[Explanation, float]]:
        """Each explanation with its probability, the most probable first."""
        pairs = zip(self.explanations, self.likely[:-1].tolist(), strict=True)
        return sorted(pairs, key=lambda pair: -pair[1])

    @property
    def settled(self) -> bool:
        """Whether these are enough to name it: what is nearer need not hold."""
        return self.holds and self.odds >= ENOUGH

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        return {
            "settled": self.settled,
            "odds": round(self.odds, 1),
            "holds": self.holds,
            "left_db": round(self.left_db, 2),
            "explanations": [{"effects": one.effects, "weight": round(weight, 6)} for one, weight in self.ranked],
            "none": round(float(self.likely[-1]), 6),
            "sounds": self.sounds,
        }


@dataclass(frozen=True, eq=False)
class Heard:
    """What was recorded of a sound: one half of it to fit to and the other to test on, then the other way round.

    Each with the explanations as fitted to the first recording and to that half.
    """

    halves: tuple[tuple[Straightened, list[Explanation]], ...]

    @cached_property
    def evidence(self) -> Array:
        """Log likelihood of what was tested on, (moments, explanations + 1), the last of none."""
        return np.concatenate([_log_likelihood(*half) for half in self.halves])


class Inquiry:
    """A prepared recording of a reference (n,) and its explanations, each fitted to one half of it: what can be asked.

    wanted: the effects of each explanation; two that predict the same are one. Raises SignalError where a fit fails,
    UsageError for an event.
    """

    def __init__(
        self, profile: Profile, prepared: Straightened, wanted: Sequence[tuple[str, ...]], reference: Samples
    ) -> None:
        for name in (name for effects in wanted for name in effects if find(name).event):
            raise UsageError(f"{name} belongs to one recording, and no other can tell of it: ask without it")
        self.profile, self.reference, self._first = profile, reference, prepared
        measurement = self._first.measurement
        kept: list[Explanation] = []
        voices: list[Samples] = []
        for effects in wanted:
            model = _fitted(measurement, self._first.model, effects)
            power, expected, voice = _cells(self._first, model)
            over = np.maximum(np.sum(power - expected, axis=0), 0.0) / np.maximum(np.sum(voice, axis=0), 1e-12)
            heard = measurement.predicted(model)[1]
            noisy = model.unpredictable(measurement.reference) or any(find(name).stage == "noise" for name in effects)
            if noisy or all(np.sum((heard - other) ** 2) > TWINS * np.sum(other**2) for other in voices):
                error = np.interp(frequencies(GRID_BINS), bands().hz.mean(axis=1), over)
                kept.append(Explanation(effects, model.lasting(), error))
                voices.append(heard)
        self.explanations = tuple(kept)
        self._expected: dict[tuple[str, frozenset[int]], dict[int, dict[int, float]] | None] = {}

    def before(self) -> Array:
        """The probability of each, and of none, by the other half, before anything is asked, (explanations + 1,)."""
        return weights(_log_likelihood(self._first, self.explanations))

    def hear(self, recording: Samples, sound: Samples) -> Heard:
        """What was recorded (m,) of a sound (n,), and all explanations fitted again: to the first recording and half of this one.

        Raises SignalError where the recording does not contain the sound.
        """
        first = self._first.fitted_to(self._first.usable)
        halves = _halves(prepare(self.profile, recording, sound))
        return Heard(
            tuple((half, [self._again(one, half.model, first, half) for one in self.explanations]) for half in halves)
        )

    def _again(self, one: Explanation, start: EchoModel, *parts: Straightened) -> Explanation:
        """The same fitted to the first recording and others, as one.

        What a clock does begins anew with each recording, so that a model of one stays as it is.
        """
        if self._first.model.timed or one.model.timed:
            return one
        known = [part.measurement for part in parts]
        joined = replace(
            self._first.measurement,
            reference=np.concatenate([each.reference for each in known]),
            recording=np.concatenate([each.recording for each in known]),
            fit=np.concatenate([part.fit for part in parts]),
        )
        return replace(one, model=_fitted(joined, start, one.effects))

    def gains(self, sound: Samples) -> Array:
        """The log odds over each other expected of a sound (n,), (explanations, explanations): the first is true."""
        count = len(self.explanations)
        heard = (_simulated(self.profile, true, sound) for true in self.explanations)
        told = [self.hear(recording, sound).evidence.sum(axis=0)[:count] for recording in heard]
        return np.stack([told[i][i] - told[i] for i in range(count)])

    def sounds(self, likely: Array, progress: Callable[[str], None] | None = None) -> list[Sound]:
        """The menu, the best sound first: the one that is expected to tell most of the explanations that stand.

        Each sound is played to each explanation, as fitted, with its noise, and evaluated as what is recorded will be
        (Lindley 1956, "On a measure of the information provided by an experiment"). likely (explanations + 1,): so far;
        less than one in ENOUGH of the best does not stand, but two always do. Of the log odds that the true one gains
        over each other the mean logarithm counts, 1 added: twice as sure is worth less than another pair told. A sound that would
        not be found again is left out. Raises SignalError where no sound tells those that stand apart.
        """
        likely = likely[: len(self.explanations)]
        standing = max(int(np.count_nonzero(likely * ENOUGH >= likely.max())), 2)
        asked = np.argsort(-likely)[:standing].tolist()
        found, most = [], 0.0
        for words, sound in menu(self.reference).items():
            if progress:
                progress(f"trying {words}")
            told = self._told(words, sound, frozenset(asked))
            if told is None:
                continue
            gains = [max(float(told[i][i] - told[i][j]), 0.0) for i, j in permutations(asked, 2)]
            found.append(Sound(words, sound, float(np.mean(np.log1p(gains)))))
            most = max(most, *gains)
        found.sort(key=lambda sound: -sound.expected)
        if most < np.log(ENOUGH):
            names = " and ".join(self.explanations[i].name for i in asked)
            raise SignalError(f"no sound tells {names} apart: as fitted they predict the same; record in another place")
        return found

    def _told(self, words: str, sound: Samples, asked: frozenset[int]) -> dict[int, dict[int, float]] | None:
        """By the number of each explanation asked, were it true: the log likelihood of each after that sound of the menu.

        None where the sound would not be found again. Nothing of that changes with what is heard, so it is kept.
        """
        known = words, asked
        if known not in self._expected:
            numbers = sorted(asked)
            them = [self.explanations[i] for i in numbers]
            try:
                heard = [prepare(self.profile, _simulated(self.profile, one, sound), sound) for one in them]
            except SignalError:  # in what is recorded of it nobody would find it
                self._expected[known] = None
            else:
                told = (np.sum([_log_likelihood(h, them).sum(axis=0) for h in _halves(x)], axis=0) for x in heard)
                self._expected[known] = {
                    i: dict(zip(numbers, row.tolist())) for i, row in zip(numbers, told, strict=True)
                }
        return self._expected[known]

    def ask(
        self, play: Callable[[Sound], Samples], seconds: float, progress: Callable[[str], None] | None = None
    ) -> Answer:
        """Play the sound that best tells the remaining explanations apart, again and again, until the odds are ENOUGH or the time is over.

        play: plays a sound and returns the recording of it and of the second after it. Raises SignalError where no sound tells the
        explanations apart, or the recording does not contain the sound.
        """
        heard: list[Heard] = []
        gains: list[Array] = []
        answer = self.answer(heard, gains)
        while answer.odds < ENOUGH and (len(answer.sounds) + 1) * SOUND_S <= seconds:
            sounds = self.sounds(answer.likely, progress)
            sound = next((one for one in sounds if one.words not in answer.sounds), sounds[0])
            heard.append(self.hear(play(sound), sound.samples))
            gains.append(self.gains(sound.samples))
            answer = self.answer(heard, gains, (*answer.sounds, sound.words))
        return answer

    def answer(self, heard: Sequence[Heard], gains: Sequence[Array], sounds: tuple[str, ...] = ()) -> Answer:
        """Which is nearer to what was heard of those sounds, with what was expected of them (gains), and whether it holds.

        That is judged on what no fit has seen: for one half of the first recording it is fitted to the other half and to
        all that was heard, since a few seconds of speech do not teach a long filter. And it is judged of all as of one
        recording, since a law that loud words have taught errs in the softest sound.
        """
        nothing = np.zeros((0, len(self.explanations) + 1))
        likely = weights(np.concatenate([nothing, *(one.evidence for one in heard)]), gains)
        best = int(np.argmax(likely[:-1]))
        new = (part.fitted_to(part.usable) for each in heard for part, _ in each.halves[:1])
        first = self._again(self.explanations[best], self._first.model, self._first, *new)
        judged = [(self._first, first), *((part, them[best]) for each in heard for part, them in each.halves)]
        found = [_found(part, one.model) for part, one in judged]
        left = [one.final.excess_db for one in found]
        worst = int(np.argmax(left))
        return Answer(self.explanations, likely, sounds, holds(_as_one(found), Criteria()), left[worst], worst > 0)


def weights(found: Array, gains: Sequence[Array] = ()) -> Array:
    """The probability of each and of none, (explanations + 1,), from evidence (moments, explanations + 1), all alike before.

    No explanation is exactly true, so that likelihoods of thousands of samples would be far too sure. Asked is which of
    two is closer to what was heard: by chance the difference of their log likelihoods has either sign from moment to
    moment; its sum over the root of the sum of its squares is a normal number (Vuong 1989, "Likelihood ratio tests for
    model selection and non-nested hypotheses", eq. 4.2). gains: what was expected of each sound, as Inquiry.gains has
    it. The sum is counted from the middle of what the two expect, since a flexible explanation is never far from a
    simple one that is true; and what they expect is known to a part, LOOSE, of how far it is apart.
    """
    count = found.shape[1] - 1
    z = np.full((count, count), np.inf)
    for i, j in permutations(range(count), 2):
        less, middle = found[:, i] - found[:, j], sum(0.5 * (gain[i, j] - gain[j, i]) for gain in gains)
        variance = np.sum(less**2) + sum((0.5 * LOOSE * (gain[i, j] + gain[j, i])) ** 2 for gain in gains)
        z[i, j] = (np.sum(less) - middle) / np.sqrt(max(variance, 1e-12))
    best = int(np.argmax(z.min(axis=1)))
    z[best, best] = 0.0
    vague = found[:, best] - found[:, -1]
    z_of = np.append(z[best], np.sum(vague) / np.sqrt(max(float(np.sum(vague**2)), 1e-12)))
    odds = np.exp(log_ndtr(-z_of) - log_ndtr(z_of))
    return np.asarray(odds / odds.sum())


def menu(reference: Samples) -> dict[str, Samples]:
    """Twelve sounds of SOUND_S, by what they are, the softest first, none louder than the loudest words of reference (n,).

    These are among them. So nothing is asked of a loudspeaker that the first recording does not tell of.
    """
    rng = np.random.default_rng(35)
    n = round((SOUND_S - MARK_S - GAP_S - END_S) * SAMPLE_RATE)
    words, time = _loudest(reference, n), np.arange(n) / SAMPLE_RATE
    level, peak = float(np.sqrt(np.mean(words**2))), float(np.max(np.abs(words)))
    hz = np.arange(n // 2 + 1) * SAMPLE_RATE / n
    even = ((hz >= BAND_HZ[0]) & (hz <= 7500.0)) / np.maximum(hz, 500.0)
    lines = np.zeros(hz.size)
    odd = np.flatnonzero((np.arange(hz.size) % 2 == 1) & (even > 0.0))
    lines[rng.choice(odd, LINES, replace=False)] = 1.0
    speech, flat, sparse = (_noise(rng, shape, level, peak) for shape in (_like_speech(hz), even, lines * even))
    steps = 10.0 ** (-8.0 * np.floor(5.0 * np.arange(n) / n) / 20.0)
    sounds = {
        "silence": np.zeros(n),
        "noise, 20 dB softer": 0.1 * speech,
        "odd lines, 20 dB softer": 0.1 * sparse,
        "the loudest words, 12 dB softer": 0.25 * words,
        "the loudest words": words,
        "bursts of 50 ms with gaps": speech * (time % 0.4 < 0.05),
        "bursts of 0.3 s with gaps": speech * (time % 0.7 < 0.3),
        "five steps of level, upwards": steps[::-1] * speech,
        "five steps of level, downwards": steps * speech,
        "noise": speech,
        "odd lines": sparse,
        "noise of all frequencies": flat,
    }
    mark, gap, end = (round(seconds * SAMPLE_RATE) for seconds in (MARK_S, GAP_S, END_S))
    front = _noise(rng, _like_speech(np.arange(mark // 2 + 1) * SAMPLE_RATE / mark), level, peak)
    return {
        what: np.concatenate((front, np.zeros(gap), x, np.zeros(end))).astype(np.float32) for what, x in sounds.items()
    }


def _like_speech(hz: Array) -> Array:
    """Magnitude of average speech at hz."""
    inside = np.asarray((hz >= BAND_HZ[0]) & (hz <= BAND_HZ[1]))
    return inside * 10 ** (np.polynomial.Polynomial(SPEECH_DB)(np.log10(np.maximum(hz, BAND_HZ[0]))) / 20)


def _noise(rng: np.random.Generator, magnitude: Array, level: float, peak: float) -> Array:
    """A sound (n,) of random phases and that magnitude (n / 2 + 1,), of a root mean square and a peak, faded in and out."""
    x = _faded(np.fft.irfft(magnitude * np.exp(2j * np.pi * rng.uniform(size=magnitude.size))))
    return np.asarray(x * min(level / np.sqrt(np.mean(x**2)), peak / np.max(np.abs(x))))


def _loudest(reference: Samples, n: int) -> Array:
    """The loudest stretch of a reference, (n,), faded in and out, with silence behind a shorter one."""
    x = np.pad(reference.astype(np.float64), (0, max(n - reference.size, 0)))
    return _faded(x[loudest(x, np.ones(x.size, bool), n)])


def _faded(x: Array) -> Array:
    """Samples faded in and out over 10 ms, (n,)."""
    length = SAMPLE_RATE // 100
    fade = np.minimum(np.arange(1, x.size + 1), length) / length
    return np.asarray(x * (fade * fade[::-1]))


def _fitted(measurement: Measurement, model: EchoModel, effects: Sequence[str]) -> EchoModel:
    try:
        return fit_jointly(measurement, model, effects)
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        raise SignalError(f"{'+'.join(effects)} cannot be fitted to the recording: {error}") from None


def _halves(prepared: Straightened) -> tuple[Straightened, Straightened]:
    """The recording, and the same with what is fitted and what is held out exchanged, for a cross-validation by halves."""
    return prepared, prepared.fitted_to(prepared.held_out)


def _simulated(profile: Profile, true: Explanation, sound: Samples) -> Samples:
    """What would be recorded of a sound (n,), and for a second after it, were that explanation true: (n + SAMPLE_RATE,).

    Its own error is its voice, so much softer, with a sign that changes at random: no filter that is fitted takes it up.
    """
    rng, model = np.random.default_rng(1), true.model
    x = delayed(np.pad(sound, (0, SAMPLE_RATE)), profile.delay - PRE_ROLL)
    bins = frequencies(ERROR_TAPS // 2 + 1)
    off = np.fft.irfft(np.sqrt(np.interp(bins, frequencies(GRID_BINS), true.error)))
    voice, signs = model.predict(x), np.repeat(rng.choice([-1.0, 1.0], x.size // HOP + 1), HOP)[: x.size]
    wrong = signs * convolve(voice, np.fft.fftshift(off))[ERROR_TAPS // 2 :][: x.size]
    fan = coloured(rng, x.size, model.expected_noise(profile.noise_psd)).astype(np.float32)
    heard = voice + wrong + model.passed(fan, x)
    for square, colour in model.unpredictable(x):
        heard = heard + np.sqrt(square) * coloured(rng, x.size, colour)
    return heard.astype(np.float32)


def _found(prepared: Straightened, model: EchoModel) -> Found:
    """What a model leaves of a recording, as a search says it that ends with that model."""
    start = prepared.model
    return Found(prepared, start, model, prepared.of(start), prepared.of(model), ())


def _as_one(found: Sequence[Found]) -> Found:
    """What a model leaves of several recordings, scored as one of that length: levels in the mean, excess in mean power."""
    seconds = [np.count_nonzero(each.recording.held_out) for each in found]

    def joined(scores: Sequence[Score]) -> Score:
        def level(name: str) -> float:
            return float(np.average([getattr(one, name) for one in scores], weights=seconds))

        def power(name: str) -> float:
            return float(decibels(np.average([10 ** (getattr(one, name) / 10) for one in scores], weights=seconds)))

        return replace(
            scores[0],
            level_db=level("level_db"),
            over_db=level("over_db"),
            floor_db=level("floor_db"),
            excess_db=power("excess_db"),
            active_db=power("active_db"),
            silent_db=power("silent_db"),
        )

    return replace(found[0], base=joined([one.base for one in found]), final=joined([one.final for one in found]))


def _cells(recording: Straightened, model: EchoModel) -> tuple[Array, Array, Array]:
    """The power that a model leaves, what it expects, and its voice, over the known fan, (moments, bands) each."""
    score = recording.of(model)
    power = recording.cells(recording.measurement.recording - score.prediction)
    return power, power / score.cells, recording.cells(score.prediction)


def _log_likelihood(prepared: Straightened, explanations: Sequence[Explanation]) -> Array:
    """Log likelihood of the held-out time-frequency cells, (moments, explanations + 1); the last column is of no explanation.

    Student's t with as many degrees of freedom as the cell has (Lange, Little & Taylor 1989): a cell that is louder than expected counts
    by its level in dB, and one that is softer than expected counts as well.
    """
    freedom = bands().freedom * (STEP / (HOP - 1))

    def likelihood(power: Array, expected: Array) -> Array:
        return -0.5 * np.sum(freedom * (np.log(expected) + 2.0 * np.log1p(power / expected)), axis=1)

    columns, vague = [], []
    for each in explanations:
        power, expected, voice = _cells(prepared, each.model)
        error = np.interp(bands().hz.mean(axis=1), frequencies(GRID_BINS), each.error)
        expected = expected + error * voice
        columns.append(likelihood(power, expected))
        vague.append(likelihood(power, NONE * expected))
    if not prepared.starts.size:
        raise SignalError("too little of the recording can be evaluated: expected two seconds in which nobody talks")
    best = int(np.argmax([column.sum() for column in columns]))
    return np.stack([*columns, vague[best]], axis=1)
