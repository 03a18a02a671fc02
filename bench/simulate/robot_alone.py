"""The robot talking to nobody, in ever new rooms: what must not be taken for somebody who interrupts."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from bench.simulate.conversations import DISTORTION_DB, Clip, read_speech
from bench.simulate.robot_day import Stage, calibration, draw_microphone, loudness, speak
from bench.simulate.simulated_robot import RATE, Array, draw_robot, draw_room, with_distortion
from edgefilter.types import Samples

ROOMS, DISTORTIONS, STARTS = ("lab", "office"), tuple(DISTORTION_DB), ("calibrated", "cold")
LAG_S, PPM = (0.02, 1.0), (10.0, 300.0)
TRIAL_S = 6.0
"""Of the robot's voice, to which its distortion is set."""


@dataclass(frozen=True)
class Monologue:
    """One robot in one room, from the filter's first moment on.

    ref, mic: (n,) float32. start: whether the filter has the calibration (sweep, its recording, the fan). clips: what
    was said, in order, and how many seconds each.
    """

    ref: Samples
    mic: Samples
    calibration: tuple[Samples, Samples, Samples]
    room: str
    distortion: str
    start: str
    voice: str
    clips: list[Clip]
    seconds: list[float]


class Said(Iterator[Array]):
    """Clips one after the other, each with a peak of 0.7, and a list of those that were taken, with their seconds."""

    def __init__(self, clips: Iterator[Clip]) -> None:
        self._clips = clips
        self.clips: list[Clip] = []
        self.seconds: list[float] = []

    def __next__(self) -> Array:
        self.clips.append(next(self._clips))
        speech = read_speech(self.clips[-1])
        self.seconds.append(speech.size / RATE)
        return 0.7 * speech / np.abs(speech).max()


def make_monologue(seed: int, index: int, voice: str, clips: Iterator[Clip], speech_s: float) -> Monologue:
    """Number index of this seed, in which the voice says the next of its clips: rooms, distortions, starts in turn.

    The lag is constant; in every other block of eight the clocks differ.
    """
    rng = np.random.default_rng([seed, index])
    kind, distortion, start = ROOMS[index % 2], DISTORTIONS[index // 2 % 2], STARTS[index // 4 % 2]
    robot = draw_robot(rng)
    room = draw_room(rng, kind, robot.distance_m, robot.direction, rng.uniform(1.0, 1.5))
    first = next(clips)
    trial = read_speech(first)[: round(TRIAL_S * RATE)]
    robot, _ = with_distortion(robot, trial, room.robot, rng.uniform(*DISTORTION_DB[distortion][kind]))
    ppm = rng.choice([-1.0, 1.0]) * math.exp(rng.uniform(*np.log(PPM))) if index // 8 % 2 else 0.0
    stage = Stage(kind, room, round(rng.uniform(*LAG_S) * RATE), rng.uniform(-3, 3), ppm)
    said = Said(chain([first], clips))
    ref, echo, heard = speak(rng, robot, said, stage, speech_s)
    microphone = draw_microphone(rng, robot, room, float(np.abs(echo).max()), loudness(echo, heard))
    mic = (microphone.gain * echo).astype(np.float32) + microphone.hears_fan(rng, ref.size)
    sweeps = calibration(rng, robot, room, microphone)
    return Monologue(ref.astype(np.float32), mic, sweeps, kind, distortion, start, voice, said.clips, said.seconds)
