"""Run the filter over a recording hop by hop, as live; the recorded robot may lower its voice when the filter asks for it (closed loop)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import soundfile

from edgefilter import EgoFilter, Event, Profile
from edgefilter.audio.fade import Fade
from edgefilter.filter.barge_in import BargeInSettings
from edgefilter.types import SAMPLE_RATE, Samples


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

    echo: (n,), its voice as the microphone recorded it; late: delay of the echo behind the reference, samples. file: where to
    write what it plays (left) and what its microphone hears (right).
    """

    echo: Samples
    late: int
    ask_db: float
    file: Path | None = None


def listen(
    mic: Samples, ref: Samples, profile: Profile | None, engine: str, robot: Robot | None = None, **more: Any
) -> Output:
    """Run the filter over mic (n,) or (n, microphones) and ref (n,); more: further arguments of EgoFilter."""
    ego = EgoFilter(profile, engine=engine, barge_in=BargeInSettings(ask_db=robot.ask_db) if robot else None, **more)
    mic, ref = mic.astype(np.float32), ref.astype(np.float32)
    fade, gains, done, probability = Fade(), np.ones(ref.size, np.float32), [], []
    for at in range(0, ref.size, ego.hop):
        block = slice(at, min(at + ego.hop, ref.size))
        if robot:
            fade.wanted = ego.voice_gain
            gains[block] = fade.apply(gains[block], SAMPLE_RATE)
            then = np.arange(block.start, block.stop) - robot.late
            mic[block] += (np.where(then < 0, 1.0, gains[then]) - 1.0).astype(np.float32) * robot.echo[block]
        done.append(ego.process(mic[block], gains[block] * ref[block]))
        probability.append(ego.speech_probability)
    if robot and robot.file:
        soundfile.write(robot.file, np.stack((gains * ref, mic), axis=1), SAMPLE_RATE)
    out = np.concatenate((*done, ego.flush()))
    if ego.speech_probability is None:
        return Output(out)
    return Output(out, ego.events(), [value or 0.0 for value in probability], ego.hop)


def recorded(mic: Samples, ref: Samples, ask_db: float) -> Robot | None:
    """A robot that was recorded alone: all of the recording mic (n,) counts as its echo; None where the filter does not find its lag."""
    ego = EgoFilter(engine="linear")
    ego.process(mic, ref)
    found = ego.stats()["alignment"]
    late = found["delay_samples"] if found else None
    return None if late is None else Robot(mic, round(late), ask_db)
