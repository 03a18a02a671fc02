"""Bring a recording of the robot alone into a state in which a prediction can be held against it: lag, silence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from edgefilter.alignment.belief import LEADS, Belief, believe, find_lag
from edgefilter.calibration.from_recording import TAIL_S
from edgefilter.diagnosis.straightened import FRAME, Straightened
from edgefilter.dsp.fourier import power
from edgefilter.dsp.fractional_delay import delayed
from edgefilter.dsp.frames import all_block_power, blocks, decibels
from edgefilter.dsp.lag import correlation_near, highest, likely_cross, top
from edgefilter.dsp.psd import floored, hann
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.lag_track import track_lag
from edgefilter.echo.measurement import STEADY_DB, Measurement, whiten
from edgefilter.echo.recording import fitted_blocks, paired
from edgefilter.profile.data import Profile
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

TRACK_REACH = 1600
"""Samples (0.1 s) by which the lag may move away from that of the whole recording and still be followed."""
SILENCE_DB = -15.0
"""The robot is silent where its predicted voice, whitened, is this far under the fan, and adds 3 % to its power."""
TALK_DB = 8.0
"""Over the fan, somebody talks: more than a reverberation tail in a pause, less than a soft voice at two metres."""
GAP_S, EDGE_S = 1.0, 0.2
"""Pauses of a talker, between two sentences, that count as talk, and what is left out before and after talk. By hand."""
ORDINARY = 2.0
"""Distortion of up to so many times the calibrated power is ordinary: with speech it was up to 3.4 dB off what multisines had shown."""
CUT, CUT_DB = 32, -30.0
"""A reference begins or ends in the middle of a word where so many samples (2 ms) at its end are no further below its
loudest 20 ms: pauses are softer."""
PAUSE_S, LAG_STEP = 0.5, 480
"""Silence of the reference after which a player may have started anew, and samples (30 ms) by which the lag must differ
then: less is left for the effects to explain."""


def prepare(profile: Profile, recording: Samples, reference: Samples) -> Straightened:
    """Find the constant lag, mark the robot's silence and the blocks that fits may use.

    recording (m,), reference (k,): float, full scale +-1, at 16 kHz. Raises SignalError for less than a second or
    where the recording does not contain the reference.
    """
    y, x = paired(recording, reference)
    n, start = y.size, profile.delay - PRE_ROLL
    model = profile.echo.during(Measurement(x, y))
    predicted = model.predict(delayed(x, start))
    known = floored(model.expected_noise(profile.noise_psd)).astype(np.float32)
    white_y = whiten(y, known)
    white = whiten(predicted, known)
    believed = believe(white_y, white)
    later = round(profile.delay)  # of the recording behind the reference than behind what is predicted
    lag = find_lag(y, x, replace(believed, lags=believed.lags + later)) - later
    offset = starting_offset(white, white_y, lag)
    if model.timed:  # a clock that drifts has drifted further, or less, by the time that the offset takes
        offset += starting_offset(whiten(model.predict(delayed(x, start + offset)), known), white_y, 0)
    pieces = utterance_lags(x, white, white_y, believed, offset)
    begin, end = known_span(x, start + pieces[0][2], start + pieces[-1][2])
    shifted = (
        delayed(np.where((np.arange(n) >= first) & (np.arange(n) < last), x, np.float32(0)), start + lag)
        for first, last, lag in pieces
    )
    x = sum(shifted, np.zeros(n, np.float32))
    predicted = model.predict(x)
    block = SAMPLE_RATE // 50
    level = all_block_power(whiten(predicted, known), block)
    active = np.repeat(maximum_filter1d(level, 11) > 10 ** (SILENCE_DB / 10), block)[:n]
    scale = np.float32(fan_scale(white_y[~active]))
    psd, calibrated = known * scale, floored(profile.noise_psd).astype(np.float32) * scale
    human = find_talk(white_y**2 * (known[1] / psd[1]), active)
    usable = np.ones(n, bool)
    for first, last in human:
        usable[round(first * SAMPLE_RATE) : round(last * SAMPLE_RATE)] = False
    warnings = tuple(f"somebody talks at {first:.1f} to {last:.1f} s: left out" for first, last in human)
    if n // 2 < end - begin < n:
        usable[:begin], usable[end:] = False, False
        warnings += (
            f"the reference is cut in mid-word: only {begin / SAMPLE_RATE:.1f} to {end / SAMPLE_RATE:.1f} s are evaluated",
        )
    warnings += tuple(filter(None, (leads(profile.delay + offset), believed.missing)))
    if len(pieces) > 1:
        lags = ", ".join(f"{lag:.1f} from {first / SAMPLE_RATE:.1f} s" for first, _, lag in pieces)
        warnings += (f"the utterances lag by different numbers of samples: {lags}; aligned one by one",)
    measurement = Measurement(x, y, psd, fitted_blocks(n) & usable, calibrated)
    ordinary = ordinary_distortion(profile, predicted)
    return Straightened(measurement, model, predicted, usable, active, offset, human, warnings, ordinary)


def leads(lag: float) -> str:
    """What to ask where the recording lags by so many samples, below zero, behind the reference; nothing where it may."""
    if lag >= -LEADS:
        return ""
    ms = -1000.0 * lag / SAMPLE_RATE
    return (
        f"the recording has the robot {ms:.0f} ms before the reference: did the recording of the reference begin later?"
    )


def ordinary_distortion(profile: Profile, predicted: Samples) -> tuple[tuple[Samples, Array], ...]:
    """Expected square (n,) and density (601,) of what the calibrated loudspeaker adds to a predicted voice (n,).

    Nothing where the calibration does not know it, or where the profile predicts its waveform, with numbers that the
    filter learns.
    """
    known = profile.approximation
    if known is None or any(find(name).learned for name, _ in profile.echo.effects):
        return ()
    voice = uniform_filter1d(np.square(predicted, dtype=np.float64), FRAME, mode="constant")
    return (((ORDINARY * known.expected(voice)).astype(np.float32), known.colour),)


def starting_offset(predicted: Samples, recording: Samples, lag: int) -> float:
    """Samples by which recording (n,) lags behind predicted (n,) at its beginning, both whitened. lag: the one that is believed.

    Over the whole of it where the lag is constant; where it moves by more than 0.3 samples (drift, jumps, a changed path),
    over the first seconds in which it holds still, so that what happens later is left in the residual. Where several
    reflections are about as loud it only seems to move, and these seconds speak for the lag of the whole.
    """
    whole, window, moves = finely(predicted, recording, lag), SAMPLE_RATE, 0.3
    track = track_lag(delayed(predicted, whole), recording, None, window, TRACK_REACH)
    clear = track.correlation > 0.5 * track.correlation.max(initial=0.0)
    if np.count_nonzero(clear) < 4:
        return whole
    starts, lags = track.starts[clear], whole + track.lag[clear]
    first, middle = float(np.median(lags[:3])), float(np.median(lags))
    spread = float(np.quantile(np.abs(lags - middle), 0.8))
    if spread < 0.06 and abs(first - middle) < 0.06:
        return whole
    moved = np.flatnonzero(np.abs(lags - first) > moves)
    stop = int(starts[moved[0] if moved.size else -1]) + window
    stop = max(min(stop - window // 2, int(starts[0]) + 4 * window), int(starts[0]) + window)
    still = slice(max(int(starts[0]) - window // 2, 0), stop)
    size = still.stop - still.start
    n, away = fft.next_fast_len(2 * size, real=True), whole - first
    cross = likely_cross(delayed(predicted, first)[still], recording[still], n)
    highest_at, _ = highest(correlation_near(cross, n, min(int(abs(away)) + 2, size - 1)))
    return first + top(cross, n, away if spread > moves and abs(highest_at - away) < 2 else 0.0)


def finely(predicted: Samples, recording: Samples, lag: int) -> float:
    """A lag of recording (n,) behind predicted (n,), near the one that is believed, to a few thousandths of a sample."""
    n = fft.next_fast_len(2 * recording.size, real=True)
    cross = likely_cross(delayed(predicted, lag), recording, n)
    at, _ = highest(correlation_near(cross, n, min(TRACK_REACH, recording.size - 1)))
    return lag + top(cross, n, at)


def known_span(x: Samples, first_lag: float, last_lag: float) -> tuple[int, int]:
    """First sample and end of the part of a recording (n,) of which the reference x (n,) knows what the robot says.

    first_lag, last_lag: of the recording behind x. What was said before a reference that begins in the middle of a
    word, and after one that ends there, is heard for TAIL_S but unknown.
    """
    n, block = x.size, SAMPLE_RATE // 50
    loud = 10 ** (CUT_DB / 10) * float(np.max(all_block_power(x, block)))
    said = np.flatnonzero(x)
    stop = int(said[-1]) + 1 if said.size else 0
    begins, ends = (
        float(np.mean(x[part].astype(np.float64) ** 2)) > loud
        for part in (slice(0, CUT), slice(max(stop - CUT, 0), max(stop, 1)))
    )
    begin = max(round(first_lag + TAIL_S * SAMPLE_RATE), 0) if begins else 0
    end = min(max(round(stop + last_lag), 0), n) if ends else n
    return min(begin, end), end


def utterance_lags(
    x: Samples, predicted: Samples, recording: Samples, believed: Belief, offset: float
) -> list[tuple[int, int, float]]:
    """First sample, end and lag of the stretches of x (n,) that share a lag; all of it with `offset` where all do.

    predicted: for the reference x without an offset, and recording, both whitened; believed: of these. A player starts each
    utterance anew, so its lag may be another after a pause of PAUSE_S; a difference of less than LAG_STEP is no new start
    but left for the effects to explain.
    """
    block = SAMPLE_RATE // 50
    level = all_block_power(x, block)
    loud = np.flatnonzero(level > 10**-4.5 * level.max(initial=0.0))
    gaps = np.flatnonzero(np.diff(loud) > 50 * PAUSE_S)
    begins = [0, *(int(loud[gap + 1]) * block for gap in gaps)]
    pieces: list[tuple[int, int, float]] = []
    for begin, end in zip(begins, [*begins[1:], x.size], strict=True):
        lag = pieces[-1][2] if pieces else offset
        own = believed.of(begin, end).lag
        if own is not None and abs(own - lag) > LAG_STEP:
            lag = finely(predicted * ((np.arange(x.size) >= begin) & (np.arange(x.size) < end)), recording, own)
        if pieces and lag == pieces[-1][2]:
            pieces[-1] = (pieces[-1][0], end, lag)
        else:
            pieces.append((begin, end, lag))
    return pieces


def find_talk(square: Samples, active: NDArray[np.bool_]) -> tuple[tuple[float, float], ...]:
    """Stretches (start_s, end_s) where somebody talks in the robot's silences, from the whitened recording's square (n,).

    Somebody talks where tenths of a second are TALK_DB over the fan while at least a third of the silence is at the
    fan: a fan that has changed is louder all the time. What lies between two such moments less than GAP_S apart belongs
    to them, the robot's words included. Nothing is found where it would be more than half of the recording: there is no
    working around that.
    """
    block = SAMPLE_RATE // 10
    silent = ~blocks(active, block).any(axis=1)
    level = blocks(square, block).mean(axis=1)
    loud = silent & (level > 10 ** (TALK_DB / 10))
    if loud.sum() < 3 or np.mean(level[silent] < 2.0) < 1 / 3:
        return ()
    spans: list[list[float]] = []
    for at in np.flatnonzero(loud) / 10:
        if spans and at - spans[-1][1] < GAP_S:
            spans[-1][1] = at + 0.1
        else:
            spans.append([at, at + 0.1])
    kept = [(float(max(begin - EDGE_S, 0.0)), float(end + EDGE_S)) for begin, end in spans if end - begin > 0.25]
    return tuple(kept) if 10 * sum(end - begin for begin, end in kept) < 0.5 * level.size else ()


def fan_scale(quiet: Samples) -> float:
    """How much louder the fan is than in the calibration, in power, from the whitened recording's silences, (k,).

    1 where the difference is no ordinary one (STEADY_DB), or where there is too little silence.
    """
    if quiet.size < SAMPLE_RATE // 2:
        return 1.0
    window = hann(256)
    spectrum = np.mean(power(fft.rfft(blocks(quiet, 256) * window)), axis=0) / np.sum(window**2)
    scale = float(np.median(spectrum[3:-6]))
    return scale if abs(decibels(scale)) <= STEADY_DB else 1.0
