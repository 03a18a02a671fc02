"""Long recordings of a simulated robot: a day of changes, and a robot that speaks to nobody.

A day: the robot speaks clip after clip, in random order and over and over. Five changes divide a day into six stages of equal
length: it is calibrated and begins in a laboratory, then is carried into an office, turned down, driven to another
place in that office, gets a playback clock of its own with another lag, and is carried into another office. The human
talks over about every third utterance. Loudspeaker, shell and fan stay the same. Alone: ever new robots in new
rooms, which nobody interrupts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np
from scipy import signal

from bench.simulate import simulated_robot as physics
from bench.simulate.conversations import DISTORTION_DB, Clip, read_speech
from bench.simulate.simulated_robot import RATE, Array, Rng, Robot, Room
from edgefilter.types import Samples

PAUSE_S = (0.4, 2.0)
END_S = 3.0
"""Silence at the end of a stage: the echo of the last utterance dies away in it."""
HUMAN_DB, FAN_DB = -24.0, -31.5
"""Power of human and fan, against the robot's where it speaks first (between lab and office of `conversations`)."""
USUAL_DISTORTION_DB = -24.0
INTERRUPTED = 0.3
VOLUME_DB, PPM = -5.0, -60.0
LAGS_S = (0.12, 0.31)
STAGES = 6


@dataclass(frozen=True)
class Stage:
    """What stays the same for a while. name: in what it differs from the one before."""

    name: str
    room: Room
    lag: int
    volume_db: float = 0.0
    ppm: float = 0.0


@dataclass(frozen=True)
class Day:
    """A day's signals, (n,) float32 each, and its calibration.

    mic = echo + clean + fan. stages: names. begins: sample of the microphone at which each of them begins. told: what
    the human says, and where in clean.
    """

    ref: Samples
    mic: Samples
    clean: Samples
    calibration: tuple[Samples, Samples, Samples]
    stages: tuple[str, ...]
    begins: tuple[int, ...]
    told: tuple[tuple[str, slice], ...]


class Repertoire(Iterator[Array]):
    """What the robot says: clips one after the other, each with a peak of 0.7; said: those so far, with their seconds."""

    def __init__(self, clips: Iterable[Clip]) -> None:
        self._clips = iter(clips)
        self.said: list[tuple[Clip, float]] = []

    def __next__(self) -> Array:
        clip = next(self._clips)
        samples = read_speech(clip)
        self.said.append((clip, samples.size / RATE))
        return 0.7 * samples / np.abs(samples).max()


def shuffled(rng: Rng, clips: list[Clip]) -> Iterator[Clip]:
    """The clips in random order, over and over."""
    while True:
        yield from (clips[number] for number in rng.permutation(len(clips)).tolist()[::-1])


def speak(
    rng: Rng, robot: Robot, repertoire: Iterator[Array], stage: Stage, speech_s: float
) -> tuple[Array, Array, list[slice]]:
    """Reference (n,), echo (n,) without gain, and where in the echo each utterance is, of so many seconds of speech."""
    said: list[tuple[int, Array]] = []
    at, missing = RATE // 2, speech_s * RATE
    while missing > 0:
        said.append((at, next(repertoire)))
        missing -= said[-1][1].size
        at += said[-1][1].size + int(rng.uniform(*PAUSE_S) * RATE)
    ref, echo = np.zeros((2, at + stage.lag + int(END_S * RATE)))
    tail = stage.room.robot.size + robot.bulk
    volume = 10 ** (stage.volume_db / 20)
    for start, samples in said:
        ref[start : start + samples.size] = samples
        heard = robot.record(np.pad(volume * samples, (0, tail)), stage.room.robot)
        place = echo[start + stage.lag : start + stage.lag + heard.size]
        place += heard[: place.size]
    later = stage.lag + robot.bulk
    return ref, physics.warp(echo, stage.ppm), [slice(start + later, start + later + x.size) for start, x in said]


def interrupt(
    rng: Rng, speech: list[Clip], room: Room, heard: list[slice], size: int
) -> tuple[Array, list[tuple[str, slice]]]:
    """A human of unit power at the microphone, (size,), who talks over some of the utterances; what is said, and where."""
    clean, told, free = np.zeros(size), [], 0
    for utterance in heard:
        begin = utterance.start + int(rng.uniform(0.3, 1.5) * RATE)
        if rng.random() < INTERRUPTED and begin >= free:
            clip = speech[rng.integers(len(speech))]
            voice = signal.oaconvolve(read_speech(clip), room.human)[: size - begin]
            clean[begin : begin + voice.size] = voice / math.sqrt(np.mean(voice**2))
            told.append((clip.text, slice(begin, begin + voice.size)))
            free = begin + voice.size + RATE
    return clean, told


def draw_stages(rng: Rng, robot: Robot, stage_s: float) -> list[Stage]:
    """The six stages of a day. stage_s: how long one of them lasts, about, for what the clocks lose in it."""
    human_m = rng.uniform(1.0, 1.5)
    about = robot.distance_m, robot.direction, human_m
    walls = physics.draw_walls(rng, "office")
    laboratory = physics.draw_room(rng, "lab", *about)
    office, elsewhere = (physics.stand(rng, walls, *about) for _ in range(2))
    early, late = (round(lag * RATE) for lag in LAGS_S)
    lost = round(-PPM * 1e-6 * stage_s * RATE)
    return [
        Stage("laboratory", laboratory, early),
        Stage("office", office, early),
        Stage(f"volume {VOLUME_DB:+.0f} dB", office, early, VOLUME_DB),
        Stage("another place", elsewhere, early, VOLUME_DB),
        Stage(f"clock {PPM:+.0f} ppm, lag", elsewhere, late, VOLUME_DB, PPM),
        Stage("another office", physics.draw_room(rng, "office", *about), late + lost, VOLUME_DB, PPM),
    ]


def make_day(seed: int, minutes: float, voices: list[Clip], speech: list[Clip]) -> Day:
    rng = np.random.default_rng(seed)
    repertoire, robot = Repertoire(shuffled(rng, voices)), physics.draw_robot(rng)
    stages = draw_stages(rng, robot, 60 * minutes / STAGES)
    trial = next(Repertoire(shuffled(rng, voices)))
    robot, _ = physics.with_distortion(robot, trial, stages[0].room.robot, USUAL_DISTORTION_DB)
    parts, begins, told, now, level = [], [], [], 0, 0.0
    for stage in stages:
        ref, echo, heard = speak(rng, robot, repertoire, stage, 60 * minutes / STAGES)
        human, said = interrupt(rng, speech, stage.room, heard, ref.size)
        told += [(text, slice(now + place.start, now + place.stop)) for text, place in said]
        level = level or loudness(echo, heard)
        parts.append([x.astype(np.float32) for x in (ref, echo, human)])
        begins.append(now)
        now += ref.size
    ref, echo, human = (np.concatenate(signals) for signals in zip(*parts, strict=True))
    microphone = draw_microphone(rng, robot, stages[0].room, float(np.abs(echo).max()), level)
    fan = np.concatenate([microphone.hears_fan(rng, part[0].size) for part in parts])
    clean = np.float32(microphone.gain * level * 10 ** (HUMAN_DB / 20)) * human
    mic = np.float32(microphone.gain) * echo + clean + fan
    sweeps = calibration(rng, robot, stages[0].room, microphone)
    names = tuple(stage.name for stage in stages)
    return Day(ref, mic, clean, sweeps, names, tuple(begins), tuple(told))


def loudness(echo: Array, heard: list[slice]) -> float:
    return math.sqrt(np.mean(np.concatenate([echo[utterance] for utterance in heard]) ** 2))


@dataclass(frozen=True)
class Microphone:
    """Its gain, and the fan that it hears: root mean square and spectrum."""

    gain: float
    fan: float
    spectrum: Array

    def hears_fan(self, rng: Rng, size: int) -> Samples:
        return (self.fan * physics.fan_noise(rng, self.spectrum, size)).astype(np.float32)


def draw_microphone(rng: Rng, robot: Robot, room: Room, peak: float, level: float) -> Microphone:
    """With a gain at which a sweep in that room has a peak of 0.3 of full scale, or the voice one of 0.8.

    peak, level: largest sample and root mean square of the voice without gain.
    """
    gain = float(min(0.3 / np.abs(robot.record(physics.sweep(), room.robot)).max(), 0.8 / peak))
    return Microphone(gain, gain * level * 10 ** (FAN_DB / 20), physics.draw_fan(rng))


def calibration(rng: Rng, robot: Robot, room: Room, microphone: Microphone) -> tuple[Samples, Samples, Samples]:
    """A sweep, its recording in a room, and the fan alone."""
    excitation = physics.sweep()
    echo = np.float32(microphone.gain) * robot.record(excitation, room.robot).astype(np.float32)
    fan, alone = (microphone.hears_fan(rng, size) for size in (echo.size, 8 * RATE))
    return excitation.astype(np.float32), echo + fan, alone


ROOMS = ("lab", "office")
STARTS, ALONE_LAG_S, ALONE_PPM = ("calibrated", "cold"), (0.02, 1.0), (10.0, 300.0)
TRIAL_S = 6.0
"""Of the robot's voice, to which its distortion is set."""


@dataclass(frozen=True)
class Monologue:
    """One robot in one room, from the filter's first moment on.

    ref, mic: (n,) float32. echo: of mic, what the robot says; late: samples by which it is later than in ref. start: whether
    the filter has the calibration (sweep, its recording, the fan). said: clips in order, and how many seconds each.
    """

    ref: Samples
    mic: Samples
    echo: Samples
    late: int
    calibration: tuple[Samples, Samples, Samples]
    room: str
    distortion: str
    start: str
    voice: str
    said: list[tuple[Clip, float]]


def make_monologue(seed: int, index: int, voice: str, clips: Iterator[Clip], speech_s: float) -> Monologue:
    """Number index of this seed: rooms, distortions, starts in turn; clocks that differ in every other eight."""
    rng = np.random.default_rng([seed, index])
    kind, distortion, start = ROOMS[index % 2], tuple(DISTORTION_DB)[index // 2 % 2], STARTS[index // 4 % 2]
    robot = physics.draw_robot(rng)
    room = physics.draw_room(rng, kind, robot.distance_m, robot.direction, rng.uniform(1.0, 1.5))
    first = next(clips)
    trial = read_speech(first)[: round(TRIAL_S * RATE)]
    robot, _ = physics.with_distortion(robot, trial, room.robot, rng.uniform(*DISTORTION_DB[distortion][kind]))
    ppm = rng.choice([-1.0, 1.0]) * math.exp(rng.uniform(*np.log(ALONE_PPM))) if index // 8 % 2 else 0.0
    stage = Stage(kind, room, round(rng.uniform(*ALONE_LAG_S) * RATE), rng.uniform(-3, 3), ppm)
    said = Repertoire(chain([first], clips))
    ref, echo, heard = speak(rng, robot, said, stage, speech_s)
    microphone = draw_microphone(rng, robot, room, float(np.abs(echo).max()), loudness(echo, heard))
    heard = (microphone.gain * echo).astype(np.float32)
    mic = heard + microphone.hears_fan(rng, ref.size)
    sweeps, late = calibration(rng, robot, room, microphone), stage.lag + robot.bulk
    return Monologue(ref.astype(np.float32), mic, heard, late, sweeps, kind, distortion, start, voice, said.said)
