"""A day in the life: what is left of the robot over time, with and without learning, while everything changes."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench import results_writer
from bench.measure import picture
from bench.measure.conversation import progress
from bench.measure.levels import above_rumble, frame_power
from bench.simulate.conversations import read_clips
from bench.simulate.robot_day import Day, make_day
from edgefilter import EgoFilter, PathLearner
from edgefilter.calibration.calibrate import calibrate
from edgefilter.types import SAMPLE_RATE

CLIP_S = (1.0, 15.0)
STEP_S = 10
AUDIBLE = 1e-3
"""A second counts as robot speech where the reference's power is within 30 dB of its loudest second's."""
LOUDER_DB = (0.5, 1.0)
STARTS = {"uncalibrated": False, "calibrated": True}
COLOURS = {False: "#888888", True: "#b3412b"}


class Run(NamedTuple):
    """One way through the day.

    left_db: (seconds,) power beside the human, the robot's rest and the fan, over the fan's, in dB. lessons: (second,
    kind, what) of each event of learning.
    """

    left_db: np.ndarray
    lessons: list[tuple[float, str, str]]


def measure(voices: list[Path], speech: Path, minutes: float, seed: int) -> dict:
    """The day run four times, ready for JSON."""
    clips = [clip for folder in voices for clip in read_clips(folder, CLIP_S)]
    day = make_day(seed, minutes, clips, read_clips(speech, CLIP_S))
    profile = calibrate(*day.calibration)
    runs: dict[str, dict] = {}
    for start, learning in progress([(start, learning) for start in STARTS for learning in (False, True)], "run"):
        ego_profile = profile if STARTS[start] else None
        learner = PathLearner(ego_profile) if learning else None
        found = run(day, EgoFilter(ego_profile, "linear", learn=learner))
        runs.setdefault(start, {})["learning" if learning else "alone"] = found._asdict()
    level = frame_power(day.ref, SAMPLE_RATE)
    return {
        "minutes": day.mic.size / SAMPLE_RATE / 60,
        "speech_minutes": day.speech_s / 60,
        "distinct_minutes": day.distinct_s / 60,
        "voices": sorted({clip.speaker for clip in clips}),
        "stages": [
            {"name": name, "begin_s": at / SAMPLE_RATE} for name, at in zip(day.stages, day.begins, strict=True)
        ],
        "speaking": (level > AUDIBLE * level.max()).tolist(),
        "runs": runs,
        "louder": {start: louder(both) for start, both in runs.items()},
    }


def run(day: Day, ego: EgoFilter) -> Run:
    """What that filter leaves of the day."""
    done, lessons = [], []
    for at in range(0, day.mic.size, SAMPLE_RATE):
        done.append(ego.process(day.mic[at : at + SAMPLE_RATE], day.ref[at : at + SAMPLE_RATE]))
        lessons += [
            (event.sample / SAMPLE_RATE, event.kind, event.detail)
            for event in ego.events()
            if event.kind in ("learned", "unlearned")
        ]
    left = above_rumble(np.concatenate((*done, ego.flush())) - day.clean)
    fan = float(np.mean(np.square(above_rumble(day.fan), dtype=np.float64)))
    return Run(np.round(10 * np.log10(frame_power(left, SAMPLE_RATE) / fan), 3), lessons)


def louder(both: dict[str, dict]) -> dict[str, object]:
    """By how much a second with learning is louder than the same second without it."""
    more = both["learning"]["left_db"] - both["alone"]["left_db"]
    return {
        "most_db": float(more.max()),
        "at_s": int(np.argmax(more)),
        "seconds": more.size,
        **{f"above_{bound}_db": int(np.sum(more > bound)) for bound in LOUDER_DB},
    }


def mean_db(left_db: np.ndarray) -> float:
    """Mean power of seconds, in dB; nan where there are none."""
    return float(10 * np.log10(np.mean(10 ** (left_db / 10)))) if left_db.size else float("nan")


def draw(found: dict, output: Path) -> None:
    """What is left per ten seconds, the changes, and when something was learned."""
    figure, axes = picture.panels(len(STARTS), 1, (11, 7))
    speaking = np.array(found["speaking"])
    for axis, (start, both) in zip(axes, found["runs"].items(), strict=True):
        for learning, name in enumerate(("alone", "learning")):
            left = both[name]["left_db"]
            blocks = range(0, left.size, STEP_S)
            means = [mean_db(left[at : at + STEP_S][speaking[at : at + STEP_S]]) for at in blocks]
            label = "with learning" if learning else "without"
            axis.plot([(at + STEP_S / 2) / 60 for at in blocks], means, color=COLOURS[bool(learning)], label=label)
        across = axis.get_xaxis_transform()
        for kind, marker in (("learned", "v"), ("unlearned", "x")):
            times = [second / 60 for second, event, _ in both["learning"]["lessons"] if event == kind]
            label = f"{kind}, {len(times)} times"
            axis.plot(times, [0.96] * len(times), marker, color="#33658a", label=label, transform=across)
        for stage in found["stages"]:
            axis.axvline(stage["begin_s"] / 60, color="black", linewidth=0.6, linestyle=":")
            axis.text(stage["begin_s"] / 60, 1.01, stage["name"], fontsize=7, transform=across)
        axis.set(xlabel="minutes", ylabel="left beside the human, dB over the fan")
        axis.set_title(f"{start}, engine linear, {STEP_S} s each while the robot speaks", pad=18)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    picture.save(figure, output)


def markdown(found: dict, name: str) -> str:
    """What was run, the answer, the stages, and the picture. name: of the picture, without suffix."""
    lines = [
        f"{found['minutes']:.1f} minutes, {found['speech_minutes']:.1f} of them robot speech, of which"
        f" {found['distinct_minutes']:.1f} are distinct: {len(found['voices'])} voices",
        f"({', '.join(found['voices'])}), their sentences repeated in random order. Engine `linear`. A human talks over",
        "about every third utterance. What is left: output less the human, that is the robot's rest, the fan, and what the",
        "filter took from the human, above 120 Hz; dB over the fan.",
        "",
    ]
    lines += results_writer.table(
        ["", "most by which a second is louder with learning", "at", *(f"seconds > {bound} dB" for bound in LOUDER_DB)],
        [
            [
                start,
                f"{of['most_db']:.2f} dB",
                f"{of['at_s']} s",
                *(f"{of[f'above_{bound}_db']} of {of['seconds']}" for bound in LOUDER_DB),
            ]
            for start, of in found["louder"].items()
        ],
    )
    lines += [
        "",
        "The median second in which the robot speaks, by stage, dB over the fan (and what learning changes):",
        "",
    ]
    lines += results_writer.table(
        ["minutes", "change", *(f"{start}{way}" for start in STARTS for way in ("", ", learning"))],
        stage_rows(found),
    )
    for start, both in found["runs"].items():
        kinds = [kind for _, kind, _ in both["learning"]["lessons"]]
        lines += ["", f"{start}: {kinds.count('learned')} lessons taken over, {kinds.count('unlearned')} given back."]
    return "\n".join([*lines, "", f"![left beside the human]({name}.png)", ""])


def stage_rows(found: dict) -> list[list[str]]:
    """A row for each stage, and one for the whole day."""
    speaking = np.array(found["speaking"])
    second = np.arange(speaking.size)
    begins = [stage["begin_s"] for stage in found["stages"]]
    spans = [*zip(begins, [*begins[1:], speaking.size], [s["name"] for s in found["stages"]], strict=True)]
    rows = []
    for begin, end, name in [*spans, (0, speaking.size, "the whole day")]:
        use = speaking & (second >= begin) & (second < end)
        cells = []
        for both in found["runs"].values():
            alone, learning = (np.median(both[way]["left_db"][use]) for way in ("alone", "learning"))
            cells += [f"{alone:.1f}", f"{learning:.1f} ({learning - alone:+.1f})"]
        rows.append([f"{begin / 60:.1f} to {end / 60:.1f}", name, *cells])
    return rows
