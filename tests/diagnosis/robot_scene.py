"""A small robot for tests of comparison and diagnosis: its profile, its voice with pauses, and recordings of it."""

from __future__ import annotations

import numpy as np
from scipy import signal

from edgefilter.dsp.fractional_delay import delayed
from edgefilter.echo.model import EchoModel
from edgefilter.profile.data import Profile
from edgefilter.types import PRE_ROLL

RESONANCE = {"frequency_hz": 640.0, "q": 35.0, "gain_db": -2.0}
FAN = 1e-3
DELAY = 400.0


def path(seed: int = 1) -> np.ndarray:
    """(6400,) direct sound and a room of 0.2 s reverberation time, 20 dB below it."""
    rng = np.random.default_rng(seed)
    h = np.zeros(6400)
    h[PRE_ROLL] = 0.5
    tail = np.arange(6400 - PRE_ROLL - 60)
    h[PRE_ROLL + 60 :] = 0.01 * rng.standard_normal(tail.size) * np.exp(-6.9 * tail / (0.2 * 16000))
    return h.astype(np.float32)


def livelier() -> np.ndarray:
    """(6400,) that path in a room of 0.6 s."""
    h = path()
    tail = np.arange(6200)
    h[200:] += 0.02 * np.random.default_rng(5).standard_normal(tail.size) * np.exp(-6.9 * tail / (0.6 * 16000))
    return h


def profile(h: np.ndarray | None = None) -> Profile:
    """The robot with that path and a white fan."""
    bands = np.array([[900.0, 1100.0]])
    psd = np.full(601, FAN**2 / 8000, np.float32)
    return Profile(
        EchoModel(path() if h is None else h),
        DELAY,
        np.ones(601, np.float32),
        psd,
        bands,
        np.array([40.0]),
        np.full(4, -60.0),
    )


def office() -> EchoModel:
    """The robot in a room of 0.5 s, its reverberation 12 dB below the direct sound."""
    rng, taps = np.random.default_rng(5), np.zeros(8000)
    late = np.arange(8000 - 200)
    taps[200:] = rng.standard_normal(late.size) * 10 ** (-3 * late / 8000)
    return EchoModel(path()).with_effect("late_reverb", {"taps": taps * 0.25 / np.linalg.norm(taps)})


def voice(seconds: float = 8.0, seed: int = 0) -> np.ndarray:
    """(n,) noise with the spectrum and the syllables of speech, a pause of 0.5 s every 2 s, peak about 0.5."""
    rng = np.random.default_rng(seed)
    n = round(seconds * 16000)
    t = np.arange(n) / 16000
    coloured = signal.lfilter([1.0], [1.0, -0.9], rng.standard_normal(n))
    syllables = np.clip(
        np.interp(t, knots := np.arange(0, seconds + 1, 0.12), rng.uniform(-0.3, 1.0, knots.size)), 0.0, None
    )
    return (0.06 * coloured * syllables * (t % 2.0 < 1.5)).astype(np.float32)


def record(x: np.ndarray, model: EchoModel | None = None, lag: float = 0.0, seed: int = 3) -> np.ndarray:
    """(n,) what the microphone hears of x through model (default: the calibrated path), lag samples later than in the calibration."""
    model = EchoModel(path()) if model is None else model
    clean = model.predict(delayed(x, DELAY - PRE_ROLL + lag))
    return clean + (FAN * np.random.default_rng(seed).standard_normal(x.size)).astype(np.float32)


def feedback(x: np.ndarray, ratio: float, threshold_db: float) -> np.ndarray:
    """A compressor that hears its own output, in steps of 2 ms, 5 ms to come and 100 ms to go."""
    out, gain_db = np.zeros_like(x), 0.0
    for at in range(0, x.size, 32):
        out[at : at + 32] = x[at : at + 32] * 10 ** (gain_db / 20)
        over = 10 * np.log10(np.mean(out[at : at + 32] ** 2) + 1e-12) - threshold_db
        wanted = min(-(ratio - 1.0) * over, 0.0)
        gain_db += (wanted - gain_db) * (0.15 if wanted < gain_db else 0.02)
    return out


def loud_frames(x: np.ndarray, length: int, count: int) -> np.ndarray:
    """(count,) frames of that length, all in loud parts of the voice, no two of them neighbours."""
    power = np.mean(x[: x.size // length * length].reshape(-1, length) ** 2, axis=1)
    candidates = np.flatnonzero(power > 0.3 * power.mean())[2::3]
    return np.sort(np.random.default_rng(5).permutation(candidates)[:count])


def lossy(x: np.ndarray, length: int, fill: float, count: int = 14) -> np.ndarray:
    out = x.copy()
    for frame in loud_frames(x, length, count):
        at = frame * length
        out[at : at + length] = fill * out[at - length : at]
    return out


def coded(x: np.ndarray, step_db: float = -12.0) -> np.ndarray:
    """A transform codec: in frames of 20 ms each band is rounded to steps of a part of its own level."""
    window, out = np.sin(np.pi * (np.arange(640) + 0.5) / 640), np.zeros(x.size + 640)
    for at in range(0, x.size - 640, 320):
        spectrum = np.fft.rfft(window * x[at : at + 640])
        bands = np.array_split(spectrum, 16)
        steps = [np.sqrt(12 * np.mean(np.abs(band) ** 2) * 10 ** (step_db / 10)) + 1e-12 for band in bands]
        rounded = [
            step * (np.round(band.real / step) + 1j * np.round(band.imag / step)) for band, step in zip(bands, steps)
        ]
        out[at : at + 640] += window * np.fft.irfft(np.concatenate(rounded))
    return out[: x.size].astype(np.float32)
