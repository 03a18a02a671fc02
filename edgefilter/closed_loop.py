"""A recorded robot that does what the filter asks: it lowers its voice, or stops, and the microphone hears it so (closed loop)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from edgefilter.audio.fade import Fade
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.types import SAMPLE_RATE, Samples

ASK_DB = 12.0
"""By how much a robot lowers its voice to hear whether a human interrupts it: what people do when another begins to talk."""


def closed_loop(
    ego: EgoFilter, mic: Samples, reference: Samples, echo: Samples, late: int, stops: bool = False
) -> Iterator[Samples]:
    """Filter a recording hop by hop while its robot speaks with `EgoFilter.voice_gain`; yields the filtered sound of each hop.

    mic: (n,) or (n, microphones), and reference: (n,), float32, hold afterwards what was heard and played, up to that hop.
    echo: like mic, the robot's voice in it. late: delay of the echo behind the reference, samples. stops: whether the robot is
    silent while the human speaks.
    """
    fade, gains = Fade(), np.ones(reference.size, np.float32)
    for at in range(0, reference.size, ego.hop):
        block = slice(at, min(at + ego.hop, reference.size))
        fade.wanted = 0.0 if stops and ego.human_speaks else ego.voice_gain
        gains[block] = fade.apply(gains[block], SAMPLE_RATE)
        then = np.arange(block.start, block.stop) - late
        change = (np.where(then < 0, 1.0, gains[then]) - 1.0).astype(np.float32)
        mic[block] += change.reshape(-1, *[1] * (mic.ndim - 1)) * echo[block]
        reference[block] *= gains[block]
        yield ego.process(mic[block], reference[block])
