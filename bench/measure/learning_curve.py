"""What is left of the robot over the seconds for which it has been heard, by what the filter knew when it began."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench import results_writer
from bench.measure import picture
from bench.measure.conversation import progress
from bench.measure.intervals import interval
from bench.measure.levels import above_rumble, frame_power
from bench.simulate.conversations import read_clips
from bench.simulate.robot_rooms import KINDS, Recording, TwoRooms, make_rooms
from edgefilter import EgoFilter, PathLearner, Profile, enhance
from edgefilter.calibration.calibrate import calibrate
from edgefilter.types import SAMPLE_RATE

CLIP_S = (1.0, 15.0)
YESTERDAY_S = 40.0
SHOWN_S = (2, 5, 10, 20)
TENTH = SAMPLE_RATE // 10
AUDIBLE = 1e-3
"""A tenth of a second counts as robot speech where its echo is within 30 dB of the loudest one."""
SYSTEMS = {
    "cold": "#888888",
    "calibrated elsewhere": "#d9a441",
    "calibrated here": "#33658a",
    "learning from nothing": "#b3412b",
    "next day, same room": "#3f7d3a",
    "next day, other room": "#8e4a9e",
}


def measure(voices: list[Path], rooms: int, seconds: float, seed: int) -> dict:
    """A row for each room, ready for JSON; its curves are in dB, one value for each second of robot speech."""
    clips = [clip for folder in voices for clip in read_clips(folder, CLIP_S)]
    rows = []
    for index in progress(range(rooms), "room"):
        scene = make_rooms(seed, index, clips, seconds, YESTERDAY_S)
        rows.append({"room": scene.kind, **systems(scene)})
    shortest = min(curve.size for row in rows for curve in row["curves"].values())
    for row in rows:
        row["curves"] = {name: np.round(curve[:shortest], 3) for name, curve in row["curves"].items()}
    return {"rows": rows, "yesterday_s": YESTERDAY_S}


def systems(scene: TwoRooms) -> dict:
    """The curve of each system, and whether what was learned the day before was worth keeping."""
    here, elsewhere = calibrate(*scene.calibration), calibrate(*scene.calibration_elsewhere)
    same, other = remembered(scene.yesterday), remembered(scene.yesterday_elsewhere)
    starts = zip(SYSTEMS, (None, elsewhere, here, None, same, other), (False,) * 3 + (True,) * 3, strict=True)
    curves = {}
    for name, profile, learning in starts:
        learner = PathLearner(profile) if learning else None
        curves[name] = left(scene.today, enhance(scene.today.mic, scene.today.ref, profile, "linear", learn=learner))
    return {"curves": curves, "remembered": {"same room": same is not None, "other room": other is not None}}


def remembered(recording: Recording) -> Profile | None:
    """What a filter that began with nothing has learned by the end of the recording, as its file says it."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "robot.npz"
        ego = EgoFilter(None, "linear", learn=PathLearner(None, path))
        ego.process(recording.mic, recording.ref)
        ego.flush()
        ego.close()
        return Profile.load(path) if path.exists() else None


def left(recording: Recording, out: np.ndarray) -> np.ndarray:
    """(seconds,) power of the robot's rest against that of its echo, dB, for each second in which it is audible."""
    echo, rest = (frame_power(above_rumble(x), TENTH) for x in (recording.echo, out - recording.fan))
    audible = np.flatnonzero(echo > AUDIBLE * echo.max())
    audible = audible[: audible.size // 10 * 10].reshape(-1, 10)
    return 10 * np.log10(rest[audible].sum(axis=1) / echo[audible].sum(axis=1))


def around(curve: np.ndarray, second: int) -> float:
    """Mean of the seconds before and after."""
    return float(np.mean(curve[second - 1 : second + 1]))


def mean_and_interval(values: list[float]) -> tuple[float, float, float]:
    """Over rooms."""
    return float(np.mean(values)), *interval(lambda draws: draws.mean(axis=1), values)


def draw(found: dict, output: Path) -> None:
    """Mean over rooms and its interval, by seconds of robot speech."""
    figure, (axis,) = picture.panels(1, 1, (9, 5))
    for name, colour in SYSTEMS.items():
        curves = np.array([row["curves"][name] for row in found["rows"]])
        means = np.array([mean_and_interval(values) for values in curves.T])
        seconds = np.arange(curves.shape[1]) + 0.5
        axis.plot(seconds, means[:, 0], color=colour, label=name)
        axis.fill_between(seconds, means[:, 1], means[:, 2], color=colour, alpha=0.12, linewidth=0)
    axis.set(xlabel="seconds of robot speech", ylabel="left of the robot, dB (mean, 95 %)", xlim=(0, None))
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    picture.save(figure, output, dpi=110)


def markdown(found: dict, name: str) -> str:
    """A table for all rooms with intervals, and one for each kind of room. name: of the picture, without suffix."""
    rows = found["rows"]
    length = min(curve.size for row in rows for curve in row["curves"].values())
    shown = [second for second in SHOWN_S if second < length]
    lines = [
        f"{len(rows)} robots, each in a room of its own; another room is an office where this one is a laboratory, and",
        "a laboratory where it is an office. Engine `linear`, the robot alone with its fan. Left of the robot: output less",
        f"fan against the echo, above 120 Hz, dB. Next day: begins with what `--learn` kept of {found['yesterday_s']:.0f} s of robot",
        "speech, and learns on; learning from nothing and cold begin with no profile. After seconds of robot speech",
        "(the second before and the one after), mean over rooms with its 95 % interval:",
        "",
    ]
    cells = []
    for system in SYSTEMS:
        of = [mean_and_interval([around(row["curves"][system], second) for row in rows]) for second in shown]
        cells.append([system, *(f"{mean:.1f} ({low:.1f} to {high:.1f})" for mean, low, high in of)])
    lines += results_writer.table(["", *(f"{second} s" for second in shown)], cells)
    for kind in KINDS:
        own = [row for row in rows if row["room"] == kind]
        if not own:
            continue
        lines += ["", f"Mean of {len(own)} {'laboratories' if kind == 'lab' else 'offices'}:", ""]
        cells = [
            [system, *(f"{np.mean([around(row['curves'][system], second) for row in own]):.1f}" for second in shown)]
            for system in SYSTEMS
        ]
        lines += results_writer.table(["", *(f"{second} s" for second in shown)], cells)
    kept = {room: sum(row["remembered"][room] for row in rows) for room in ("same room", "other room")}
    lines += ["", f"Kept the day before: {', '.join(f'{n} of {len(rows)} in the {room}' for room, n in kept.items())}."]
    return "\n".join([*lines, "", f"![left of the robot]({name}.png)", ""])
