"""The clips on which a system does worst: what was said, what was heard, how it sounds, and what the diagnosis says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bench.evaluate.clips import Clip, Heard
from bench.evaluate.figures import Results
from bench.evaluate.slices import metric_of, whole
from bench.evaluate.systems import System
from edgefilter.calibration.from_recording import self_calibrate
from edgefilter.diagnosis.diagnose import diagnose
from edgefilter.errors import EdgefilterError
from edgefilter.report.media import colour_scale, sound, spectrogram_png
from edgefilter.report.text import headline, in_order
from edgefilter.types import SAMPLE_RATE, Samples

COUNT = 10
PREFERRED = ("crnn", "ss", "linear", "crnn-uncalibrated", "ss-uncalibrated", "linear-uncalibrated")
"""Whose worst clips are looked at: the first of these that ran, our own best foot."""
LEAD_S = 2.0
"""Robot alone before the human that is heard and seen."""


@dataclass(frozen=True)
class Piece:
    """One sound of a worst clip: its name, its picture and itself as data addresses."""

    name: str
    picture: str
    sound: str


def looked_at(results: Results) -> System | None:
    """The system whose failures are shown; the first without a preferred one."""
    ran = {system.name: system for system in results.systems}
    return next((ran[name] for name in PREFERRED if name in ran), next(iter(ran.values()), None))


def worst(results: Results, count: int = COUNT) -> list[int]:
    """The clips by how badly it does, worst first; equal ones by SI-SDR."""
    system = looked_at(results)
    if system is None:
        return []
    metric = metric_of(results)
    members, values = whole(results).column(system.name, metric)
    ratios = [results.value(index, system.name, "si_sdr") or 0.0 for index in members]
    bad = values if metric == "capped" else -values
    order = sorted(range(len(members)), key=lambda at: (-bad[at], ratios[at]))
    return [members[at] for at in order[:count]]


def show(results: Results, index: int) -> dict:
    """All that the page has of one clip."""
    clip, system = results.clips[index], looked_at(results)
    heard = Heard(clip)
    if system is None or not heard.has_human:
        raise EdgefilterError(f"{clip.name} has no human to listen for")
    span = heard.source.span
    seen = slice(max(span.start - round(LEAD_S * SAMPLE_RATE), 0), span.stop)
    sounds = {"Microphone": heard.mic, system.title: system.run(heard), "The human alone": heard.human}
    return {
        "name": f"{clip.name}, {clip.set}, {clip.room}",
        "said": clip.text,
        "heard": heard_by(results, index),
        "facts": results.rows[index]["facts"],
        "seconds": (seen.stop - seen.start) / SAMPLE_RATE,
        "human_s": (span.start - seen.start) / SAMPLE_RATE,
        "pieces": [_piece(name, samples[seen]) for name, samples in sounds.items()],
        "diagnosis": diagnosis(clip, heard),
    }


def heard_by(results: Results, index: int) -> list[dict]:
    """What the first recogniser heard of each system's output, and the word error rate."""
    found = []
    for system in results.systems:
        words: Mapping = results.rows[index].get(system.name, {}).get("words", {})
        if results.recognisers and results.recognisers[0] in words:
            one = words[results.recognisers[0]]
            found.append({"system": system.title, "heard": one["heard"], "wer": 100 * one["errors"] / one["words"]})
    return found


def _piece(name: str, samples: Samples) -> Piece:
    """Each on its own scale and at the same peak: the human is 20 dB below the microphone."""
    peak = max(float(np.abs(samples).max(initial=0.0)), 1e-6)
    return Piece(name, spectrogram_png(samples, colour_scale(samples)), sound(samples, 0.9 / peak))


def diagnosis(clip: Clip, heard: Heard) -> str:
    """In one sentence what the tool says of the recording, as a user would hear it."""
    try:
        ref, profile = heard.source.read("ref"), heard.source.profile
        found = diagnose(profile or self_calibrate(heard.mic, ref), heard.mic, ref)
    except EdgefilterError as error:
        return f"Declined: {error}"
    effects = [finding.effect for finding in in_order(found.ranking)]
    return headline(found.verdict, effects, profile is not None)
