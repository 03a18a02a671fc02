"""Bring a recording of the robot alone into a state in which it can be held against a prediction: rate, lag, silence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import soxr
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from edgefilter.echo.effect import Measurement, complete, find, whiten
from edgefilter.echo.model import PRE_ROLL
from edgefilter.errors import SignalError
from edgefilter.profile import Profile
from edgefilter.types import SAMPLE_RATE, Samples, as_samples

MAX_OFFSET = 3.0
"""Seconds by which the recording may lag behind or lead the calibration's."""
BLOCK = SAMPLE_RATE // 2
"""Samples of the blocks that are fitted on and judged by in turn."""
SILENCE_DB = -15.0
"""The robot is silent where its predicted voice, whitened, is this far under the fan."""
FAN_TOLERANCE_DB = 1.0
"""By which the fan of a robot differs from day to day."""
TALK_DB = 8.0
"""Over the fan: more than a reverberation tail in a pause, less than a soft voice at two metres."""
GAP_S, EDGE_S = 1.0, 0.2
CUT, CUT_DB, TAIL_S = 32, -30.0, 0.3
"""A reference begins or ends in the middle of a word where that many samples at its end are no further below its loudest 20 ms; what was said before
still sounds for TAIL_S."""
PAUSE_S, LAG_STEP = 0.5, 480
"""Silence of the reference after which a player may have started anew, and samples (30 ms) by which the lag must differ then."""
MIN_SECONDS = 1.0
TRACK = SAMPLE_RATE
"""Samples of one window of the lag track."""
TRACK_REACH = 1600
"""Samples by which the lag may move away from that of the whole recording and still be followed."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """A recording beside what the profile predicts, on one sample counter; all arrays (n,).

    measurement: aligned reference, recording, the fan's PSD, the samples to fit on. prediction: of the profile.
    usable: samples where nobody else talks. active: where the robot is heard. offset: samples of lag against the calibration.
    human: (start_s, end_s) of other talkers.
    """

    measurement: Measurement
    prediction: Samples
    usable: NDArray[np.bool_]
    active: NDArray[np.bool_]
    offset: float
    human: tuple[tuple[float, float], ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def held_out(self) -> NDArray[np.bool_]:
        """(n,) samples that no fit has used."""
        return self.usable & ~self.measurement.fit


def prepare(profile: Profile, recording: Samples, reference: Samples, *, sample_rate: int = SAMPLE_RATE) -> Prepared:
    """Resample to 16 kHz, find the constant lag, mark silence and the blocks to fit on.

    recording (m,), reference (k,): float, full scale +-1, at sample_rate. Raises SignalError for less than a second or where the
    recording does not contain the reference.
    """
    y, x = as_samples(recording, "recording"), as_samples(reference, "reference")
    if sample_rate != SAMPLE_RATE:
        y, x = (soxr.resample(signal_, sample_rate, SAMPLE_RATE).astype(np.float32) for signal_ in (y, x))
    for samples, name in ((y, "recording"), (x, "reference")):
        if samples.size < MIN_SECONDS * SAMPLE_RATE:
            raise SignalError(f"the {name} is {samples.size / SAMPLE_RATE:.2f} s long, expected at least {MIN_SECONDS:g} s of the robot's voice")
    n = y.size
    x = np.pad(x, (0, max(n - x.size, 0)))[:n]
    start = profile.delay - PRE_ROLL
    at_calibration = shift(x, start)
    predicted = profile.echo.predict(at_calibration)
    known = expected_noise(profile)
    offset = starting_offset(whiten(predicted, known), whiten(y, known))
    pieces = utterance_lags(x, predicted, y, known, offset)
    begin, end = known_span(x, start + pieces[0][2], start + pieces[-1][2])
    x = sum(shift(np.where((np.arange(n) >= first) & (np.arange(n) < last), x, np.float32(0)), start + lag) for first, last, lag in pieces)
    predicted = profile.echo.predict(x)
    white = whiten(predicted, known).astype(np.float64)
    block = SAMPLE_RATE // 50
    level = np.add.reduceat(white**2, np.arange(0, n, block)) / block
    active = np.repeat(maximum_filter1d(level, 11) > 10 ** (SILENCE_DB / 10), block)[:n]
    fit = np.arange(n) // BLOCK % 2 == 0
    quiet = whiten(y, known) ** 2
    psd = known * np.float32(fan_scale(whiten(y, known)[~active]))
    human = find_talk(quiet * (known[1] / psd[1]), active)
    usable = np.ones(n, bool)
    for first, last in human:
        usable[round(first * SAMPLE_RATE) : round(last * SAMPLE_RATE)] = False
    warnings = tuple(f"somebody talks at {first:.1f} to {last:.1f} s: left out" for first, last in human)
    if end - begin < n and end - begin > n // 2:
        usable[:begin], usable[end:] = False, False
        warnings += (f"the reference is cut in mid-word: only {begin / SAMPLE_RATE:.1f} to {end / SAMPLE_RATE:.1f} s are judged",)
    if len(pieces) > 1:
        lags = ", ".join(f"{lag:.1f} from {first / SAMPLE_RATE:.1f} s" for first, _, lag in pieces)
        warnings += (f"the utterances lag by different numbers of samples: {lags}; aligned one by one",)
    return Prepared(Measurement(x, y, psd, fit & usable), predicted, usable, active, offset, human, warnings)


def known_span(x: Samples, first_lag: float, last_lag: float) -> tuple[int, int]:
    """(begin, end) samples of a recording (n,) of which the reference x (n,) knows what the robot says.

    first_lag, last_lag: of the recording behind x. What was said before a reference that begins in the middle of a word, and after one
    that ends there, is heard but unknown.
    """
    n, block = x.size, SAMPLE_RATE // 50
    loud = 10 ** (CUT_DB / 10) * float(np.max(np.add.reduceat(x.astype(np.float64) ** 2, np.arange(0, n, block)) / block))
    said = np.flatnonzero(x)
    stop = int(said[-1]) + 1 if said.size else 0
    begins, ends = (float(np.mean(x[part].astype(np.float64) ** 2)) > loud for part in (slice(0, CUT), slice(max(stop - CUT, 0), max(stop, 1))))
    begin = max(round(first_lag + TAIL_S * SAMPLE_RATE), 0) if begins else 0
    end = min(max(round(stop + last_lag), 0), n) if ends else n
    return min(begin, end), end


def utterance_lags(x: Samples, predicted: Samples, recording: Samples, psd: Samples, offset: float) -> list[tuple[int, int, float]]:
    """(first sample, end, lag) of the stretches of the reference x (n,) that share a lag, the whole with `offset` where it is one.

    predicted: for x without an offset. A player starts each utterance anew, so its lag may be another after a pause of PAUSE_S; a
    difference of less than LAG_STEP is no new start but left for the effects to explain.
    """
    block = SAMPLE_RATE // 50
    level = np.add.reduceat(x.astype(np.float64) ** 2, np.arange(0, x.size, block))
    loud = np.flatnonzero(level > 10**-4.5 * level.max(initial=0.0))
    gaps = np.flatnonzero(np.diff(loud) > 50 * PAUSE_S)
    begins = [0, *(int(loud[gap + 1]) * block for gap in gaps)]
    white, sought = whiten(predicted, psd), whiten(recording, psd)
    pieces: list[tuple[int, int, float]] = []
    for begin, end in zip(begins, [*begins[1:], x.size], strict=True):
        lag = pieces[-1][2] if pieces else offset
        if len(begins) > 1 and end - begin > SAMPLE_RATE // 2:
            inside = (np.arange(x.size) >= begin) & (np.arange(x.size) < end)
            try:
                own = find_offset(white * inside, sought)
            except SignalError:
                own = lag
            lag = own if abs(own - lag) > LAG_STEP else lag
        if pieces and lag == pieces[-1][2]:
            pieces[-1] = (pieces[-1][0], end, lag)
        else:
            pieces.append((begin, end, lag))
    return pieces


def find_talk(power: Samples, active: NDArray[np.bool_]) -> tuple[tuple[float, float], ...]:
    """(start_s, end_s) where somebody talks, from the whitened recording's square (n,) in the robot's silences.

    Somebody talks where tenths of a second are TALK_DB over the fan while at least a third of the silence is at the fan: a fan that
    has changed is louder all the time. What lies between two such moments less than GAP_S apart belongs to them, the robot's words
    included. Nothing is found where it would be more than half of the recording: there is no working around that.
    """
    block = SAMPLE_RATE // 10
    count = power.size // block
    silent = ~active[: count * block].reshape(count, block).any(axis=1)
    level = power[: count * block].reshape(count, block).mean(axis=1)
    loud = silent & (level > 10 ** (TALK_DB / 10))
    if loud.sum() < 3 or np.mean(level[silent] < 2.0) < 1 / 3:
        return ()
    spans: list[list[float]] = []
    for at in np.flatnonzero(loud) / 10:
        if spans and at - spans[-1][1] < GAP_S:
            spans[-1][1] = at + 0.1
        else:
            spans.append([at, at + 0.1])
    kept = [(max(begin - EDGE_S, 0.0), end + EDGE_S) for begin, end in spans if end - begin > 0.25]
    total = sum(end - begin for begin, end in kept)
    return tuple((float(begin), float(end)) for begin, end in kept) if 10 * total < 0.5 * count else ()


def fan_scale(quiet: Samples) -> float:
    """How much louder the fan is than in the calibration, in power, from the whitened recording while the robot is silent, (k,).

    1 where the difference is more than FAN_TOLERANCE_DB either way, and so no ordinary one, or where there is too little silence.
    """
    if quiet.size < SAMPLE_RATE // 2:
        return 1.0
    size = 256
    frames = quiet[: quiet.size // size * size].reshape(-1, size) * np.hanning(size).astype(np.float32)
    power = np.mean(np.abs(fft.rfft(frames)) ** 2, axis=0) / np.sum(np.hanning(size) ** 2)
    scale = float(np.median(power[3:-6]))
    return scale if abs(10 * np.log10(max(scale, 1e-9))) <= FAN_TOLERANCE_DB else 1.0


def expected_noise(profile: Profile) -> Samples:
    """(601,) PSD of the fan with the profile's own effects on it."""
    psd = profile.noise_psd
    for name, values in profile.echo.effects:
        changed = getattr(find(name), "noise_psd", None)
        psd = changed(complete(find(name), values), psd) if changed else psd
    return psd


def shift(x: Samples, samples: float) -> Samples:
    """x (n,) later by that many samples, which may be negative or fractional; what leaves either end is lost, silence comes in."""
    n = fft.next_fast_len(x.size + int(abs(samples)) + 256, real=True)
    ramp = np.exp(-2j * np.pi * np.arange(n // 2 + 1) / n * samples)
    return fft.irfft(fft.rfft(x.astype(np.float64), n) * ramp, n)[: x.size].astype(np.float32)


def starting_offset(predicted: Samples, recording: Samples) -> float:
    """Samples by which recording (n,) lags behind predicted (n,) at its beginning, both whitened.

    Over the whole of it where the lag is constant; where it moves (drift, jumps, a changed path), over the first seconds in which it
    holds still, so that what happens later is left in the residual. Raises SignalError where no lag stands out.
    """
    whole = find_offset(predicted, recording)
    windows = lag_track(predicted, recording, whole)
    clear = [window for window in windows if window.likeness > 0.5 * max(w.likeness for w in windows)]
    if len(clear) < 4:
        return whole
    lags = np.array([window.lag for window in clear])
    first = float(np.median(lags[:3]))
    middle = float(np.median(lags))
    if np.quantile(np.abs(lags - middle), 0.8) < 0.06 and abs(first - middle) < 0.06:
        return whole
    stop = next((window.stop for window, lag in zip(clear, lags, strict=True) if abs(lag - first) > 0.3), clear[-1].stop)
    stop = max(min(stop - TRACK // 2, clear[0].start + 4 * TRACK), clear[0].start + TRACK)
    part = slice(max(clear[0].start - TRACK // 2, 0), stop)
    moved = shift(predicted, first)
    return first + refine_lag(moved[part], recording[part], 0.0)


@dataclass(frozen=True, slots=True)
class LagWindow:
    """One window of a lag track: samples start to stop, lag in samples, likeness (correlation coefficient) at that lag."""

    start: int
    stop: int
    lag: float
    likeness: float


def lag_track(predicted: Samples, recording: Samples, around: float) -> list[LagWindow]:
    """The lag of recording behind predicted (n,), both whitened, in windows of TRACK samples, up to TRACK_REACH samples from `around`.

    Windows in which the prediction does not stand out of the fan are left out.
    """
    moved = shift(predicted, around)
    size = fft.next_fast_len(TRACK + 2 * TRACK_REACH, real=True)
    found = []
    for start in range(0, recording.size - TRACK + 1, TRACK // 2):
        wide = moved[max(start - TRACK_REACH, 0) : start + TRACK + TRACK_REACH]
        skipped = start - max(start - TRACK_REACH, 0)
        a, b = wide, recording[start : start + TRACK]
        energy = float(np.dot(moved[start : start + TRACK], moved[start : start + TRACK]))
        if energy < TRACK:
            continue
        correlation = fft.irfft(flat_cross(a, np.pad(b, (skipped, 0)), size), size)
        near = np.take(correlation, np.arange(-TRACK_REACH, TRACK_REACH + 1), mode="wrap")
        lag = int(np.argmax(near)) - TRACK_REACH
        there = moved[max(start - lag, 0) : start - lag + TRACK]
        likeness = float(np.dot(there, b[: there.size])) / np.sqrt(float(np.dot(there, there)) * float(np.dot(b, b)) + 1e-12)
        if likeness > 0.0:
            fine = refine_lag(a, np.pad(b, (skipped, a.size - skipped - b.size)), float(lag))
            found.append(LagWindow(start, start + TRACK, around + fine, likeness))
    return found


def find_offset(predicted: Samples, recording: Samples) -> float:
    """Samples, to a few thousandths, by which recording (n,) lags behind predicted (n,): the highest peak of their correlation.

    Raises SignalError where no lag stands out.
    """
    n = fft.next_fast_len(2 * recording.size, real=True)
    cross = flat_cross(predicted, recording, n)
    correlation = fft.irfft(cross, n)
    reach = min(int(MAX_OFFSET * SAMPLE_RATE), recording.size - 1)
    near = np.concatenate((correlation[-reach:], correlation[: reach + 1]))
    peak = int(np.argmax(near))
    if near[peak] < 12.0 * np.sqrt(np.mean(near**2)):
        raise SignalError("the recording does not contain the reference at any lag up to 3 s: are both of the same utterance?")
    return _climb(cross, n, float(peak - reach))


def flat_cross(predicted: Samples, recording: Samples, n: int) -> NDArray[np.complex128]:
    """(n // 2 + 1,) cross-spectrum Y P* / (|P|^2 + N) of two whitened signals: flat where the voice stands out of the fan, nothing else.

    The maximum-likelihood weighting of Knapp & Carter (1976) for an error in proportion to the voice; |P|^2 is smoothed over 50 Hz.
    """
    source = fft.rfft(predicted.astype(np.float64), n)
    power = uniform_filter1d(np.abs(source) ** 2, max(int(50 * n / SAMPLE_RATE), 1), mode="nearest")
    return fft.rfft(recording.astype(np.float64), n) * source.conj() / (power + recording.size)


def refine_lag(predicted: Samples, recording: Samples, lag: float) -> float:
    """The fractional lag near `lag` at which predicted (n,) correlates best with recording (n,)."""
    n = fft.next_fast_len(2 * recording.size, real=True)
    return _climb(flat_cross(predicted, recording, n), n, lag)


def _climb(cross: NDArray[np.complex128], n: int, lag: float) -> float:
    """From `lag` to the top of the correlation whose cross-spectrum this is, of n samples: Newton steps."""
    frequencies = 2 * np.pi * np.arange(cross.size) / n
    for _ in range(8):
        turned = cross * np.exp(1j * frequencies * lag)
        slope, bend = -np.sum(frequencies * turned.imag), -np.sum(frequencies**2 * turned.real)
        if bend >= 0.0:
            break
        step = float(np.clip(-slope / bend, -0.5, 0.5))
        lag += step
        if abs(step) < 1e-4:
            break
    return lag
