"""Rooms: what is left of the robot over the seconds for which it spoke, by what the filter knew when it began.

--count robots, each in a room of its own (another room is an office where this one is a laboratory, and the other way
round); engine `linear`, the robot alone with its fan. Next day: begins with what `--learn` kept of YESTERDAY_S of robot
speech, and learns on. Left of the robot: output less fan against the echo, above 120 Hz, dB. A minute of one core a room.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench import results
from bench.live.day import CLIP_S, above_rumble
from bench.metrics import frame_power, mean
from bench.recordings import progress
from bench.simulate.conversations import read_clips
from bench.simulate.robot_day import Recording, TwoRooms, make_rooms
from edgefilter import EgoFilter, PathLearner, Profile, enhance
from edgefilter.calibration.calibrate import calibrate
from edgefilter.types import SAMPLE_RATE

TODAY_S, YESTERDAY_S = 24.0, 40.0
SHOWN_S = (2, 5, 10, 20)
TENTH = SAMPLE_RATE // 10
AUDIBLE = 1e-3
"""A tenth of a second counts as robot speech where its echo is within 30 dB of the loudest one."""
SYSTEMS = (
    "cold",
    "calibrated elsewhere",
    "calibrated here",
    "learning from nothing",
    "next day, same room",
    "next day, other room",
)
ENGINE = "linear"


def run(options: argparse.Namespace) -> str:
    """A row for each room, and its curves, one value for each second of robot speech."""
    made_with = results.stamp({"ROBOT": options.voices}, [ENGINE])
    clips = [clip for folder in options.voices for clip in read_clips(folder, CLIP_S)]
    rooms = []
    for index in progress(range(options.count), "room"):
        scene = make_rooms(options.seed, index, clips, TODAY_S, YESTERDAY_S)
        rooms.append({"room": scene.kind, "curves": curves(scene)})
    length = min(curve.size for room in rooms for curve in room["curves"].values())
    seconds = np.arange(length) + 0.5
    lines = {name: (seconds, np.mean([room["curves"][name][:length] for room in rooms], axis=0)) for name in SYSTEMS}
    panel = results.panel(f"mean of {len(rooms)} rooms", "seconds of robot speech", "left of the robot, dB", lines)
    tables = []
    for kind in ("all", "lab", "office"):
        own = [room["curves"] for room in rooms if kind in ("all", room["room"])]
        if own:
            shown = [at for at in SHOWN_S if at < length]
            rows = [[name, *(_around([room[name] for room in own], at) for at in shown)] for name in SYSTEMS]
            title = f"Left of the robot, dB: {len(own)} rooms, {kind}"
            tables.append(results.table(f"rooms-{kind}", title, ["", *((f"{at} s", 1) for at in shown)], rows))
    title = "Learning over seconds of robot speech"
    return results.write(
        options.output, "rooms", title, made_with, tables, [results.plot("rooms", [panel])], rooms=rooms
    )


def curves(scene: TwoRooms) -> dict[str, np.ndarray]:
    """What each system leaves, dB a second."""
    here, elsewhere = calibrate(*scene.calibration), calibrate(*scene.calibration_elsewhere)
    same, other = remembered(scene.yesterday), remembered(scene.yesterday_elsewhere)
    found = {}
    for name, profile in zip(SYSTEMS, (None, elsewhere, here, None, same, other), strict=True):
        learner = PathLearner(profile) if name in SYSTEMS[3:] else None
        out = enhance(scene.today.mic, scene.today.ref, profile, ENGINE, learn=learner)
        found[name] = np.round(left(scene.today, out), 3)
    return found


def remembered(recording: Recording) -> Profile | None:
    """What a filter that began with nothing has learned by the end of the recording, as its file says it."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "robot.npz"
        ego = EgoFilter(None, ENGINE, learn=PathLearner(None, path))
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


def _around(curves: list[np.ndarray], second: int) -> dict | None:
    """Mean over rooms of the seconds before and after, with its interval."""
    return mean([{"left": float(np.mean(curve[second - 1 : second + 1]))} for curve in curves], "left")
