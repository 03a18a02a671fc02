"""A day: what is left of the robot over time, with learning and without, while room, volume, place and clocks change.

--minutes of robot speech of bench/simulate/robot_day.py, a human interrupting; engine `linear`, uncalibrated and
calibrated, as files with the learner in the same process (0.6 minutes of one core for each minute of speech). What is
left: output less the human, that is the robot's rest, the fan, and what the filter took from the human, above 120 Hz, dB
over the fan.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping

import numpy as np
from scipy import signal

from bench import results
from bench.metrics import frame_power
from bench.recordings import progress
from bench.simulate.conversations import read_clips
from bench.simulate.robot_day import Day, make_day
from edgefilter import EgoFilter, PathLearner
from edgefilter.calibration.calibrate import calibrate
from edgefilter.types import SAMPLE_RATE, Samples

CLIP_S = (1.0, 15.0)
STEP_S = 10
AUDIBLE = 1e-3
"""A second counts as robot speech where the reference's power is within 30 dB of its loudest second's."""
LOUDER_DB = (0.5, 1.0)
WAYS = {"uncalibrated": (False, False), "uncalibrated, learning": (False, True),
        "calibrated": (True, False), "calibrated, learning": (True, True)}  # fmt: skip
RUMBLE = signal.butter(4, 120.0, "high", fs=SAMPLE_RATE, output="sos")


def above_rumble(x: Samples) -> Samples:
    """The part of x (n,) above 120 Hz, where no voice is lost: without a profile the filter lowers what lies below 90 Hz."""
    return signal.sosfilt(RUMBLE, x).astype(np.float32)


def run(options: argparse.Namespace) -> str:
    """The day run four times."""
    engine = options.engine or "linear"
    made_with = results.stamp({"ROBOT": options.voices, "HUMAN": [options.speech]}, [engine])
    clips = [clip for folder in options.voices for clip in read_clips(folder, CLIP_S)]
    day = make_day(options.seed, options.minutes, clips, read_clips(options.speech, CLIP_S))
    profile = calibrate(*day.calibration)
    found = {}
    for way in progress(list(WAYS), "run"):
        calibrated, learning = WAYS[way]
        known = profile if calibrated else None
        found[way] = listen(day, EgoFilter(known, engine, learn=PathLearner(known) if learning else None))
    level = frame_power(day.ref, SAMPLE_RATE)
    speaking = level > AUDIBLE * level.max()
    begins = [at / SAMPLE_RATE for at in day.begins]
    notes = f"{day.mic.size / SAMPLE_RATE / 60:.1f} minutes, {day.speech_s / 60:.1f} of them robot speech, of which" \
        f" {day.distinct_s / 60:.1f} are distinct; {len({clip.speaker for clip in clips})} voices; engine `{engine}`."  # fmt: skip
    curves = {way: _curve(one["left_db"], speaking) for way, one in found.items()}
    panel = results.panel(f"while the robot speaks, {STEP_S} s each", "minutes", "left, dB over the fan", curves)
    return results.write(
        options.output, "day", "A day with learning", made_with, tables(day.stages, begins, speaking, found),
        [results.plot("day", [panel])], notes, runs=found, speaking=speaking, begins_s=begins, stages=day.stages,
        speech_minutes=day.speech_s / 60, distinct_minutes=day.distinct_s / 60,
    )  # fmt: skip


def listen(day: Day, ego: EgoFilter) -> dict:
    """left_db (seconds,): what that filter leaves of the day; lessons: (second, learned or unlearned, what)."""
    done, lessons = [], []
    for at in range(0, day.mic.size, SAMPLE_RATE):
        done.append(ego.process(day.mic[at : at + SAMPLE_RATE], day.ref[at : at + SAMPLE_RATE]))
        events = [event for event in ego.events() if event.kind in ("learned", "unlearned")]
        lessons += [(event.sample / SAMPLE_RATE, event.kind, event.detail) for event in events]
    left = above_rumble(np.concatenate((*done, ego.flush())) - day.clean)
    fan = float(np.mean(np.square(above_rumble(day.fan), dtype=np.float64)))
    return {"left_db": np.round(10 * np.log10(frame_power(left, SAMPLE_RATE) / fan), 3), "lessons": lessons}


def tables(
    stages: tuple[str, ...], begins: list[float], speaking: np.ndarray, found: Mapping[str, Mapping]
) -> list[dict]:
    """The median second by stage, and by how much learning makes a second louder."""
    second, ends = np.arange(speaking.size), [*begins[1:], speaking.size]
    spans = [*zip(begins, ends, stages, strict=True), (0, speaking.size, "the whole day")]
    rows = []
    for begin, end, stage in spans:
        use = speaking & (second >= begin) & (second < end)
        medians = [float(np.median(one["left_db"][use])) if use.any() else None for one in found.values()]
        rows.append([f"{begin / 60:.1f} to {end / 60:.1f}", stage, *medians])
    louder = []
    for start in ("uncalibrated", "calibrated"):
        learning = found[f"{start}, learning"]
        more = learning["left_db"] - found[start]["left_db"]
        kinds = [kind for _, kind, _ in learning["lessons"]]
        counts = [f"{int(np.sum(more > bound))} of {more.size}" for bound in LOUDER_DB]
        louder.append(
            [start, float(more.max()), int(np.argmax(more)), *counts, kinds.count("learned"), kinds.count("unlearned")]
        )
    columns = ["", ("most by which a second is louder with learning, dB", 2), "at, s"]
    columns += [*(f"seconds > {bound} dB" for bound in LOUDER_DB), "taken over", "given back"]
    return [
        results.table("day", "The median second in which the robot speaks, dB over the fan",
                      ["minutes", "change", *((way, 1) for way in found)], rows),
        results.table("day-louder", "What learning costs", columns, louder),
    ]  # fmt: skip


def _curve(left_db: np.ndarray, speaking: np.ndarray) -> tuple[list[float], list[float | None]]:
    """Minutes, and the mean power of STEP_S seconds in which the robot speaks, dB."""
    at = range(0, left_db.size, STEP_S)
    parts = [left_db[i : i + STEP_S][speaking[i : i + STEP_S]] for i in at]
    return [i / 60 for i in at], [float(10 * np.log10(np.mean(10 ** (p / 10)))) if p.size else None for p in parts]
