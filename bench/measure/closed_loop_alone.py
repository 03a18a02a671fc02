"""False stops: the robot alone, simulated in ever new rooms, and as one real loudspeaker was recorded."""

from __future__ import annotations

import math
from collections import Counter
from itertools import cycle, islice
from pathlib import Path

import numpy as np

from bench.measure.closed_loop_scenes import Talk, listen
from bench.measure.conversation import progress
from bench.measure.kept_rows import KeptRows
from bench.measure.real_barge_in import THRESHOLDS, replay, starts
from bench.measure.real_streams import ECHO_ONLY, ROBOT_ALONE, chosen, find_recordings
from bench.simulate.conversations import read_voices
from bench.simulate.robot_alone import Monologue, make_monologue
from edgefilter.calibration.calibrate import calibrate
from edgefilter.types import SAMPLE_RATE

MONOLOGUE_S = 60.0
"""Of robot speech, before the next robot begins in the next room."""
AUDIBLE = 1e-3
"""A second of a real recording counts as speech where the reference is within 30 dB of its loudest second."""


def monologues(folders: list[Path], minutes: float, seed: int, engine: str, kept: KeptRows) -> list[dict]:
    """A row for each robot, until they have spoken for so many minutes; each voice goes on where it stopped."""
    voices = read_voices(folders) if folders else {}
    order = np.random.default_rng(seed)
    clips = {name: [found[i] for i in order.permutation(len(found))] for name, found in voices.items()}
    names, rows, taken = sorted(clips), [], Counter[str]()
    length = min(MONOLOGUE_S, 60 * minutes)
    count = math.ceil(60 * minutes / length) if names and minutes > 0 else 0
    for index in progress(range(count), "monologue"):
        voice = names[index % len(names)]
        own = islice(cycle(clips[voice]), taken[voice], None)
        row = kept.get(
            f"monologue {index} of {length} s",
            lambda i=index, v=voice, c=own: monologue(make_monologue(seed, i, v, c, length), engine),
        )
        taken[voice] += len(row["said"])
        rows.append(row)
    return rows


def monologue(made: Monologue, engine: str) -> dict:
    """What the filter notices of one robot alone."""
    talk = listen(made.mic, made.ref, calibrate(*made.calibration) if made.start == "calibrated" else None, engine)
    said = [[f"{clip.path.parent.name}/{clip.path.stem}", s] for clip, s in zip(made.clips, made.seconds, strict=True)]
    of = {"room": made.room, "distortion": made.distortion, "start": made.start, "voice": made.voice}
    return {"source": "simulated", **of, "said": said, **stops(talk, sum(made.seconds))}


def real_minutes(folder: Path, engine: str) -> list[dict]:
    """A row for each recording of the reporting half without a human."""
    found = [r for r in chosen(find_recordings(folder, ROBOT_ALONE), "report", "*") if r.kind == ECHO_ONLY]
    rows = []
    for recording in progress(found):
        mic, ref, _, _ = recording.signals()
        seconds = ref[: ref.size // SAMPLE_RATE * SAMPLE_RATE].reshape(-1, SAMPLE_RATE)
        power = np.mean(seconds.astype(np.float64) ** 2, axis=1)
        speech_s = float(np.sum(power > AUDIBLE * power.max()))
        row = {"source": "real", "room": "real", "distortion": "real", "start": "cold", "voice": "recorded"}
        rows.append({**row, "said": [[recording.name, speech_s]], **stops(listen(mic, ref, None, engine), speech_s)})
    return rows


def stops(talk: Talk, speech_s: float) -> dict:
    """How often the robot was stopped by itself, and how often it would have been at each of THRESHOLDS."""
    at_each = [starts(replay(talk.probability, talk.hop, at)) for at in THRESHOLDS]
    found = [event.sample / SAMPLE_RATE for event in talk.events if event.kind == "speech_started"]
    return {"speech_s": speech_s, "stops": len(found), "at_s": found, "stops_at": at_each}
