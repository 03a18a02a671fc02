"""What no effect of the 13 that are simulated explains: mains hum, a talker, music, doors, codecs, flutter, lost packets.

Functions as in hidden_catalogue, plus `people`: human speech (k,) at 16 kHz to draw a talker from. Strength: power of
what cannot be explained at the microphone over the fan (of a codec: of what is not coherent with its input).
"""

from __future__ import annotations

import math
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import signal

from bench.simulate.hidden_acoustics import decibels, solve
from bench.simulate.hidden_catalogue import ENR_DB
from bench.simulate.hidden_robot import Chain, Scene
from bench.simulate.simulated_robot import RATE, Array

Person = Callable[[np.random.Generator], Array]
Disturbance = Callable[[np.random.Generator, Scene, Chain, str, Person], tuple[Chain, dict]]

CODECS = {
    "opus": ("libopus", RATE, ["-application", "voip"], ("ogg", "ogg"), (8, 12, 16, 24, 32, 48)),
    "mp3": ("libmp3lame", RATE, [], ("mp3", "mp3"), (8, 16, 24, 32, 48, 64)),
    "speex": ("libspeex", RATE, [], ("ogg", "ogg"), (4, 8, 16)),
    "gsm": ("libgsm", 8000, [], ("gsm", "gsm"), (13,)),
    "g726": ("g726", 8000, [], ("wav", "wav"), (16, 24, 32)),
}
"""Encoder of ffmpeg, its rate in Hz, options, formats out and in, bit rates in kbit/s from bad to good."""


CUT_HZ = 6500.0
"""Where a codec passes little above it, a band limit is as right a name."""


def _with_sound(scene: Scene, chain: Chain, sound: Array, strength: str) -> Chain:
    """Sound (n,) of any level, added at the microphone at the wanted one."""
    sound = sound * 10 ** ((ENR_DB[strength] - scene.over_fan_db(sound)) / 20)
    return replace(chain, others=sound if chain.others is None else chain.others + sound)


def in_room(rng: np.random.Generator, x: Array) -> Array:
    """Samples x (n,) from a few metres away: direct sound and a tail of 0.3-0.5 s that loses its treble first."""
    t = np.arange(RATE // 2) / RATE
    tail = rng.standard_normal(t.size) * np.exp(-6.9 * t / rng.uniform(0.3, 0.5))
    tail = signal.lfilter(*signal.butter(1, 3000, fs=RATE), tail)
    tail[: int(0.004 * RATE)] = 0.0
    response = 0.5 * tail / math.sqrt(np.sum(tail**2))
    response[0] = 1.0
    return signal.oaconvolve(x, response)[: x.size]


def mains_hum(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str, _: Person) -> tuple[Chain, dict]:
    """A ground loop: lines at multiples of 50 or 60 Hz, the odd ones stronger, wandering by hundredths of a Hz."""
    n, mains = chain.fan.size, float(rng.choice([50.0, 60.0]))
    wander = np.cumsum(rng.normal(0, 1, n // RATE + 2))
    frequency = mains + 0.02 * np.interp(
        np.arange(n) / RATE, np.arange(wander.size), wander / max(np.abs(wander).max(), 1.0)
    )
    phase = 2 * math.pi * np.cumsum(frequency) / RATE
    top, hum = int(rng.integers(6, 25)), np.zeros(n)
    for k in range(1, top):
        hum += (1.0 if k % 2 else 0.5) * k ** -rng.uniform(0.4, 1.2) * np.sin(k * phase + rng.uniform(0, 2 * math.pi))
    return _with_sound(scene, chain, hum, strength), {"mains_hz": mains, "lines": top - 1}


def talker(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str, person: Person) -> tuple[Chain, dict]:
    """Somebody talks near by, now and then, also in the robot's pauses."""
    sound, at = np.zeros(chain.fan.size), int(rng.uniform(0.5, 4) * RATE)
    while at < sound.size - RATE:
        words = person(rng)[: sound.size - at]
        sound[at : at + words.size] = words
        at += words.size + int(rng.uniform(1, 5) * RATE)
    return _with_sound(scene, chain, in_room(rng, sound), strength), {}


def music(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str, _: Person) -> tuple[Chain, dict]:
    """A radio: plucked chords (Karplus & Strong 1983) over a beat of noise bursts."""
    n, beat = chain.fan.size, int(rng.uniform(0.22, 0.45) * RATE)
    sound, scale_hz = np.zeros(n), 110 * 2 ** (rng.integers(0, 12) / 12) * 2 ** (np.array([0, 2, 4, 5, 7, 9, 11]) / 12)
    for i, start in enumerate(range(0, n - 2 * RATE, beat)):
        for pitch in rng.choice(scale_hz, size=int(rng.integers(1, 4)), replace=False) * 2.0 ** rng.integers(0, 3):
            period = int(RATE / pitch)
            excitation = np.concatenate([rng.uniform(-1, 1, period), np.zeros(RATE)])
            comb = np.zeros(period + 2)
            comb[0], comb[period], comb[period + 1] = 1.0, -0.498, -0.498
            sound[start : start + excitation.size] += signal.lfilter([1.0], comb, excitation)
        burst = rng.standard_normal(RATE // 20) * np.exp(-np.arange(RATE // 20) / (RATE * 0.01))
        sound[start : start + burst.size] += (2.0 if i % 4 == 0 else 0.5) * burst
    return _with_sound(scene, chain, in_room(rng, sound), strength), {"beat_s": beat / RATE}


def door_slams(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str, _: Person) -> tuple[Chain, dict]:
    """Doors and things that fall, at times that have nothing to do with what the robot says."""
    n = chain.fan.size
    times, sound = np.sort(rng.uniform(0.03, 0.95, size=int(rng.integers(2, 7)))), np.zeros(n)
    for time in times:
        blow = rng.standard_normal(RATE // 3) * np.exp(-np.arange(RATE // 3) / (RATE * rng.uniform(0.01, 0.05)))
        blow = signal.sosfilt(signal.butter(2, rng.uniform(300, 3000), fs=RATE, output="sos"), blow)
        part = sound[int(time * n) :][: blow.size]
        part += rng.uniform(0.4, 1.0) * blow[: part.size]
    return _with_sound(scene, chain, in_room(rng, sound), strength), {"times_s": (times * n / RATE).tolist()}


def flutter(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str, _: Person) -> tuple[Chain, dict]:
    """A clock that trembles (2-12 Hz), as a bad resampler or a loudspeaker on a spring makes it."""
    rate_hz, t = math.exp(rng.uniform(math.log(2), math.log(12))), np.arange(chain.fan.size) / RATE
    wave = np.sin(2 * math.pi * rate_hz * t + rng.uniform(0, 6)) + 0.3 * np.sin(
        2 * math.pi * rate_hz * 2.3 * t + rng.uniform(0, 6)
    )
    echo, usual = scene.echo(chain), np.zeros(t.size) if chain.lag is None else chain.lag
    slope = np.fft.irfft(np.fft.rfft(echo) * 2j * math.pi * np.fft.rfftfreq(echo.size), echo.size)
    samples = solve(lambda s: scene.over_fan_db(s * wave * slope), ENR_DB[strength], 1e-4, 30.0)
    return replace(chain, lag=usual + samples * wave), {"rate_hz": rate_hz, "samples": samples}


def packet_loss(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str, _: Person) -> tuple[Chain, dict]:
    """The playback is streamed and packets of 10-40 ms are lost: silence, or the last packet again and fading.

    The clock goes on.
    """
    x, length = chain.played, int(rng.choice([10, 20, 40])) * RATE // 1000
    repeats, fade = bool(rng.random() < 0.5), np.linspace(0, 1, 32)
    order = rng.permutation(np.arange(8, x.size // length - 2))
    loud = np.add.reduceat(x**2, np.arange(0, x.size - length, length))
    order = order[loud[order] > 0.05 * loud.mean()]
    played, wanted, response = (
        x.copy(),
        scene.fan_power * 10 ** (ENR_DB[strength] / 10) * x.size,
        scene.linear_response(),
    )
    changed, lost = 0.0, 0
    for packet in order:
        part = slice(packet * length, (packet + 1) * length)
        new = 0.6 * x[part.start - length : part.start] if repeats else np.zeros(length)
        new[:32] = (1 - fade) * x[part][:32] + fade * new[:32]
        new[-32:] = fade * x[part][-32:] + (1 - fade) * new[-32:]
        energy = float(np.sum(signal.oaconvolve(new - x[part], response) ** 2))
        if changed + energy < 1.1 * wanted:
            played[part], lost, changed = new, lost + 1, changed + energy
        if changed > 0.9 * wanted:
            break
    parameters = {
        "lost_packets": lost,
        "packet_ms": length * 1000 // RATE,
        "filled_with": "repetition" if repeats else "silence",
    }
    return replace(chain, played=played), parameters


def codec(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str, _: Person) -> tuple[Chain, dict]:
    """The playback through a codec of ffmpeg, at its lowest bit rate whose noise does not exceed the strength."""
    name = str(rng.choice(sorted(CODECS)))
    response, tries = scene.linear_response(), []
    for kbps in CODECS[name][-1]:
        played = through_codec(chain.played, name, kbps)
        heard, original = (signal.oaconvolve(x, response)[: x.size] for x in (played, chain.played))
        noise_db = incoherent_db(original, heard) + scene.over_fan_db(heard)
        tries.append(
            (
                abs(noise_db - ENR_DB[strength]),
                {"codec": name, "kbps": kbps, "incoherent_over_fan_db": noise_db},
                played,
            )
        )
        if noise_db < ENR_DB[strength]:
            break
    _, parameters, played = min(tries, key=lambda entry: entry[0])
    return replace(chain, played=played), parameters | {"cuts_band": cuts_band(chain.played, played)}


def through_codec(x: Array, name: str, kbps: int) -> Array:
    """Samples x (n,) encoded and decoded, put back in time; needs ffmpeg."""
    encoder, rate, options, (outer, inner), _ = CODECS[name]
    if not shutil.which("ffmpeg"):
        raise SystemExit(
            "ffmpeg was not found; the set `outside` needs it for its codecs (Debian: apt-get install ffmpeg)"
        )
    quiet, raw = ["ffmpeg", "-v", "error", "-threads", "1"], ["-f", "f32le", "-ac", "1"]
    bits = [] if name == "gsm" else ["-b:a", f"{kbps}k"]
    pcm = signal.resample_poly(x, rate, RATE).astype(np.float32).tobytes()
    encode = [*quiet, *raw, "-ar", str(rate), "-i", "-", "-c:a", encoder, *bits, *options, "-f", outer, "-"]
    packed = subprocess.run(encode, input=pcm, capture_output=True, check=True).stdout
    out = subprocess.run(
        [*quiet, "-f", inner, "-i", "-", *raw, "-ar", str(rate), "-"], input=packed, capture_output=True, check=True
    ).stdout
    y = signal.resample_poly(np.frombuffer(out, np.float32).astype(np.float64), RATE, rate)
    lags = signal.correlate(y[: 1 << 18], x[: 1 << 18], method="fft")
    lag = int(np.argmax(lags)) - min(x.size, 1 << 18) + 1
    y = y[lag:] if lag >= 0 else np.concatenate([np.zeros(-lag), y])
    return np.pad(y, (0, max(x.size - y.size, 0)))[: x.size]


def cuts_band(x: Array, y: Array) -> bool:
    """Whether of the power of x (n,) above CUT_HZ less than a quarter is in y (n,)."""
    hz, before = signal.welch(x, fs=RATE, nperseg=1024)
    after = signal.welch(y, fs=RATE, nperseg=1024)[1]
    return bool(after[hz > CUT_HZ].sum() < 0.25 * before[hz > CUT_HZ].sum())


def incoherent_db(x: Array, y: Array) -> float:
    """Share of y's power (n,), in dB, that no linear filter of x (n,) explains.

    Its spectrum times one minus the coherence (64 ms, Welch).
    """
    _, coherence = signal.coherence(x, y, fs=RATE, nperseg=1024)
    _, spectrum = signal.welch(y, fs=RATE, nperseg=1024)
    return decibels(float(np.sum((1.0 - coherence) * spectrum) / np.sum(spectrum)))


OUTSIDE: dict[str, Disturbance] = {
    "mains_hum": mains_hum,
    "talker": talker,
    "codec": codec,
    "flutter": flutter,
    "packet_loss": packet_loss,
    "door_slams": door_slams,
    "music": music,
}
NAMED = ("packet_loss", "codec")
"""Of these, what the diagnosis has a name for."""
