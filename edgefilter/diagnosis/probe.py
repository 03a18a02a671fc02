"""What to play next where several explanations of a recording remain: the sound that tells them apart best, and their odds once it was heard."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.ndimage import uniform_filter1d

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.prepare import Prepared, prepare
from edgefilter.diagnosis.score import Judge
from edgefilter.diagnosis.select import search
from edgefilter.diagnosis.trials import added, beside
from edgefilter.dsp.psd import hann
from edgefilter.echo.effects.catalogue import find, names
from edgefilter.echo.effects.gain_fit import loudest
from edgefilter.echo.measurement import whiten
from edgefilter.echo.model import EchoModel
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Array, Samples

RIVAL = 0.7
"""Share of the level that the best explanation explains, from which on another one remains."""
MOST = 4
"""Explanations that are kept."""
TOLERANCE = 0.03
"""Part of the voice, in amplitude (-30 dB), by which a fitted model errs on a sound that it was not fitted to."""
ENOUGH = 20.0
"""Odds at which the question is settled."""
SOUND_S = 2.5
"""Seconds of one sound: two of them are what a robot plays without anybody asking what it does."""
SPAN = 256
MARK_S, MARK_GAP_S = 0.3, 0.2
"""Each sound begins with noise by which its lag is found, and a gap."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """effects: names, beyond the profile's. model: with them. weight: its probability among those that remain."""

    effects: tuple[str, ...]
    model: EchoModel
    weight: float

    @property
    def name(self) -> str:
        """The names in one word."""
        return "+".join(self.effects)


@dataclass(frozen=True, eq=False)
class Sound:
    """One sound of the menu: what it is in words, its samples (n,), and by how much it is expected to move the log odds."""

    words: str
    samples: Samples
    expected: float


def remaining(
    profile: Profile, recording: Samples, reference: Samples, progress: Callable[[str], None] | None = None
) -> tuple[Explanation, ...]:
    """The explanations of a recording (n,) that remain, the best first, all as probable.

    What the diagnosis finds, and each listed effect that explains nearly as much alone. Effects that belong to one moment of
    the recording explain no other and are left out; explanations that no sound of the menu tells apart count as one.
    """
    prepared = prepare(profile, recording, reference)
    found = search(prepared, prepared.model, Criteria(thorough=True), progress)
    judge, best = Judge(found.prepared), found.base.level_db - found.final.level_db
    models = {tuple(sorted(added(found.start, found.model))): (found.model, best)}
    tried = [e.alone for e in found.tried if e.alone and not e.short and not find(e.name).free_law]
    untried = [name for name in names() if find(name).is_of_the_fan or find(name).in_what_is_left]
    tried += [trial for name in untried if (trial := beside(judge, name, found.start)) is not None]
    for trial in tried:
        if trial.gain_db >= RIVAL * best and not find(trial.name).event:
            models.setdefault((trial.name,), (trial.model, trial.gain_db))
    ranked = sorted((key for key in models if key), key=lambda key: -models[key][1])
    kept: list[tuple[str, ...]] = []
    sounds = [samples for _, samples in menu(reference, SOUND_S)]
    said = {key: [_expected(profile, models[key][0], sound) for sound in sounds] for key in ranked[: 2 * MOST]}
    for key in said:
        alike = (max(map(_apart, said[key], said[other])) < np.log(ENOUGH) for other in kept)
        if not any(alike) and not any(find(name).event for name in key):
            kept.append(key)
    return tuple(Explanation(key, models[key][0], 1.0 / len(kept[:MOST])) for key in kept[:MOST])


def best_sound(profile: Profile, explanations: Sequence[Explanation], reference: Samples) -> Sound:
    """Of a dozen sounds of SOUND_S the one that is expected to tell the explanations apart best.

    The expected gain of each pair's log odds, by simulating both, weighed by how probable both are (expected information; Chaloner
    & Verdinelli 1995); reference (n,): of which sentences are taken.
    """

    def worth(samples: Samples) -> float:
        said = [_expected(profile, each.model, samples) for each in explanations]
        pairs = combinations(range(len(said)), 2)
        return sum(explanations[i].weight * explanations[j].weight * _apart(said[i], said[j]) for i, j in pairs)

    sounds = [Sound(words, samples, worth(samples)) for words, samples in menu(reference, SOUND_S)]
    return max(sounds, key=lambda sound: sound.expected)


def weighed(
    profile: Profile, explanations: Sequence[Explanation], sound: Samples, recording: Samples
) -> tuple[Explanation, ...]:
    """The explanations with the weights that a recording (n,) of a sound (m,) gives them, the most probable first.

    Raises SignalError where the recording does not contain the sound.
    """
    prepared = prepare(profile, recording, sound)
    everything = replace(prepared, measurement=replace(prepared.measurement, fit=np.zeros(recording.size, bool)))
    likely = np.array([_log_likelihood(everything, each.model) for each in explanations])
    weights = np.array([each.weight for each in explanations]) * np.exp(likely - likely.max())
    weights /= weights.sum()
    now = [replace(each, weight=float(weight)) for each, weight in zip(explanations, weights, strict=True)]
    return tuple(sorted(now, key=lambda each: -each.weight))


def settled(explanations: Sequence[Explanation]) -> bool:
    """Whether the first is ENOUGH times as probable as all others together."""
    first = explanations[0].weight if explanations else 1.0
    return first >= ENOUGH * (1.0 - first)


def menu(reference: Samples, seconds: float) -> list[tuple[str, Samples]]:
    """Sounds of at most so many seconds, in words and samples, each behind a short noise."""
    rng = np.random.default_rng(0)
    n, peak = round((seconds - MARK_S - MARK_GAP_S) * SAMPLE_RATE), float(np.max(np.abs(reference)))
    time = np.arange(n) / SAMPLE_RATE
    noise = _like(reference, n, rng)
    steps = 10.0 ** (-10.0 * np.floor(4.0 * np.arange(n) / n)[::-1] / 20.0)
    sentence = reference[loudest(reference, n)]
    sentence = np.pad(sentence, (0, n - sentence.size))
    odd = np.sum([np.sin(2 * np.pi * hz * time + rng.uniform(0, 6.3)) for hz in np.arange(75.0, 4000.0, 50.0)], axis=0)
    sounds = {
        "silence": np.zeros(n),
        "the loudest sentence": sentence,
        "the same sentence 12 dB softer": 0.25 * sentence,
        "the same sentence, turned up to full scale": 0.9 * sentence / max(float(np.max(np.abs(sentence))), 1e-9),
        "steps of level, soft to loud": steps * noise,
        "steps of level, loud to soft": steps[::-1] * noise,
        "soft noise": 0.1 * noise,
        "loud noise": noise,
        "bursts of 50 ms with gaps": noise * (time % 0.5 < 0.05),
        "a word and a long gap": noise * (time % 2.0 < 0.3),
        "soft odd lines": 0.1 * peak * odd / np.max(np.abs(odd)),
        "loud odd lines": peak * odd / np.max(np.abs(odd)),
    }
    mark = 0.3 * _like(reference, round(MARK_S * SAMPLE_RATE), rng)
    front = np.concatenate((mark, np.zeros(round(MARK_GAP_S * SAMPLE_RATE))))
    return [(words, np.concatenate((front, x)).astype(np.float32)) for words, x in sounds.items()]


def _like(reference: Samples, n: int, rng: np.random.Generator) -> Array:
    """(n,) noise with the spectrum of a reference, as loud at its peaks."""
    spectrum = np.abs(np.fft.rfft(reference[: 8 * SAMPLE_RATE]))
    width = max(spectrum.size // 200, 1)
    shape = np.sqrt(uniform_filter1d(spectrum**2, width))
    white = np.fft.rfft(rng.standard_normal(n))
    x = np.fft.irfft(white * np.interp(np.linspace(0, 1, white.size), np.linspace(0, 1, shape.size), shape), n)
    fade = min(n // 2, 160)
    x[:fade] *= hann(2 * fade)[:fade]
    return float(np.max(np.abs(reference))) * x / max(float(np.max(np.abs(x))), 1e-12)


def _expected(profile: Profile, model: EchoModel, sound: Samples) -> tuple[Samples, Array]:
    """The voice (n,) that a model predicts for a sound, whitened by the calibrated fan, and the variance (spans,) of what comes on top."""
    psd = profile.noise_psd
    voice = whiten(model.predict(sound), psd)
    noise = np.full(sound.size, float(np.mean(model.expected_noise(psd) / psd)))
    for square, colour in model.unpredictable(sound):
        noise = noise + square * float(np.mean(colour / psd))
    return voice, _spans(noise + (TOLERANCE * voice.astype(np.float64)) ** 2)


def _apart(one: tuple[Samples, Array], other: tuple[Samples, Array]) -> float:
    """Log odds that are expected from hearing what one of two explanations predicts, were it true, the mean of both."""
    difference = _spans((one[0].astype(np.float64) - other[0]) ** 2)
    means = 0.5 * difference * (1.0 / one[1] + 1.0 / other[1])
    ratio = one[1] / other[1]
    return float(np.sum(np.log1p(means) + 0.5 * (ratio + 1.0 / ratio) - 1.0))


def _spans(x: Array) -> Array:
    """Means of x (n,) over spans of 16 ms."""
    whole = x[: x.size // SPAN * SPAN].reshape(-1, SPAN)
    return whole.mean(axis=1)


def _log_likelihood(prepared: Prepared, model: EchoModel) -> float:
    """Of a prepared recording, but for a constant, by the judge's cells, the model's own error on a new sound as noise."""
    judge = Judge(prepared.behind(model.expected_noise(prepared.noise_psd)))
    reference = prepared.measurement.reference
    voice, white = prepared.measurement.heard(model)
    error = uniform_filter1d((TOLERANCE * voice.astype(np.float64)) ** 2, 2 * SPAN).astype(np.float32)
    own = (error, np.full(prepared.noise_psd.size, 2.0 / SAMPLE_RATE))
    score = judge.judge(voice, white, (*model.unpredictable(reference), own), model.microphone_gain(voice.size))
    return -0.5 * float(np.sum(score.deviance))
