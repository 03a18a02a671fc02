"""What the robot says while somebody speaks: the speech of `edgefilter run --play`, and that of other programs."""

import json
import subprocess
import time

import numpy as np
import pytest
import soundfile

from tests.live.arrived import arrived
from tests.program import DEMO, ROOT, argv

pytestmark = pytest.mark.slow


def share(sound, whole):
    """Which part of the pieces of 20 ms that are loud in sound stand in whole, bit by bit.

    All of them do on an idle machine; a busy one tears gaps into what is played.
    """
    pieces = [piece for piece in sound[: sound.size // 320 * 320].reshape(-1, 320) if np.abs(piece).max() > 1000]
    assert len(pieces) > 4
    return np.mean([piece.astype("<i2").tobytes() in whole.tobytes() for piece in pieces])


def write_room(folder):
    """The human who interrupts, 1.75 s from before his first word on, and a microphone's own noise, 20 s."""
    human = 10 * soundfile.read(DEMO / "human.flac", dtype="float32")[0]
    begins = int(np.argmax(np.abs(human) > 0.1))
    soundfile.write(folder / "human.wav", human[begins - 4000 : begins + 24_000], 16_000, "PCM_16")
    noise = 1e-4 * np.random.default_rng(0).standard_normal(20 * 16_000)
    soundfile.write(folder / "noise.wav", noise, 16_000, "PCM_16")


def wait_until_heard(live, folder, seconds):
    """Return once a run that records has heard so many seconds, or has ended."""
    heard = folder / "heard/mic.wav"
    while live.poll() is None and not (heard.exists() and heard.stat().st_size > seconds * 64_000):
        time.sleep(0.05)


def test_the_played_speech_is_the_reference_is_lowered_to_hear_who_speaks_and_ends_when_the_human_does(
    loopback, tmp_path
):
    speech = soundfile.read(DEMO / "reference.flac", dtype="int16")[0][:48_000]
    robot = np.tile(speech, 3) | 1  # no sample is zero, so that silence is where nothing is played
    soundfile.write(tmp_path / "robot.wav", robot, 16_000, "PCM_16")
    write_room(tmp_path)
    loudspeaker = subprocess.Popen(
        ["parec", "-d", "robot.monitor", "--rate=16000", "--channels=1", "--format=s16le", "--latency-msec=50", "--raw", tmp_path / "heard.raw"],
        env=loopback.environment,
    )  # fmt: skip
    room = subprocess.Popen(["paplay", "-d", "robot_mic", tmp_path / "noise.wav"], env=loopback.environment)
    live = subprocess.Popen(
        argv(
            "run", "--input", "mic", "--play", tmp_path / "robot.wav", "--barge-in", "stop", "--engine", "crnn",
            "--ask-db", 12, "--no-learn", "--on-barge-in", f"echo $EDGEFILTER_TIME >> {tmp_path}/noticed", "--seconds", 6,
            "--record", tmp_path / "heard", "--output", tmp_path / "out.wav",
        ),
        env=loopback.environment, cwd=ROOT, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    wait_until_heard(live, tmp_path, 2)
    subprocess.run(["paplay", "-d", "robot_mic", tmp_path / "human.wav"], env=loopback.environment, check=True)
    _, said = live.communicate(timeout=60)
    for process in (loudspeaker, room):
        process.terminate(), process.wait()
    from_loudspeaker = np.fromfile(tmp_path / "heard.raw", "<i2")
    assert live.returncode == 0 and "what is played on" in said, said

    events = [json.loads(line) for line in (tmp_path / "heard/events.jsonl").read_text().splitlines()]
    noticed = next(event["time"] for event in events if event["kind"] == "speech_started")
    assert float((tmp_path / "noticed").read_text().split()[0]) == noticed
    asked = next(event for event in events if event["kind"] == "voice_gain")
    assert float(asked["detail"]) == pytest.approx(0.25, abs=0.01) and asked["time"] < noticed
    reference = np.rint(32768 * soundfile.read(tmp_path / "heard/reference.wav", dtype="float32")[0]).astype("<i2")
    first, ended = (int(at) for at in np.flatnonzero(reference)[[0, -1]])
    assert -0.05 < ended / 16_000 - noticed < 2.0  # what is noticed was played before; a busy machine is behind
    assert ended < reference.size - 8000 and ended - first < robot.size - 16_000  # else it would go on to the end
    assert share(reference[first + 8000 : ended - 400], robot) > 0.3
    if loopback.system == "pulseaudio":
        assert share(from_loudspeaker, reference) > 0.3
    else:  # whose graph runs at 48 kHz: no sample stays what it is
        assert arrived(from_loudspeaker.astype(np.float32), reference[first:ended].astype(np.float32)) > 0.95


def test_what_another_program_plays_is_lowered_to_hear_who_speaks_and_is_as_loud_as_before_afterwards(
    loopback, tmp_path
):
    said = soundfile.read(DEMO / "reference.flac", dtype="float32")[0]
    robot = sum(
        np.roll(said, turn) for turn in range(0, said.size, 11_000)
    )  # never pauses: only a robot that talks is asked
    soundfile.write(tmp_path / "robot.wav", 0.3 * np.tile(robot, 3) / np.abs(robot).max(), 16_000, "PCM_16")
    write_room(tmp_path)
    programs = [
        subprocess.Popen(["paplay", "-d", sink, tmp_path / f"{name}.wav"], env=loopback.environment)
        for sink, name in (("robot_mic", "noise"), ("robot", "robot"))
    ]

    def volumes():
        listed = subprocess.run(
            ["pactl", "list", "sink-inputs"], env=loopback.environment, capture_output=True, text=True
        )
        return [line for line in listed.stdout.splitlines() if "Volume" in line]

    live = subprocess.Popen(
        argv(
            "run", "--input", "mic", "--engine", "crnn", "--ask-db", 12, "--no-learn", "--seconds", 7,
            "--record", tmp_path / "heard", "--output", tmp_path / "out.wav",
        ),
        env=loopback.environment, cwd=ROOT, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    wait_until_heard(live, tmp_path, 3)
    before = volumes()
    subprocess.run(["paplay", "-d", "robot_mic", tmp_path / "human.wav"], env=loopback.environment, check=True)
    _, told = live.communicate(timeout=60)
    after = volumes()
    for program in programs:
        program.terminate(), program.wait()
    assert live.returncode == 0 and "reference: robot.monitor" in told, told

    events = [json.loads(line) for line in (tmp_path / "heard/events.jsonl").read_text().splitlines()]
    kinds = [event["kind"] for event in events]
    assert "speech_started" in kinds[kinds.index("voice_gain") :], kinds
    asked = next(event["time"] for event in events if event["kind"] == "voice_gain")
    reference = soundfile.read(tmp_path / "heard/reference.wav", dtype="float32")[0]
    # of 0.1 s; the robot's own level never falls below 0.7 of its median, and a busy machine is late
    levels = np.sqrt(np.convolve(np.square(reference), np.ones(1600) / 1600, "valid"))
    at = round(16_000 * asked)
    lowered = int(np.argmin(levels[at - 1600 : at + 16_000])) - 1600
    assert levels[at + lowered] < 0.5 * np.median(levels), (lowered, levels[at + lowered])
    assert levels[at + lowered : at + lowered + 16_000].max() > 0.7 * np.median(levels)
    assert before == after and len(after) > 1, (before, after)
