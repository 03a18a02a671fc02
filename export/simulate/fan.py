"""What else the microphone hears: the robot's fan, steady or changing its speed, recorded noises, people in the background, knocks."""

from __future__ import annotations

import math

import numpy as np
from scipy import signal
from scipy.ndimage import maximum_filter1d

from edgefilter.dsp.stft import StftConfig
from edgefilter.profile.data import GRID_BINS, GRID_HZ
from edgefilter.types import SAMPLE_RATE, Samples
from export.simulate.loudspeaker import active_rms
from export.simulate.material import Material

WHINE = 0.5
"""Share of the moving robots whose gears whine, as voices do in harmonics of a pitch that goes up and down."""
CHANGING, RECORDED, BACKGROUND, TALKERS = 0.2, 0.3, 0.2, 0.4
"""Shares of wide items whose fan changes its speed, whose fan is a recording, with something sounding in the background
besides, and, of the last, those in which that is people."""
KNOCKS, KNOCK_S, KNOCK_DB = 4, (0.03, 0.4), (-10.0, 5.0)
"""Most knocks in an item, the seconds that one lasts (a key to a cough), and its dB over the human."""


def noise(
    rng: np.random.Generator, material: Material, samples: int, rms: float, human_rms: float, wideness: float
) -> tuple[Samples, Samples]:
    """Noise with a fan of that RMS, (n,), and the fan's one-sided PSD (601,) on GRID_HZ as a calibration would find it."""
    sound, psd = fan(rng, samples, rms)
    changing, recorded, background, talkers = rng.random(4)
    if recorded < wideness * RECORDED and material.noises:
        sound = material.noise(rng, samples)
        sound = rms / max(float(np.sqrt(np.mean(sound**2))), 1e-9) * sound
        psd = _psd(sound)
    if changing < wideness * CHANGING:
        sound = sound * _speed(rng, samples)
    if background < wideness * BACKGROUND:
        added = _people(rng, material, samples) if talkers < TALKERS else material.noise(rng, samples)
        if added is not None:
            sound = sound + human_rms * 10 ** (-rng.uniform(5, 30) / 20) / max(active_rms(added), 1e-9) * added
    return sound.astype(np.float32), psd


def fan(rng: np.random.Generator, samples: int, rms: float) -> tuple[Samples, Samples]:
    """Fan noise (n,) of that RMS and its PSD."""
    taps = signal.firwin2(1023, np.linspace(0, 1, GRID_BINS), amplitude(rng))
    white = rng.standard_normal(samples + taps.size - 1)
    sound = signal.oaconvolve(white, taps, mode="valid")
    scale = rms / math.sqrt(np.mean(sound**2))
    response = np.abs(np.fft.rfft(taps, 2 * (GRID_BINS - 1)))[:GRID_BINS]
    return (scale * sound).astype(np.float32), (2 / SAMPLE_RATE * (scale * response) ** 2).astype(np.float32)


def amplitude(rng: np.random.Generator) -> Samples:
    """Amplitude of a fan's spectrum on GRID_HZ, (601,): falling, with bumps and a few blade lines."""
    corner = 10 ** rng.uniform(math.log10(150), math.log10(4000))
    level_db = -10 * rng.uniform(0.6, 1.6) * np.log10(1 + (GRID_HZ / corner) ** 2)
    for centre in 10 ** rng.uniform(math.log10(60), math.log10(6000), size=5):
        level_db += rng.uniform(-4, 7) * np.exp(-0.5 * (np.log2((GRID_HZ + 1) / centre) / rng.uniform(0.15, 0.5)) ** 2)
    blade = rng.uniform(80, 400)
    for line in range(1, int(rng.integers(1, 5))):
        level_db += rng.uniform(0, 10) * np.exp(-0.5 * ((GRID_HZ - line * blade) / 12.0) ** 2)
    return 10 ** (np.maximum(level_db, -45) / 20)


def motors(rng: np.random.Generator, material: Material, played: Samples, rms: float) -> Samples:
    """Noise of servos (n,) that move with the voice played (n,), of that RMS where they are loudest; no reference holds it."""
    sound = material.noise(rng, played.size)
    if sound is None or rng.random() < 0.5:
        sound = fan(rng, played.size, 1.0)[0]
    width = int(rng.uniform(0.1, 0.6) * SAMPLE_RATE)  # a gesture outlasts its syllable
    loud = signal.oaconvolve(np.abs(played), np.ones(width, np.float32) / width)
    delay = int(rng.integers(width))
    loud = loud[delay : delay + played.size]
    moving = np.clip(loud / max(float(np.quantile(loud, 0.9)), 1e-9), 0.0, 1.0) ** rng.uniform(0.3, 1.5)
    sound = gears(rng, loud > 0.1 * loud.max()) if rng.random() < WHINE else moving * sound
    return (rms / max(active_rms(sound), 1e-9) * sound).astype(np.float32)


def gears(rng: np.random.Generator, talking: np.ndarray) -> Samples:
    """Gears of one to three joints (n,), which begin to turn while the robot is talking, (n,) bool; their pitch goes with their speed."""
    seconds, whole = np.arange(talking.size) / SAMPLE_RATE, np.zeros(talking.size)
    for _ in range(int(rng.integers(1, 4))):
        speed = _turns(rng, talking)
        uneven = np.interp(
            seconds, seconds[:: SAMPLE_RATE // 20], rng.normal(1.0, 0.01, seconds[:: SAMPLE_RATE // 20].size)
        )
        pitch_hz = 10 ** rng.uniform(math.log10(80), math.log10(1500)) * speed * uneven
        turned, slope, tone = np.cumsum(pitch_hz) / SAMPLE_RATE, rng.uniform(0.2, 2.0), np.zeros(talking.size)
        for harmonic in range(1, int(rng.integers(2, 25))):
            size = 10 ** (rng.normal(0.0, 6.0) / 20) * harmonic**-slope
            heard = harmonic * pitch_hz < 0.45 * SAMPLE_RATE
            tone += size * heard * np.sin(2 * np.pi * (harmonic * turned + rng.random()))
        rubbing = fan(rng, talking.size, 1.0)[0] * (1.0 + rng.uniform(0.0, 0.9) * np.sin(2 * np.pi * turned))
        tone /= max(float(tone.std()), 1e-9)
        whole += (
            rng.uniform(0.3, 1.0) * speed ** rng.uniform(0.5, 1.5) * (tone + 10 ** rng.uniform(-1.0, 0.5) * rubbing)
        )
    body = signal.firwin2(255, np.linspace(0, 1, GRID_BINS), amplitude(rng) ** 0.5)
    return signal.oaconvolve(whole, body, "same").astype(np.float32)


def _turns(rng: np.random.Generator, talking: np.ndarray) -> Samples:
    """Speed of a joint (n,), 0 to 1: turns of 0.16 to 1.6 s with ramps, one after the other, each begun while the robot is talking."""
    speed, at = np.zeros(talking.size), 0
    while at < talking.size:
        size = int(10 ** rng.uniform(-0.8, 0.2) * SAMPLE_RATE)
        if talking[at]:
            ramp = rng.uniform(0.02, 0.3) * size
            turn = np.minimum(np.minimum(np.arange(size), np.arange(size, 0, -1)) / ramp, 1.0)
            speed[at : at + size] = (rng.uniform(0.2, 1.0) * turn)[: talking.size - at]
        at += size + int(rng.exponential(0.5) * SAMPLE_RATE)
    return speed


def knocks(rng: np.random.Generator, material: Material, clean: Samples, rms: float) -> Samples:
    """Short noises (n,), cut about their loudest moment, KNOCK_DB over rms; each begins where the human, clean (n,), is silent."""
    total = np.zeros(clean.size, np.float32)
    silent = np.flatnonzero(maximum_filter1d(np.abs(clean), SAMPLE_RATE // 10) <= 1e-3 * np.abs(clean).max())
    for at in rng.choice(silent, rng.integers(1, KNOCKS + 1)) if silent.size else ():
        sound, size = material.noise(rng, SAMPLE_RATE), int(rng.uniform(*KNOCK_S) * SAMPLE_RATE)
        if sound is None:
            sound = fan(rng, SAMPLE_RATE, 1.0)[0]
        piece = np.take(sound, np.arange(size) + int(np.argmax(np.abs(sound))) - size // 8, mode="wrap")
        piece = piece * np.minimum(1.0, np.minimum(np.arange(size) / 32, np.arange(size, 0, -1) / (size / 2)))
        piece *= rms * 10 ** (rng.uniform(*KNOCK_DB) / 20) / max(active_rms(piece), 1e-9)
        total[at : at + size] += piece[: clean.size - at]
    return total


def hum(rng: np.random.Generator, samples: int) -> Samples:
    """A constant offset of -60 to -28 dB of full scale, and mains hum (n,) with up to four harmonics."""
    seconds = np.arange(samples) / SAMPLE_RATE
    total = np.full(samples, rng.choice((-1.0, 1.0)) * 10 ** (rng.uniform(-60, -28) / 20))
    mains, level_db = rng.choice((50.0, 60.0)) * rng.uniform(0.998, 1.002), rng.uniform(-60, -26)
    for harmonic in range(1, int(rng.integers(2, 6))):
        size = 10 ** ((level_db - rng.uniform(0, 6) * harmonic) / 20)
        total += size * np.sin(2 * np.pi * (harmonic * mains * seconds + rng.random()))
    return total.astype(np.float32)


def _speed(rng: np.random.Generator, samples: int) -> Samples:
    """Gain of a fan that is turned up or down by as much as 8 dB within 0.3 to 4 s, (n,)."""
    at, lasts = rng.uniform(0.1, 0.8) * samples, rng.uniform(0.3, 4.0) * SAMPLE_RATE
    return 10 ** (rng.uniform(-8, 8) / 20 * np.clip((np.arange(samples) - at) / lasts, 0, 1))


def _people(rng: np.random.Generator, material: Material, samples: int) -> Samples:
    """Three to six humans at once (n,), too far away for a microphone to make out one."""
    total = np.zeros(samples, np.float32)
    for _ in range(int(rng.integers(3, 7))):
        speech = material.humans.draw(rng, material.humans.draw_speaker(rng), min(6.0, samples / SAMPLE_RATE))
        total += np.roll(np.resize(speech, samples), int(rng.integers(samples)))
    tail = rng.standard_normal(4000) * np.exp(-np.arange(4000) / 900)
    return signal.oaconvolve(total, tail)[:samples].astype(np.float32)


def _psd(sound: Samples) -> Samples:
    """One-sided PSD of a recording on GRID_HZ, (601,)."""
    density = signal.welch(sound, SAMPLE_RATE, nperseg=StftConfig().n_fft)
    return np.interp(GRID_HZ, *density).astype(np.float32)
