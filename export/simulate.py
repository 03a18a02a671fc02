"""A conversation with a robot, simulated from speech, rooms and the physical effects: what the network trains on.

Each item is a pure function of (recipe, seed, index). The robot's voice is an EchoModel: a loudspeaker and room
response with effects of edgefilter.echo around it, drawn at random or taken from a profile that somebody diagnosed in
the field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy import signal

from edgefilter.echo.effects.clock_drift import ClockDrift
from edgefilter.echo.measurement import Values
from edgefilter.echo.model import EchoModel
from edgefilter.profile.data import GRID_BINS, GRID_HZ, Profile
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Samples
from export.corpus import Corpus
from export.rooms import Room


@dataclass(frozen=True)
class Recipe:
    """What conversations are like. Ranges are (low, high), drawn uniformly.

    seconds: of one item. human_gain_db: the human's power over the robot's at the microphone. fan_db: the human over
    the fan. office: share of small, reverberant rooms. warm: share that starts from a calibrated profile. human: share
    in which one speaks. distortion_db: the loudspeaker's distortion over its linear sound. lag_s, ppm, volume_db: of
    `moving` items, a share of all. silence_s: before the human speaks. effects: (name, values) of further effects;
    effects_share: how many items have them.
    """

    seconds: float = 12.0
    office: float = 0.6
    human_gain_db: tuple[float, float] = (-30.0, -16.0)
    fan_db: tuple[float, float] = (3.0, 14.0)
    quiet_fan: float = 0.15
    warm: float = 0.75
    human: float = 0.92
    moving: float = 0.4
    lag_s: tuple[float, float] = (0.0, 0.8)
    ppm: tuple[float, float] = (-150.0, 150.0)
    volume_db: tuple[float, float] = (-3.0, 3.0)
    distortion_db: tuple[float, float] = (-32.0, -14.0)
    silence_s: tuple[float, float] = (0.0, 5.0)
    effects: tuple[tuple[str, Values], ...] = ()
    effects_share: float = 0.5


PAPER = Recipe(
    seconds=5.0,
    office=6200 / 8000,
    human_gain_db=(-25.0, -25.0),
    fan_db=(6.0, 7.0),
    quiet_fan=0.0,
    human=1.0,
    moving=0.0,
    silence_s=(0.5, 1.5),
)
"""Li, Hindriks & Kunneman (2024), section 4: 5 s, 1800 items in a laboratory and 6200 in an office, human at -25 dB
after 0.5-1.5 s."""
RECIPES = {"edge": Recipe(), "paper": PAPER}


@dataclass(frozen=True, eq=False)
class Conversation:
    """mic, clean, reference: (n,) float32; clean is the human at the microphone.

    Profile: of a calibration elsewhere, or None.
    """

    mic: Samples
    clean: Samples
    reference: Samples
    profile: Profile | None
    about: dict[str, object] = field(default_factory=dict)


def simulate(recipe: Recipe, seed: int, index: int, humans: Corpus, robots: Corpus, rooms: list[Room]) -> Conversation:
    """Item `index` of that seed."""
    rng = np.random.default_rng([seed, index])
    wanted = "office" if rng.random() < recipe.office else "lab"
    room = _draw(rng, [room for room in rooms if room.kind == wanted])
    calibration_room = _draw(rng, [room for room in rooms if room.kind == "lab"])
    moving = rng.random() < recipe.moving
    samples = round(recipe.seconds * SAMPLE_RATE)

    reference, heard_source, splits = _robot_script(rng, recipe, robots, samples, moving)
    colour = draw_colour(rng)
    driver = _Driver.draw(rng, recipe)
    effects = recipe.effects if rng.random() < recipe.effects_share else ()
    model = EchoModel(_path(room.robot, colour), effects)
    echo = model.predict(driver.play(heard_source))[PRE_ROLL:]
    echo = np.concatenate((echo, np.zeros(PRE_ROLL, np.float32)))
    if moving:
        echo = ClockDrift().apply(echo, {"ppm": rng.uniform(*recipe.ppm), "offset": 0.0}, SAMPLE_RATE)

    level = 0.08 * 10 ** (rng.uniform(-10, 6) / 20)
    gain = level / max(_active_rms(echo), 1e-9)
    echo *= gain
    clean = _human_script(rng, recipe, humans, room, samples)
    human_rms = level * 10 ** (rng.uniform(*recipe.human_gain_db) / 20)
    clean *= human_rms / max(_active_rms(clean), 1e-9)
    quiet = rng.random() < recipe.quiet_fan
    fan, psd = _fan(
        rng, samples, human_rms * 10 ** (-(rng.uniform(20, 45) if quiet else rng.uniform(*recipe.fan_db)) / 20)
    )
    profile = None
    if rng.random() < recipe.warm:
        path = gain * _path(
            calibration_room.robot / np.abs(calibration_room.robot).max() * np.abs(room.robot).max(), colour
        )
        profile = _profile(path * 10 ** (rng.uniform(-1, 1) / 20), psd * 10 ** (rng.uniform(-0.6, 0.6) / 10))
    mic = np.clip(echo + clean + fan, -1.0, 1.0).astype(np.float32)
    about = {
        "room": room.kind,
        "rt60_s": round(room.rt60_s, 3),
        "warm": profile is not None,
        "moving": bool(moving),
        "quiet_fan": bool(quiet),
    }
    return Conversation(
        mic, clean, reference, profile, about | {"utterances": splits, "effects": [name for name, _ in effects]}
    )


@dataclass(frozen=True)
class _Driver:
    """A moving-coil loudspeaker's distortion: products of the signal with bounded functions of the membrane's displacement.

    Klippel (2006), "Loudspeaker nonlinearities": force factor and stiffness depend on the displacement, so the sound
    holds x f(d) with f a bounded function of displacement d, and a small memoryless part from the amplifier.
    """

    resonance_hz: float
    drive: float
    asymmetry: float
    hardness: float
    amplifier: float
    level_db: float

    @classmethod
    def draw(cls, rng: np.random.Generator, recipe: Recipe) -> _Driver:
        return cls(
            rng.uniform(120, 420),
            10 ** rng.uniform(-0.3, 0.7),
            rng.uniform(-1, 1),
            rng.uniform(0, 1),
            rng.uniform(0, 0.3),
            rng.uniform(*recipe.distortion_db),
        )

    def play(self, x: Samples) -> Samples:
        """X (n,) with the distortion added at level_db over x."""
        displacement = signal.sosfilt(signal.butter(2, self.resonance_hz, fs=SAMPLE_RATE, output="sos"), x)
        d = self.drive * displacement / max(_active_rms(displacement), 1e-9)
        bound = 1.0 / (1.0 + d * d)
        added = x * (self.asymmetry * d * bound - self.hardness * d * d * bound)
        added += self.amplifier * np.tanh(x / max(_active_rms(x), 1e-9)) * _active_rms(x)
        added -= np.dot(added, x) / max(float(np.dot(x, x)), 1e-9) * x
        added *= 10 ** (self.level_db / 20) * _active_rms(x) / max(_active_rms(added), 1e-9)
        return (x + added).astype(np.float32)


def _robot_script(
    rng: np.random.Generator, recipe: Recipe, robots: Corpus, samples: int, moving: bool
) -> tuple[Samples, Samples, list[list[int]]]:
    """What the player is told (n,), what comes out of it (n,) with lag and volume, and the utterances' [start, end] in the former."""
    voice = robots.draw_speaker(rng)
    told, played = np.zeros((2, samples), np.float32)
    splits: list[list[int]] = []
    lag = int(rng.uniform(0.0, 0.3) * SAMPLE_RATE)
    at = int(rng.uniform(0.0, 0.6) * SAMPLE_RATE) if recipe.seconds > 5 else 0
    volume = 1.0
    while at < samples - SAMPLE_RATE // 2:
        speech = robots.draw(rng, voice, rng.uniform(2.0, 7.0))[: samples - at]
        told[at : at + speech.size] = speech
        end = min(samples, at + lag + speech.size)
        played[at + lag : end] += volume * speech[: max(0, end - at - lag)]
        splits.append([at, at + speech.size])
        new_lag = int(rng.uniform(*recipe.lag_s) * SAMPLE_RATE) if moving else lag
        at += speech.size + int(rng.uniform(0.3, 1.2) * SAMPLE_RATE) + max(0, lag - new_lag)
        volume = 10 ** (rng.uniform(*recipe.volume_db) / 20) if moving else 1.0
        lag = new_lag
    return told, played, splits


def _human_script(rng: np.random.Generator, recipe: Recipe, humans: Corpus, room: Room, samples: int) -> Samples:
    """The human at the microphone (n,): silent at first, then one or more utterances; now and then nobody speaks."""
    clean = np.zeros(samples, np.float32)
    if rng.random() >= recipe.human:
        return clean
    at = int(rng.uniform(*recipe.silence_s) * SAMPLE_RATE)
    speaker, response = humans.draw_speaker(rng), room.humans[int(rng.integers(len(room.humans)))]
    while at < samples - SAMPLE_RATE:
        speech = humans.draw(rng, speaker, rng.uniform(1.5, 7.0))[: samples - at]
        clean[at : at + speech.size] += speech
        at += speech.size + int(rng.uniform(0.5, 3.0) * SAMPLE_RATE)
    return signal.oaconvolve(clean, response)[:samples].astype(np.float32)


def _draw(rng: np.random.Generator, rooms: list[Room]) -> Room:
    return rooms[int(rng.integers(len(rooms)))]


def draw_colour(rng: np.random.Generator) -> Samples:
    """(taps,) of loudspeaker, shell and microphone: band limits, broad peaks, reflections of the shell within 2 ms."""
    impulse = np.zeros(1024)
    impulse[0] = 1.0
    for delay in rng.integers(3, 40, size=6):
        impulse[delay] += rng.choice([-1, 1]) * 10 ** (-rng.uniform(8, 22) / 20)
    impulse = signal.sosfilt(signal.butter(2, rng.uniform(80, 260), "high", fs=SAMPLE_RATE, output="sos"), impulse)
    impulse = signal.sosfilt(signal.butter(2, rng.uniform(5500, 7800), fs=SAMPLE_RATE, output="sos"), impulse)
    for _ in range(5):
        frequency, gain = 10 ** rng.uniform(math.log10(250), math.log10(6500)), 10 ** (rng.uniform(-7, 7) / 20)
        width = min(frequency / rng.uniform(0.7, 4.0), SAMPLE_RATE / 4)  # beyond half the rate the filter is not stable
        b, a = signal.iirpeak(frequency, frequency / width, fs=SAMPLE_RATE)
        impulse = impulse + (gain - 1.0) * signal.lfilter(b, a, impulse)
    return impulse.astype(np.float32)


def _path(room: Samples, colour: Samples) -> Samples:
    """The echo path, its direct sound at PRE_ROLL, at most half a second."""
    response = signal.oaconvolve(room, colour)
    start = max(0, int(np.argmax(np.abs(response))) - PRE_ROLL)
    missing = max(0, PRE_ROLL - int(np.argmax(np.abs(response))))
    return np.concatenate((np.zeros(missing), response[start:]))[: SAMPLE_RATE // 2].astype(np.float32)


def _fan(rng: np.random.Generator, samples: int, rms: float) -> tuple[Samples, Samples]:
    """Fan noise (n,) of that RMS and its one-sided PSD (601,) on GRID_HZ: falling, with bumps and a few blade lines."""
    corner = 10 ** rng.uniform(math.log10(150), math.log10(4000))
    level_db = -10 * rng.uniform(0.6, 1.6) * np.log10(1 + (GRID_HZ / corner) ** 2)
    for centre in 10 ** rng.uniform(math.log10(60), math.log10(6000), size=5):
        level_db += rng.uniform(-4, 7) * np.exp(-0.5 * (np.log2((GRID_HZ + 1) / centre) / rng.uniform(0.15, 0.5)) ** 2)
    blade = rng.uniform(80, 400)
    for line in range(1, int(rng.integers(1, 5))):
        level_db += rng.uniform(0, 10) * np.exp(-0.5 * ((GRID_HZ - line * blade) / 12.0) ** 2)
    amplitude = 10 ** (np.maximum(level_db, -45) / 20)
    taps = signal.firwin2(1023, np.linspace(0, 1, GRID_BINS), amplitude)
    noise = signal.oaconvolve(rng.standard_normal(samples + taps.size - 1), taps, mode="valid")
    scale = rms / math.sqrt(np.mean(noise**2))
    response = np.abs(np.fft.rfft(taps, 2 * (GRID_BINS - 1)))[:GRID_BINS]
    return (scale * noise).astype(np.float32), (2 / SAMPLE_RATE * (scale * response) ** 2).astype(np.float32)


def _profile(path: Samples, noise_psd: Samples) -> Profile:
    """What a calibration would have written; the fields that only people read are flat."""
    response = np.abs(np.fft.rfft(path, 2 * (GRID_BINS - 1)))[:GRID_BINS].astype(np.float32)
    bands = np.array([[100.0, 8000.0]])
    return Profile(
        EchoModel(path),
        300.0,
        response,
        noise_psd.astype(np.float32),
        bands,
        np.array([40.0]),
        np.full(4, -40.0),
        source="simulated",
    )


def _active_rms(x: Samples) -> float:
    """RMS over the 20 ms stretches that are within 30 dB of the loudest."""
    power = np.mean(x[: x.size // 320 * 320].reshape(-1, 320).astype(np.float64) ** 2, axis=1)
    loud = power[power > 1e-3 * power.max()] if power.size else power
    return math.sqrt(loud.mean()) if loud.size else 0.0
