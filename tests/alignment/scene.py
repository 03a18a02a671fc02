"""Scenes with a known truth for evaluating alignment.

Speech-like sounds, rooms, drifting clocks, dropped buffers, a fan, a human.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from edgefilter.echo.model import EchoModel
from edgefilter.types import PRE_ROLL

RATE = 16000
HEAD = 16
"""Samples before the direct sound in `room`."""


@dataclass
class KnownArray:
    """Paths (microphones - 1, n) of the further microphones."""

    responses: np.ndarray


@dataclass
class KnownPath:
    """Stands for a profile: only the echo paths are read by the aligner."""

    echo: EchoModel
    array: KnownArray | None = None

    def running_responses(self) -> np.ndarray:
        """(microphones, taps)."""
        return np.stack([self.echo.running_response(), *(self.array.responses if self.array else ())])


def speech_like(rng: np.random.Generator, seconds: float) -> np.ndarray:
    """Voiced and unvoiced syllables at 4 a second, peak about 0.3, (n,) float32."""
    n = int(seconds * RATE)
    out = np.zeros(n + RATE)
    at = 0
    while at < n:
        size = int(rng.uniform(0.12, 0.3) * RATE)
        pitch = rng.uniform(90, 220)
        pulses = signal.sawtooth(
            2 * np.pi * np.cumsum(np.full(size, pitch) * (1 + 0.05 * np.sin(np.arange(size) / 900))) / RATE
        )
        noise = rng.standard_normal(size)
        source = pulses * rng.uniform(0.3, 1) + noise * rng.uniform(0.1, 0.6)
        for centre in (rng.uniform(300, 800), rng.uniform(1000, 2400), rng.uniform(2500, 4500)):
            b, a = signal.iirpeak(centre, 4.0, RATE)
            source = source + 2 * signal.lfilter(b, a, source)
        out[at : at + size] += source * np.hanning(size) * rng.uniform(0.4, 1)
        at += int(size * rng.uniform(0.7, 1.1))
    out = out[:n]
    return (0.3 * out / np.abs(out).max()).astype(np.float32)


def room(rng: np.random.Generator, rt60: float, body: np.ndarray | None = None, direct_db: float = 3.0) -> np.ndarray:
    """Impulse response (n,): a body (the same everywhere) and a diffuse tail, direct_db under it."""
    n = int(rt60 * RATE)
    h = np.zeros(HEAD + n)
    body = robot_body(np.random.default_rng(7)) if body is None else body
    h[HEAD : HEAD + body.size] += body
    tail = rng.standard_normal(n) * 10 ** (-3 * np.arange(n) / n)
    tail[:60] = 0.0
    h[HEAD:] += tail * np.sqrt(np.sum(body**2) / np.sum(tail**2) * 10 ** (-direct_db / 10))
    return 0.4 * h


def robot_body(rng: np.random.Generator) -> np.ndarray:
    """Direct sound and its first 3 ms of shell reflections, (48,)."""
    return np.concatenate(([1.0], 0.15 * rng.standard_normal(47) * np.exp(-np.arange(47) / 12)))


def known_path(*paths: np.ndarray) -> KnownPath:
    """A profile's view of the microphones' impulse responses made by `room`."""
    first, *further = (np.pad(h, (PRE_ROLL - HEAD, 0)).astype(np.float32) for h in paths)
    return KnownPath(EchoModel(first), KnownArray(np.array(further)) if further else None)


def hear(
    ref: np.ndarray, lags: list[tuple[int, float]], h: np.ndarray, ppm: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Microphone (n,) float32 and the true total delay at each of its samples (n,).

    lags: (position in ref, lag) from which on each lag holds; the delay shrinks by ppm.
    """
    heard = np.zeros(ref.size)
    truth = np.full(ref.size, np.nan)
    t = np.arange(ref.size)
    for i, (start, lag) in enumerate(lags):
        stop = lags[i + 1][0] if i + 1 < len(lags) else ref.size
        part = np.zeros(ref.size)
        part[start:stop] = ref[start:stop]
        fine = signal.resample_poly(signal.oaconvolve(part, h)[: ref.size], 8, 1)
        delay = lag - ppm * 1e-6 * t
        heard += np.interp((t - delay) * 8, np.arange(fine.size), fine, left=0.0, right=0.0)
        truth[max(int(start + lag), 0) :] = (delay + HEAD)[max(int(start + lag), 0) :]
    return heard.astype(np.float32), truth


def at_another_clock(x: np.ndarray, ppm: int) -> np.ndarray:
    """The same sound, (n,) float32, on a clock that is slower by ppm: exact, of at most 62 s."""
    return signal.resample(np.pad(x, (0, 10**6 + ppm - x.size)), 10**6)[: x.size].astype(np.float32)


def fan(rng: np.random.Generator, n: int, level: float = 0.002) -> np.ndarray:
    """Low-pass noise of rms level, (n,) float32."""
    x = signal.lfilter([1.0], [1.0, -0.9], rng.standard_normal(n))
    return (level * x / np.std(x)).astype(np.float32)


def utterances(rng: np.random.Generator, seconds: list[float], pauses: list[float]) -> tuple[np.ndarray, list[int]]:
    """Speech-like utterances, each followed by its pause; reference (n,) and their onsets."""
    parts, onsets, at = [np.zeros(RATE // 4, np.float32)], [], RATE // 4
    for length, pause in zip(seconds, pauses, strict=True):
        onsets.append(at)
        parts += [speech_like(rng, length), np.zeros(int(pause * RATE), np.float32)]
        at += parts[-1].size + parts[-2].size
    return np.concatenate(parts), onsets


@dataclass
class DoubleTalk:
    """A robot that a human talks over from the first sample on.

    Reference and microphone (n,), the true delay at each sample of the microphone (n,), ppm, and from where to where
    (samples of the microphone) each utterance is heard.
    """

    ref: np.ndarray
    mic: np.ndarray
    truth: np.ndarray
    ppm: float
    heard: list[tuple[int, int]]


def double_talk(
    rng: np.random.Generator, voices: list[np.ndarray], human: np.ndarray, level_db: float, ppm: float
) -> DoubleTalk:
    """The utterances in turn, each with a lag of its own, 2 s apart.

    The echo is level_db over the human while both are heard.

    human: (n,), as long as all of it or longer.
    """
    parts, starts, at = [np.zeros(RATE // 2, np.float32)], [], RATE // 2
    for voice in voices:
        starts.append(at + int(np.argmax(np.abs(voice) > 0.02 * np.abs(voice).max())))
        parts += [voice, np.zeros(2 * RATE, np.float32)]
        at += voice.size + 2 * RATE
    ref = np.concatenate(parts).astype(np.float32)
    lags = rng.uniform(0, 1.4 * RATE, len(voices)).round()
    echo, truth = hear(
        ref,
        [(max(s - 2000, 0), lag) for s, lag in zip(starts, lags, strict=True)],
        room(rng, rng.uniform(0.2, 0.75)),
        ppm,
    )
    ends = [start + voice.size for start, voice in zip(starts, voices, strict=True)]
    heard = [(int(s + lag) + HEAD, int(min(e + lag, ref.size))) for s, e, lag in zip(starts, ends, lags, strict=True)]
    active = np.concatenate([np.arange(*span) for span in heard])
    human = (
        human[: ref.size]
        * np.sqrt(np.mean(echo[active] ** 2) / np.mean(human[: ref.size][active] ** 2))
        * 10 ** (-level_db / 20)
    )
    mic = echo + human + fan(rng, ref.size, 0.03 * np.std(echo))
    return DoubleTalk(ref, mic.astype(np.float32), truth, ppm, heard)


def run(aligner, mic: np.ndarray, ref: np.ndarray) -> list:
    """Every hop's Aligned; mic: (n,), or (microphones, n)."""
    hop = aligner.hop
    return [
        aligner.step(mic[..., at : at + hop], ref[at : at + hop])
        for at in range(0, min(mic.shape[-1], ref.size) - hop + 1, hop)
    ]
