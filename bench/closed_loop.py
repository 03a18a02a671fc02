"""Run the filter over a recording hop by hop, as live; the recorded robot may lower its voice when the filter asks for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import soundfile

from bench.simulate.microphones import Processing, Stream
from edgefilter import EgoFilter, Event, Profile
from edgefilter.closed_loop import closed_loop
from edgefilter.filter.barge_in import BargeInSettings
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Samples


class Output(NamedTuple):
    """What a system made of a clip.

    samples: (n,), aligned with the clip. events, probability: what it said, and how likely it found a human after each hop (hop
    samples); None for a system that does not judge who speaks.
    """

    samples: Samples
    events: list[Event] | None = None
    probability: list[float] | None = None
    hop: int = 0


class Robot(NamedTuple):
    """A robot that lowers its voice by ask_db when the filter asks for it.

    echo: (n,), its voice as the microphone recorded it or, of a simulated loudspeaker, which distorts less when softer, what `softened`
    returns. late: delay of the echo behind the reference, samples.
    file: where to write what it plays (left) and what its microphone hears (right). device: the microphone's own processing.
    """

    echo: Samples
    late: int
    ask_db: float
    file: Path | None = None
    device: Processing | None = None


class Behind:
    """A filter behind a device that processes what the microphone hears."""

    def __init__(self, ego: EgoFilter, device: Processing) -> None:
        self._ego, self._device = ego, Stream(device)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._ego, name)

    def process(self, mic: Samples, ref: Samples) -> Samples:
        """Like the filter's `process`; mic (n,) is overwritten with the device's output."""
        mic[:] = np.clip(self._device(mic)[0], -1.0, 1.0)
        return self._ego.process(mic, ref)


def listen(
    mic: Samples, ref: Samples, profile: Profile | None, engine: str, robot: Robot | None = None, **more: Any
) -> Output:
    """Run the filter over mic (n,) or (n, microphones) and ref (n,); more: further arguments of EgoFilter."""
    mic, ref = np.array(mic, np.float32), np.array(ref, np.float32)
    robot = robot or Robot(np.zeros_like(mic), 0, 0.0)
    ego: Any = EgoFilter(profile, engine=engine, barge_in=BargeInSettings(ask_db=robot.ask_db), **more)
    ego = Behind(ego, robot.device) if robot.device else ego
    done, probability = [], []
    for out in closed_loop(ego, mic, ref, robot.echo, robot.late):
        done.append(out)
        probability.append(ego.speech_probability or 0.0)
    if robot.file:
        soundfile.write(robot.file, np.stack((ref, mic), axis=1), SAMPLE_RATE)
    out = np.concatenate((*done, ego.flush()))
    if ego.speech_probability is None:
        return Output(out)
    return Output(out, ego.events(), probability, ego.hop)


def recorded(mic: Samples, ref: Samples, ask_db: float) -> Robot | None:
    """A robot that was recorded alone: all of the recording mic (n,) counts as its echo; None where the filter does not find its lag sharply."""
    ego = EgoFilter(engine="linear")
    ego.process(mic, ref)
    found = ego.stats()["alignment"]
    late, wide = (found["delay_samples"], found["deviation_samples"]) if found else (None, None)
    return None if late is None or wide is None or wide > PRE_ROLL else Robot(mic, round(late), ask_db)
