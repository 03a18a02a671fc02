"""What is measured of one system on one recording of a real device, or on one human laid on it: plain figures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from bench.measure.real_barge_in import THRESHOLDS, first_sound, in_time, noticed, replay, starts
from bench.measure.real_streams import ECHO_ONLY, Laid, Recording, Signals
from bench.measure.real_systems import Absent, Heard, listen
from bench.measure.recogniser import Recogniser, word_errors
from edgefilter.dsp.metrics import erle, si_sdr
from edgefilter.types import SAMPLE_RATE, Samples

TALK_TYPES = {"doubletalk": "dt", "farend": "st", "nearend": "nst"}
"""AECMOS's names for who talks, by the recordings' own."""
ALONE_S = 3.0
"""Robot alone just before the human, over which a laid case's ERLE is taken: in the human's span nobody can tell what
of a nonlinear filter's output is echo."""
WINDOW_S, STEP_S = 1.0, 0.1
"""The output may not be louder than the microphone over any such window."""
LOUD_DB = 25.0
"""A second counts as the robot's talking within so much of the loudest."""
FLOOR = 1e-10
"""-100 dB of full scale, added to powers: below it no difference is heard, and digital silence has no ratio."""


@dataclass(frozen=True)
class Recognition:
    """Where Whisper lies and where its transcripts are kept."""

    folder: Path
    cache: Path


def score(system: str, stream: Recording | Laid, recognition: Recognition | None) -> dict:
    """All figures of a system on a stream; {"absent": why} where it cannot run on this machine."""
    signals = stream.signals()
    try:
        heard = listen(system, signals.mic, signals.ref)
    except Absent as error:
        return {"absent": str(error)}
    row = {
        "name": stream.name,
        "seconds": signals.mic.size / SAMPLE_RATE,
        "excess_db": excess_db(heard.out, signals.mic),
    }
    if isinstance(stream, Laid):
        return row | _laid(stream, signals, heard, recognition)
    if stream.kind == ECHO_ONLY:
        row |= {"part": "alone", "erle_db": erle_by_second(signals.mic, heard.out)}
        return row if heard.events is None else row | _false_starts(heard)
    return row | {"part": "pairs", "kind": stream.kind, **_pair(stream.kind, signals, heard.out)}


def _laid(stream: Laid, signals: Signals, heard: Heard, recognition: Recognition | None) -> dict:
    span, alone = signals.span, slice(max(signals.span.start - round(ALONE_S * SAMPLE_RATE), 0), signals.span.start)
    out, mic, human = heard.out[span], signals.mic[span], signals.human[span]
    row: dict = {
        "part": "laid",
        "case": stream.case,
        "ser": stream.ser,
        "before": stream.before,
        "fan": stream.noise is not None,
    }
    row |= {"si_sdr": si_sdr(out, human), "si_sdr_mic": si_sdr(mic, human), "level_db": level_db(out, mic)}
    row["erle_db"] = erle(signals.mic[alone], heard.out[alone]) if stream.before else None
    if heard.events is not None:
        onset = first_sound(signals.human)
        curve = [in_time(noticed(replay(heard.probability, heard.hop, at), onset)) for at in THRESHOLDS]
        row |= {**noticed(heard.events, onset), "curve": curve}
    if recognition:
        row["wer_capped"] = word_errors(stream.text, _recogniser(recognition).transcribe(out)).capped
    return row


def _false_starts(heard: Heard) -> dict:
    """Nobody speaks: every beginning is false, of the events and at each of THRESHOLDS."""
    curve = [starts(replay(heard.probability, heard.hop, at)) for at in THRESHOLDS]
    return {"false_starts": starts(heard.events), "curve": curve}


def _pair(kind: str, signals: Signals, out: Samples) -> dict:
    """AECMOS where its package is there, None where not; farend also ERLE, nearend SI-SDR against the microphone."""
    mos = aecmos()
    found: dict = {"echo_mos": None, "human_mos": None}
    if mos:
        mic, ref, filtered = (np.clip(x, -1, 1) for x in (signals.mic, signals.ref, out))
        said = mos({"lpb": ref, "mic": mic, "enh": filtered}, TALK_TYPES[kind])
        found = {"echo_mos": said["echo_mos"], "human_mos": said["deg_mos"]}
    if kind == "farend":
        found["erle_db"] = erle(signals.mic, out)
    if kind == "nearend":
        found["si_sdr"] = si_sdr(out, signals.mic)
    return found


@lru_cache(maxsize=1)
def aecmos() -> object:
    """The judge of echo and human, 1 to 5 (Purin et al. 2022, "AECMOS"), at 16 kHz; None where it is not installed."""
    try:
        from speechmos.aecmos import AECMOS
    except ImportError:
        return None
    return AECMOS("aecmos_16kHz")


@lru_cache(maxsize=1)
def _recogniser(recognition: Recognition) -> Recogniser:
    return Recogniser(recognition.folder, recognition.cache)


def level_db(out: Samples, mic: Samples) -> float:
    """Level of out over that of mic, both (n,), dB."""
    after, before = (float(np.mean(x.astype(np.float64) ** 2)) + FLOOR for x in (out, mic))
    return 10 * np.log10(after / before)


def excess_db(out: Samples, mic: Samples) -> float:
    """The most by which out is louder than mic, both (n,), over any WINDOW_S seconds at steps of STEP_S, dB."""
    after, before = (_windows(x) for x in (out, mic))
    return float(np.max(10 * np.log10((after + FLOOR) / (before + FLOOR))))


def _windows(x: Samples) -> np.ndarray:
    """Mean power of each window; of all samples where they are fewer than one."""
    window, step = min(round(WINDOW_S * SAMPLE_RATE), x.size), round(STEP_S * SAMPLE_RATE)
    sums = np.cumsum(np.append(0.0, x.astype(np.float64) ** 2))
    starts = np.arange(0, x.size - window + 1, step)
    return (sums[starts + window] - sums[starts]) / window


def erle_by_second(mic: Samples, out: Samples) -> list[float | None]:
    """ERLE of each whole second, dB; None where the robot does not talk."""
    seconds = mic.size // SAMPLE_RATE
    before, after = (
        np.mean(x[: seconds * SAMPLE_RATE].reshape(seconds, -1).astype(np.float64) ** 2, axis=1) for x in (mic, out)
    )
    talks = before > 10 ** (-LOUD_DB / 10) * before.max(initial=0.0)
    return [
        float(10 * np.log10((b + FLOOR) / (a + FLOOR))) if loud else None
        for b, a, loud in zip(before, after, talks, strict=True)
    ]
