"""The filter over a recording, hop by hop as live, and in a closed loop with a robot that lowers its voice where the filter asks for it."""

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
    """What a system made of a clip: samples (n,), aligned with it.

    events, and the human's probability after each hop of so many samples; None where it does not tell who speaks.
    """

    samples: Samples
    events: list[Event] | None = None
    probability: list[float] | None = None
    hop: int = 0


class Robot(NamedTuple):
    """A robot that lowers its voice by ask_db where the filter asks for it.

    echo: of the microphone, (n,), what it says; late: samples by which that is later than in the reference. file: for what it
    plays and its microphone hears, in stereo.
    """

    echo: Samples
    late: int
    ask_db: float
    file: Path | None = None


def listen(
    mic: Samples, ref: Samples, profile: Profile | None, engine: str, robot: Robot | None = None, **more: Any
) -> Output:
    """What the filter makes of mic (n,) or (n, microphones) and ref (n,); more: as of EgoFilter."""
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
    """A robot that was recorded alone, with all that its recording mic holds, as late as the filter finds it; None where it does not."""
    ego = EgoFilter(engine="linear")
    ego.process(mic, ref)
    found = ego.stats()["alignment"]
    late = found["delay_samples"] if found else None
    return None if late is None else Robot(mic, round(late), ask_db)
