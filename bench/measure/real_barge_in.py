"""When a human who interrupts is noticed, and how often the robot is taken for one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bench.measure.levels import FRAME, frame_power
from edgefilter.filter.barge_in import BargeIn, BargeInSettings
from edgefilter.types import SAMPLE_RATE, Event, Samples

IN_TIME_S = 0.3
"""Somebody who interrupts is to be noticed by then."""
FIRST_DB = 25.0
"""A human's first sound is the first frame within so much of the loudest."""
THRESHOLDS = (0.5, 0.7, 0.8, 0.9, 0.94, 0.96, 0.97, 0.98, 0.985, 0.99, 0.995)
"""Of the probability, from which speech counts as begun: the points of the curve."""


def first_sound(human: Samples) -> int:
    """First sample of the first 20 ms within FIRST_DB of the human's loudest."""
    power = frame_power(human)
    return int(np.flatnonzero(power > 10 ** (-FIRST_DB / 10) * power.max())[0]) * FRAME


def noticed(events: Sequence[Event], onset: int) -> dict:
    """delay_s from the onset to the first speech_started after it, None if there is none.

    early: speech was on already, so nothing is noticed.
    """
    talk = [event for event in events if event.kind.startswith("speech")]
    before = [event.kind for event in talk if event.sample < onset]
    after = [event.sample for event in talk if event.sample >= onset and event.kind == "speech_started"]
    early = bool(before) and before[-1] == "speech_started"
    return {"delay_s": None if early or not after else (after[0] - onset) / SAMPLE_RATE, "early": early}


def in_time(found: dict) -> bool:
    """Whether what `noticed` found is soon enough."""
    return found["delay_s"] is not None and found["delay_s"] <= IN_TIME_S


def starts(events: Sequence[Event]) -> int:
    return sum(event.kind == "speech_started" for event in events)


def replay(probability: Sequence[float | None], hop: int, threshold: float) -> list[Event]:
    """The events that the package would give at another threshold, one value a hop of so many samples."""
    usual = BargeInSettings()
    rule = BargeIn(hop / SAMPLE_RATE, replace(usual, threshold=threshold, release=min(usual.release, threshold)))
    found = ((index * hop, rule.note(value)) for index, value in enumerate(probability, start=1))
    return [Event(kind, sample, "replayed") for sample, kind in found if kind]
