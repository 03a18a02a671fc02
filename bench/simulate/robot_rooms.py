"""One simulated robot in two rooms, alone: recordings of yesterday in both and of today in one, and a calibration in both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.simulate.conversations import Clip
from bench.simulate.robot_day import (
    DISTORTION_DB,
    Repertoire,
    Stage,
    calibration,
    draw_microphone,
    loudness,
    speak,
)
from bench.simulate.simulated_robot import RATE, draw_robot, draw_room, with_distortion
from edgefilter.types import Samples

LAG_S = (0.05, 0.3)
KINDS = ("lab", "office")


@dataclass(frozen=True)
class Recording:
    """Reference, echo and fan, (n,) float32 each."""

    ref: Samples
    echo: Samples
    fan: Samples

    @property
    def mic(self) -> Samples:
        """What the microphone hears."""
        return self.echo + self.fan


@dataclass(frozen=True)
class TwoRooms:
    """today, yesterday and calibration take place in this room (of that kind), the others in the other one."""

    kind: str
    today: Recording
    yesterday: Recording
    yesterday_elsewhere: Recording
    calibration: tuple[Samples, Samples, Samples]
    calibration_elsewhere: tuple[Samples, Samples, Samples]


def make_rooms(seed: int, index: int, clips: list[Clip], today_s: float, yesterday_s: float) -> TwoRooms:
    """Robot number index: today in the laboratory where index is even, else in the office.

    today_s, yesterday_s: seconds of robot speech; no clip is heard in two of the recordings before all were heard.
    """
    rng = np.random.default_rng([seed, index])
    kind, other = (KINDS[(index + i) % 2] for i in (0, 1))
    robot, human_m = draw_robot(rng), rng.uniform(1.0, 1.5)
    here, elsewhere = (draw_room(rng, of, robot.distance_m, robot.direction, human_m) for of in (kind, other))
    repertoire = Repertoire(rng, clips)
    robot, _ = with_distortion(robot, next(repertoire), here.robot, DISTORTION_DB)
    spoken = []
    for room, seconds in ((here, today_s), (here, yesterday_s), (elsewhere, yesterday_s)):
        stage = Stage(kind, room, round(rng.uniform(*LAG_S) * RATE))
        spoken.append(speak(rng, robot, repertoire, stage, seconds))
    level = loudness(spoken[0][1], spoken[0][2])
    microphone = draw_microphone(rng, robot, here, max(float(np.abs(echo).max()) for _, echo, _ in spoken), level)
    recordings = [
        Recording(
            ref.astype(np.float32), (microphone.gain * echo).astype(np.float32), microphone.hears_fan(rng, ref.size)
        )
        for ref, echo, _ in spoken
    ]
    return TwoRooms(kind, *recordings, *(calibration(rng, robot, room, microphone) for room in (here, elsewhere)))
