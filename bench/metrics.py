"""What is measured of an output, what is said of many (means, intervals, paired differences), what makes a clip hard."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import stats

from bench.cache import Cache
from bench.recogniser import Recogniser, word_errors
from bench.recordings import Clip, Conversation
from edgefilter.dsp.metrics import erle, si_sdr
from edgefilter.filter.barge_in import BargeIn, BargeInSettings
from edgefilter.types import SAMPLE_RATE, Event, Samples

if TYPE_CHECKING:
    from bench.closed_loop import Output

FRAME = SAMPLE_RATE // 50
"""20 ms: of levels over time."""
FLOOR = 1e-10
"""-100 dB of full scale, added to powers: below it no difference can be noticed, and digital silence has no ratio."""
ALONE_S = 5.0
"""Robot alone just before the human, over which it is measured how far the robot is lowered: while both talk nobody can
tell what of a nonlinear filter's output is echo."""
MOS_S = 20.0
"""AECMOS gets at most so much, up to the human's end: it was trained on clips of about 10 s."""
SECOND = "second_"
"""Before the name of a figure: of the second recogniser."""
TALK_TYPES = {"doubletalk": "dt", "farend": "st", "nearend": "nst"}
"""AECMOS's names for who talks."""


# ---------------------------------------------------------------- one output


@dataclass(frozen=True)
class CachedMetrics:
    """What costs seconds, kept under the sound that it is of: the recogniser's words, AECMOS, ESTOI."""

    cache: Cache
    recogniser: Recogniser | None = None
    second: Recogniser | None = None

    @property
    def asked(self) -> str:
        """Which recognisers the words are of."""
        return " ".join(one.identity for one in (self.recogniser, self.second) if one) or "no recogniser"

    def words(self, text: str, out: Samples) -> dict:
        """Return errors, words, deletions, insertions, wer, capped (%) and transcript; the second recogniser's as second_errors and so on."""
        row = {}
        for before, one in (("", self.recogniser), (SECOND, self.second)):
            if one:
                said = one.transcribe(out)
                found = word_errors(text, said)
                told = asdict(found) | {"wer": 100 * found.rate, "capped": 100 * found.capped, "transcript": said}
                row |= {f"{before}{key}": value for key, value in told.items()}
        return row

    def mos(self, mic: Samples, ref: Samples, out: Samples, talk: str) -> dict[str, float]:
        """Return echo_mos and human_mos, 1 to 5 (Purin et al. 2022, "AECMOS"); empty where speechmos is not installed."""
        scorer = _aecmos()
        if scorer is None:
            return {}
        signals = {name: np.clip(x, -1, 1) for name, x in (("lpb", ref), ("mic", mic), ("enh", out))}

        def made() -> dict[str, float]:
            said = scorer(signals, TALK_TYPES[talk])
            return {"echo_mos": float(said["echo_mos"]), "human_mos": float(said["deg_mos"])}

        return self.cache.get(made, "aecmos", talk, *signals.values())

    def estoi(self, human: Samples, out: Samples) -> float | None:
        """Extended short-time objective intelligibility (Jensen & Taal 2016); None where pystoi is not installed."""
        try:
            from pystoi import stoi
        except ImportError:
            return None

        def made() -> float:
            before = np.random.get_state()
            np.random.seed(0)  # it adds a noise of its own, from the global generator
            try:
                return float(stoi(human.astype(np.float64), out.astype(np.float64), SAMPLE_RATE, extended=True))
            finally:
                np.random.set_state(before)

        return self.cache.get(made, "estoi", human, out)


@lru_cache(maxsize=1)
def _aecmos() -> Callable | None:
    try:
        from speechmos.aecmos import AECMOS
    except ImportError:
        return None
    return AECMOS("aecmos_16kHz")


def score(clip: Clip, output: Output, cached: CachedMetrics) -> dict:
    """All figures of one system on one clip; "problem" replaces those that an unusable output rules out.

    si_sdr, estoi and the words are over the span in which the human speaks; erle_db over the ALONE_S before it, or over
    the whole of a recording in which nobody speaks, which also has erle_frames_db, the median over its frames; excess_db is by
    how much the output exceeds the microphone in the second where it does most. Systems that tell events also have delay_s and
    early, or false_starts where nobody speaks.
    """
    out, mic, ref = output.samples, clip.mic, clip.ref
    row: dict = {"duration": mic.size / SAMPLE_RATE}
    if out.size != mic.size:
        return row | {"problem": f"{out.size} samples for {mic.size}"}
    if not np.isfinite(out).all():
        return row | {"problem": "samples that are not finite"}
    row["excess_db"] = excess_db(out, mic)
    if clip.human is None:
        row |= cached.mos(*(x[-round(MOS_S * SAMPLE_RATE) :] for x in (mic, ref, out)), clip.talk)
        if clip.talk == "farend":
            row |= {"erle_db": lowered_db(mic, out), "erle_frames_db": frames_db(mic, out)}
            row |= {} if output.events is None else {"false_starts": starts(output.events)}
        if clip.talk == "nearend":
            row["si_sdr_mic"] = si_sdr(out, mic)
        return row
    span, before = clip.span, slice(max(clip.span.start - round(ALONE_S * SAMPLE_RATE), 0), clip.span.start)
    listened = slice(max(span.stop - round(MOS_S * SAMPLE_RATE), 0), span.stop)
    if not out[span].any():
        return row | {"problem": "silence where the human speaks"}
    row |= cached.mos(mic[listened], ref[listened], out[listened], clip.talk)
    row["erle_db"] = lowered_db(mic[before], out[before]) if before.start < before.stop else None
    human = clip.human[span]
    if not np.array_equal(out[span], human):  # the human alone has no distance from itself
        row |= {"si_sdr": si_sdr(out[span], human), "estoi": cached.estoi(human, out[span])}
    if clip.text:
        row |= cached.words(clip.text, out[span])
    return row if output.events is None else row | noticed(output.events, first_sound(clip.human))


def lowered_db(mic: Samples, out: Samples) -> float | None:
    """ERLE, dB; None where one of both is silent."""
    return erle(mic, out) if mic.any() and out.any() else None


def frames_db(mic: Samples, out: Samples) -> float:
    """Median ERLE of the frames within FIRST_DB of the microphone's loudest, dB: a few loud ones decide over their energy."""
    heard, left = frame_power(mic), frame_power(out)
    loud = heard >= 10 ** (-FIRST_DB / 10) * heard.max()
    return float(np.median(10 * np.log10((heard[loud] + FLOOR) / (left[loud] + FLOOR))))


def frame_power(x: Samples, frame: int = FRAME) -> np.ndarray:
    """Mean square of each whole frame of x (n,), (n // frame,) float64."""
    return np.mean(x[: x.size // frame * frame].reshape(-1, frame).astype(np.float64) ** 2, axis=1)


def excess_db(out: Samples, mic: Samples) -> float:
    """The most by which out is louder than mic, both (n,), over any second at steps of 0.1 s, dB."""

    def windows(x: Samples) -> np.ndarray:
        window, step = min(SAMPLE_RATE, x.size), SAMPLE_RATE // 10
        sums = np.cumsum(np.append(0.0, x.astype(np.float64) ** 2))
        at = np.arange(0, x.size - window + 1, step)
        return (sums[at + window] - sums[at]) / window

    return float(np.max(10 * np.log10((windows(out) + FLOOR) / (windows(mic) + FLOOR))))


# ---------------------------------------------------------------- barge-in

IN_TIME_S = 0.3
"""Somebody who interrupts is to be noticed by then."""
FIRST_DB = 25.0
"""A human's first sound is the first frame within so much of the loudest."""
THRESHOLDS = (0.5, 0.7, 0.8, 0.9, 0.94, 0.96, 0.97, 0.98, 0.985, 0.99, 0.995)
"""Of the probability, from which speech counts as begun: the points of the curve."""


def first_sound(human: Samples) -> int:
    """First sample of the first 20 ms within FIRST_DB of the human's loudest."""
    power = frame_power(human)
    return int(np.flatnonzero(power > 10 ** (-FIRST_DB / 10) * power.max())[0]) * FRAME


def noticed(events: Sequence[Event], onset: int) -> dict:
    """delay_s: from the onset to the next speech_started, None without one; early: speech was on already."""
    talk = [event for event in events if event.kind in ("speech_started", "speech_stopped")]
    before = [event.kind for event in talk if event.sample < onset]
    after = [event.sample for event in talk if event.sample >= onset and event.kind == "speech_started"]
    early = bool(before) and before[-1] == "speech_started"
    return {"delay_s": None if early or not after else (after[0] - onset) / SAMPLE_RATE, "early": early}


def in_time(found: Mapping) -> bool:
    """Whether what `noticed` found is soon enough."""
    return found["delay_s"] is not None and found["delay_s"] <= IN_TIME_S


def delays_s(found: Iterable[Mapping]) -> list[float]:
    """Delays of what `noticed` found where speech was not on already, infinite for who was never noticed."""
    return [math.inf if one["delay_s"] is None else one["delay_s"] for one in found if not one["early"]]


def later(delays: Sequence[float], share: float) -> float | None:
    """The delay that this share of them does not exceed: one of them, the later where it lies between two; None without any."""
    return float(np.quantile(delays, share, method="higher")) if delays else None


def starts(events: Sequence[Event]) -> int:
    return sum(event.kind == "speech_started" for event in events)


def per_hour(count: int, hours: float) -> dict:
    """So many events in so many hours as a rate, with the exact Poisson interval."""
    low, high = stats.chi2.ppf([0.025, 0.975], [2 * count or 1, 2 * count + 2]) / 2 / hours
    return {"mean": count / hours, "low": float(low) if count else 0.0, "high": float(high)}


def replay(probability: Sequence[float | None], hop: int, threshold: float) -> list[Event]:
    """The events that the package would give at this threshold, of one probability a hop (samples); None where nothing judged."""
    usual = BargeInSettings()
    rule = BargeIn(hop / SAMPLE_RATE, replace(usual, threshold=threshold, release=min(usual.release, threshold)))
    found = ((index * hop, rule.note(value)) for index, value in enumerate(probability, start=1))
    return [Event(kind, sample, "replayed") for sample, kind in found if kind]


# ---------------------------------------------------------------- many outputs

RESAMPLES = 2000


def values(rows: Iterable[Mapping], key: str) -> tuple[list[Mapping], np.ndarray]:
    kept = [row for row in rows if row.get(key) is not None]
    return kept, np.array([row[key] for row in kept], np.float64)


def mean(rows: Iterable[Mapping], key: str) -> dict | None:
    """Return mean, low, high (95 %), median, std and count of a figure; None where no row has it.

    The interval is drawn over speakers and places (keys of a row, where it has them), not over recordings.
    """
    kept, found = values(rows, key)
    if not kept:
        return None
    low, high = _bounds(kept, found)
    spread = float(np.std(found, ddof=1)) if found.size > 1 else None
    median = float(np.median(found))
    return {"mean": float(found.mean()), "low": low, "high": high, "median": median, "std": spread, "count": found.size}


def middle(found: Mapping | None) -> float | None:
    """The mean without its interval."""
    return found and found["mean"]


def pooled(rows: Iterable[Mapping], above: str, below: str) -> dict | None:
    """Sum of one figure over the sum of another, %, with its interval."""
    kept, top = values(rows, above)
    if not kept:
        return None
    bottom = np.array([row[below] for row in kept], np.float64)
    low, high = _bounds(kept, 100 * top, bottom)
    return {"mean": float(100 * top.sum() / bottom.sum()), "low": low, "high": high, "count": int(bottom.sum())}


def difference(rows: Iterable[Mapping], others: Iterable[Mapping], key: str) -> dict | None:
    """By how much a figure is above that of other rows on the same clips, with its paired interval."""
    (kept, mine), (theirs, known) = values(rows, key), values(others, key)
    of = {row["clip"]: value for row, value in zip(theirs, known, strict=True)}
    both = [(row, value - of[row["clip"]]) for row, value in zip(kept, mine, strict=True) if row["clip"] in of]
    return mean([{**row, key: value} for row, value in both], key)


def _bounds(
    rows: Sequence[Mapping], above: np.ndarray, below: np.ndarray | None = None
) -> tuple[float | None, float | None]:
    """95 % percentile interval of sum(above) / sum(below), (n,) each, or of a mean; None of one row."""
    if len(rows) < 2:
        return None, None
    clusters = (tuple(row.get(key, index) for index, row in enumerate(rows)) for key in ("speaker", "place"))
    weights = cluster_weights(*clusters)
    sums = weights @ (np.ones(len(above)) if below is None else below)
    low, high = np.percentile((weights @ above)[sums > 0] / sums[sums > 0], [2.5, 97.5])
    return float(low), float(high)


@lru_cache(maxsize=64)
def cluster_weights(*factors: tuple[Hashable, ...]) -> np.ndarray:
    """How often each of n recordings is drawn, (RESAMPLES, n), where speakers, rooms and the like are drawn and not they.

    factors: for each recording the cluster that it belongs to. Each factor's clusters are drawn with replacement, on
    their own; a recording counts as often as the product says (the pigeonhole bootstrap, Owen 2007, a little too wide
    rather than too narrow). A factor of one cluster says nothing and stays as it is. With a fixed seed.
    """
    rng = np.random.default_rng(0)
    weights = np.ones((RESAMPLES, len(factors[0])))
    for factor in dict.fromkeys(factors):  # recordings that are clusters of their own in both ways are drawn once
        names = {name: index for index, name in enumerate(dict.fromkeys(factor))}
        drawn = rng.multinomial(len(names), np.full(len(names), 1 / len(names)), size=RESAMPLES)
        weights *= drawn[:, [names[name] for name in factor]]
    return weights


def counted(flags: Iterable[bool]) -> dict:
    """How many of how many flags are set, and the percentage with its interval (`wilson`)."""
    flags = list(flags)
    low, high = wilson(sum(flags), len(flags))
    share = {"mean": 100 * sum(flags) / max(len(flags), 1), "low": 100 * low, "high": 100 * high}
    return {"hits": sum(flags), "n": len(flags), **share}


def wilson(hits: int, n: int) -> tuple[float, float]:
    """95 % interval of a proportion (Wilson 1927), as numbers from 0 to 1.

    >>> [round(bound, 3) for bound in wilson(0, 100)]
    [0.0, 0.037]
    """
    if n == 0:
        return 0.0, 1.0
    z, p = 1.959964, hits / n
    centre, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return max(0.0, (centre - half) / (1 + z * z / n)), min(1.0, (centre + half) / (1 + z * z / n))


def percentiles(samples: Sequence[float], *percents: float) -> dict[str, float]:
    """p50, p95, ... of the samples; 100 is called max.

    >>> percentiles([1.0, 2.0, 3.0], 50, 100)
    {'p50': 2.0, 'max': 3.0}
    """
    found = np.percentile(samples, percents)
    names = ("max" if percent == 100 else f"p{percent:g}" for percent in percents)
    return dict(zip(names, map(float, found), strict=True))


# ---------------------------------------------------------------- what makes a clip hard

PITCH_HZ = (60.0, 400.0)
PITCH_FRAME = SAMPLE_RATE // 25
"""40 ms: two periods of the deepest voice."""
VOICED = 0.6
"""A frame is voiced where the autocorrelation, corrected for the window, reaches so much of the power."""
OCTAVE = 0.03
"""A peak is taken to be so much lower for each octave of lag: a periodic sound has one at every multiple of its period."""
TALKS_DB = 30.0
"""The robot talks in frames within so much of its loudest."""


class Quantity(NamedTuple):
    """A quantity by which results are split into bins: its key among a clip's facts, its heading, and its digits."""

    key: str
    title: str
    digits: int = 0


QUANTITIES = (
    Quantity("level_db", "Human over everything else, dB", 1),
    Quantity("pitch_hz", "Pitch of the human, Hz"),
    Quantity("rt60_s", "Reverberation time, s", 2),
    Quantity("fan_db", "Human over fan, dB", 1),
    Quantity("distortion_db", "Distortion of the loudspeaker, dB", 1),
    Quantity("before_s", "Robot talked before, s", 1),
)


def facts(clip: Clip) -> dict[str, float]:
    found: dict[str, float] = {}
    if clip.human is not None:
        span, mic, human = clip.span, clip.mic, clip.human
        rest = (mic - human)[span]
        found["level_db"] = 10 * np.log10(np.mean(human[span] ** 2) / max(float(np.mean(rest**2)), 1e-12))
        if (pitch := pitch_hz(human[span])) is not None:
            found["pitch_hz"] = pitch
        found["before_s"] = talking_s(clip.ref[: span.start])
    if isinstance(clip.source, Conversation):
        meta = clip.source.meta
        found |= {"rt60_s": meta["rt60"], "fan_db": meta["snr_fan"], "distortion_db": meta["nl_db"]}
    return {key: float(value) for key, value in found.items()}


def talking_s(ref: Samples) -> float:
    power = frame_power(ref)
    return float(np.sum(power > 10 ** (-TALKS_DB / 10) * power.max(initial=0.0))) * FRAME / SAMPLE_RATE


def pitch_hz(samples: Samples) -> float | None:
    """Median pitch of samples (n,) where voiced, by autocorrelation over the window's (Boersma 1993), or None."""
    starts = np.arange(0, samples.size - PITCH_FRAME + 1, PITCH_FRAME // 2)
    if not starts.size:
        return None
    window = np.hanning(PITCH_FRAME)
    frames = samples[starts[:, None] + np.arange(PITCH_FRAME)].astype(np.float64)
    loud = np.mean(frames**2, axis=1)
    frames = (frames - frames.mean(axis=1, keepdims=True))[loud > 0.1 * loud.max()] * window
    low, high = (round(SAMPLE_RATE / hz) for hz in reversed(PITCH_HZ))
    lags = _autocorrelation(frames)[:, low:high] / _autocorrelation(window[None])[:, low:high]
    best = np.argmax(lags - OCTAVE * np.log2(np.arange(low, high)), axis=1)
    voiced = lags[np.arange(best.size), best] > VOICED
    return float(np.median(SAMPLE_RATE / (low + best[voiced]))) if voiced.any() else None


def _autocorrelation(frames: np.ndarray) -> np.ndarray:
    """Of each row, from lag 0 on, over that at lag 0."""
    size = 2 * frames.shape[1]
    found = np.fft.irfft(np.abs(np.fft.rfft(frames, size, axis=1)) ** 2, axis=1)
    return found / np.maximum(found[:, :1], 1e-20)
