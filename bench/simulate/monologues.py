"""Simulated robots that speak to nobody: ever new robots in new rooms, clip after clip, from the filter's first moment on."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from bench.simulate import simulated_robot as physics
from bench.simulate.conversations import DISTORTION_DB, Clip, read_speech
from bench.simulate.microphones import MICROPHONES, RECORDED, Processing
from bench.simulate.simulated_robot import RATE, Array, Rng, Robot, Room
from edgefilter.types import Samples

PAUSE_S = (0.4, 2.0)
END_S = 3.0
"""Silence at the end: the echo of the last utterance dies away in it."""
FAN_DB = -31.5
"""Power of the fan's noise over that of the robot's voice at the microphone, dB: between those of `conversations` in lab and office."""
ROOMS = ("lab", "office")
STARTS, LAG_S, PPM = ("calibrated", "cold"), (0.02, 1.0), (10.0, 300.0)
TRIAL_S = 6.0
"""Of the robot's voice, to which its distortion is set."""


class Repertoire(Iterator[Array]):
    """The clips that the robot says, one after the other, each scaled to a peak of 0.7; `said` lists those taken, with their seconds."""

    def __init__(self, clips: Iterable[Clip]) -> None:
        self._clips = iter(clips)
        self.said: list[tuple[Clip, float]] = []

    def __next__(self) -> Array:
        clip = next(self._clips)
        samples = read_speech(clip)
        self.said.append((clip, samples.size / RATE))
        return 0.7 * samples / np.abs(samples).max()


def speak(
    rng: Rng, robot: Robot, repertoire: Iterator[Array], speech_s: float, room: Room, lag: int, volume_db: float = 0.0,
    ppm: float = 0.0, ask_db: float = 0.0,
) -> tuple[Array, Array, Array, list[slice]]:  # fmt: skip
    """Make speech_s seconds of speech: the reference, its echo and the echo of the voice lowered by ask_db, (n,) each; each utterance's span.

    The echoes are those before the microphone's gain.
    """
    said: list[tuple[int, Array]] = []
    at, missing = RATE // 2, speech_s * RATE
    while missing > 0:
        said.append((at, next(repertoire)))
        missing -= said[-1][1].size
        at += said[-1][1].size + int(rng.uniform(*PAUSE_S) * RATE)
    ref, *echoes = np.zeros((3, at + lag + int(END_S * RATE)))
    tail = room.robot.size + robot.bulk
    for start, samples in said:
        ref[start : start + samples.size] = samples
        for echo, lower_db in zip(echoes, (0.0, ask_db) if ask_db else (0.0,)):
            heard = robot.record(np.pad(10 ** ((volume_db - lower_db) / 20) * samples, (0, tail)), room.robot)
            place = echo[start + lag : start + lag + heard.size]
            place += heard[: place.size]
    later = lag + robot.bulk
    echo, softer = (physics.warp(one, ppm) for one in echoes)
    return ref, echo, softer, [slice(start + later, start + later + x.size) for start, x in said]


@dataclass(frozen=True)
class Monologue:
    """One robot in one room, from the filter's first moment on.

    ref, mic: reference and microphone, (n,) float32. echo: the robot's part of mic; of one that can lower its voice what
    `softened` returns. late: samples by which the echo comes after the reference. device: the processing behind the microphone, which
    mic still lacks and the calibration has. start:
    "calibrated" where the filter gets the calibration (sweep, its recording, the fan's noise), "cold" where it does not.
    said: the clips in order, with their durations in seconds.
    """

    ref: Samples
    mic: Samples
    echo: Samples
    device: Processing | None
    late: int
    calibration: tuple[Samples, Samples, Samples]
    room: str
    distortion: str
    start: str
    voice: str
    said: list[tuple[Clip, float]]


def make_monologue(
    seed: int, index: int, voice: str, clips: Iterator[Clip], speech_s: float, ask_db: float = 0.0, microphone: str | None = None
) -> Monologue:  # fmt: skip
    """Simulate monologue number `index` of this seed. ask_db: by how much it can lower its voice. The choice of microphone changes nothing else.

    The index decides kind of room, distortion and start, each in turn, and whether the clocks differ, for eight monologues
    yes and for eight no. The microphone's gain is the largest at which neither a sweep in that room has a peak above 0.3 of
    full scale nor the voice one above 0.8.
    """
    rng = np.random.default_rng([seed, index])
    kind, distortion, start = ROOMS[index % 2], tuple(DISTORTION_DB)[index // 2 % 2], STARTS[index // 4 % 2]
    robot = physics.draw_robot(rng)
    room = physics.draw_room(rng, kind, robot.distance_m, robot.direction, rng.uniform(1.0, 1.5))
    first = next(clips)
    trial = read_speech(first)[: round(TRIAL_S * RATE)]
    robot, _ = physics.with_distortion(robot, trial, room.robot, rng.uniform(*DISTORTION_DB[distortion][kind]))
    ppm = rng.choice([-1.0, 1.0]) * math.exp(rng.uniform(*np.log(PPM))) if index // 8 % 2 else 0.0
    lag, volume_db = round(rng.uniform(*LAG_S) * RATE), rng.uniform(-3, 3)
    said = Repertoire(chain([first], clips))
    ref, echo, softer, heard = speak(rng, robot, said, speech_s, room, lag, volume_db, ppm, ask_db)
    excitation = physics.sweep()
    swept = robot.record(excitation, room.robot)
    gain = float(min(0.3 / np.abs(swept).max(), 0.8 / float(np.abs(echo).max())))
    level = math.sqrt(np.mean(np.concatenate([echo[utterance] for utterance in heard]) ** 2))
    fan, spectrum = gain * level * 10 ** (FAN_DB / 20), physics.draw_fan(rng)
    beside, with_sweep, alone = (
        (fan * physics.fan_noise(rng, spectrum, size)).astype(np.float32) for size in (ref.size, swept.size, 8 * RATE)
    )
    swept, late = np.float32(gain) * swept.astype(np.float32) + with_sweep, lag + robot.bulk
    signals = {"sweep_mic": swept, "fan_only": alone, "mic": (gain * echo).astype(np.float32) + beside, "fan": beside}
    signals["clean"] = np.zeros_like(beside)
    drawn, device = np.random.default_rng([seed, index, 1]), None
    if microphone == "processed":
        device = Processing.draw(drawn, signals["mic"])
        signals |= {name: device.whole(signals[name])[0] for name in ("sweep_mic", "fan_only")}
    elif microphone:
        signals = MICROPHONES[microphone](drawn, signals, np.pad(ref, (late, 0))[: ref.size])
    sweep_mic, fan_only, mic = (signals[name].astype(np.float32) for name in RECORDED)
    return Monologue(ref.astype(np.float32), mic, gain * physics.softened(echo, softer, ask_db), device, late,
                     (excitation.astype(np.float32), sweep_mic, fan_only), kind, distortion, start, voice, said.said)  # fmt: skip
