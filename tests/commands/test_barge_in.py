"""A human who interrupts: the user's command is run beside the sound, and what cannot work is said."""

import os
import subprocess
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile

from edgefilter import BargeInSettings, EgoFilter, UsageError
from edgefilter.cli import main
from edgefilter.commands import observers
from edgefilter.commands.observers import Availability, EventCommand, Lowering
from edgefilter.filter.barge_in import INTERRUPTIONS, SUSPICIONS
from edgefilter.session import Progress
from edgefilter.types import Event
from tests.program import DEMO, argv

GAIN = Event("voice_gain", 24000, "0.250")
STARTED, STOPPED = (Event(f"speech_{word}", 24000, "probability 0.98") for word in ("started", "stopped"))


SUSPECTED, DISMISSED = (Event(f"speech_{word}", 24000, "probability 0.98") for word in ("suspected", "dismissed"))


@pytest.mark.parametrize(
    ("kinds", "told"),
    [(INTERRUPTIONS, ["started", "started"]), (SUSPICIONS, ["suspected", "dismissed"])],
)
def test_the_command_is_run_once_for_each_event_of_its_kinds_and_told_what_happened(kinds, told, tmp_path):
    said, file = [], tmp_path / "told"
    command = f'echo "$EDGEFILTER_EVENT $EDGEFILTER_TIME $EDGEFILTER_DETAIL" >> {file}; cat >> {file}'
    with EventCommand("--on-barge-in", kinds, command, said.append) as reaction:
        for event in (SUSPECTED, STARTED, STOPPED, Event("realigned", 0, ""), DISMISSED, STARTED):
            reaction.hear(event)
    lines = file.read_text().splitlines()
    assert sorted(lines) == sorted(f"speech_{word} 1.500 probability 0.98" for word in told) and not said


def test_the_sound_does_not_wait_for_the_command_and_what_it_prints_is_no_sound(capfd):
    began = time.monotonic()
    with EventCommand("--on-barge-in", INTERRUPTIONS, "sleep 0.3; echo heard", lambda text: None) as reaction:
        reaction.hear(STARTED)
        assert time.monotonic() - began < 0.2
    out, err = capfd.readouterr()
    assert (out, err) == ("", "heard\n")


@pytest.mark.parametrize(("command", "code"), [("exit 3", "ended with 3"), ("/no/such/program 2>/dev/null", "127")])
def test_a_command_that_fails_is_one_line(command, code):
    said = []
    with EventCommand("--on-barge-in", INTERRUPTIONS, command, said.append) as reaction:
        reaction.hear(STARTED)
    assert len(said) == 1 and code in said[0] and command in said[0]


def test_a_command_that_does_not_end_is_killed_with_its_children_and_not_multiplied(tmp_path, monkeypatch):
    monkeypatch.setattr(observers, "PATIENCE_S", 0.3)
    monkeypatch.setattr(observers, "MOST_AT_ONCE", 2)
    said, alive = [], tmp_path / "alive"
    with EventCommand("--on-barge-in", INTERRUPTIONS, f"(sleep 1; touch {alive}) & wait", said.append) as reaction:
        for _ in range(3):
            reaction.hear(STARTED)
        time.sleep(0.2)
    killed = [text for text in said if "killed" in text]
    assert len(killed) == 2 and len([text for text in said if "not run, 2 earlier ones" in text]) == 1
    time.sleep(1.0)
    assert not alive.exists()


@pytest.mark.parametrize(
    ("how", "gains"),
    [("stop", [0.25, 0.0, 0.0, 0.0]), ("duck", [0.25, 10**-0.5, 10**-0.5, 1.0]), (None, [0.25, 1.0, 1.0, 1.0])],
)
def test_the_robot_is_lowered_while_the_filter_asks_for_it_and_stopped_for_good_or_lowered_while_the_human_speaks(
    how, gains
):
    faded, heard, ego = [], [], SimpleNamespace()
    lowering = Lowering(faded.append, ego, how)
    for event, gain in ((GAIN, 0.25), (STARTED, 1.0), (GAIN, 1.0), (STOPPED, 1.0)):
        ego.voice_gain = gain
        lowering.hear(event)
        heard.append(faded[-1])
    assert heard == pytest.approx(gains)
    assert all(one != other for one, other in zip(faded, faded[1:]))  # a sound server is not told twice


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (
            "run",
            ["--input", DEMO / "mic.flac", "--reference", DEMO / "reference.flac", "--output", "-", "--engine", "crnn"],
        ),
        ("serve", []),
        ("ros2", []),
    ],
)
@pytest.mark.parametrize("given", [[], ["--false-starts-per-hour", "9"]], ids=["default", "9"])
def test_a_rate_of_false_starts_is_the_threshold_of_the_filter(command, words, given, monkeypatch):
    made = []

    def make(*args, barge_in, **others):
        made.append(barge_in)
        raise UsageError("that is all")

    monkeypatch.setattr(f"edgefilter.commands.{command}.EgoFilter", make)
    assert main([command, *map(str, words), *given]) == 2
    assert [one.threshold for one in made] == [(BargeInSettings.at_rate(9.0) if given else BargeInSettings()).threshold]


def test_an_engine_that_tells_no_speech_is_said_once_and_one_that_does_is_not():
    for engine, expected in (("bypass", 1), ("crnn", 0)):
        said = []
        ego = EgoFilter(engine=engine)
        availability = Availability(ego, said.append)
        for samples in (100, 1000, 2000):
            block = np.zeros(samples - ego.stats()["samples"], np.float32)
            ego.process(block, block)
            availability.show(Progress(samples=samples))
        assert len(said) == expected and all(
            "engine bypass does not tell whether somebody speaks" in text for text in said
        )


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--input", "mic", "--on-barge-in", " "], "' ' is not a command"),
        (["--input", "mic", "--false-starts-per-hour", "90"], "'90' is not a rate above 0 and below 90 an hour"),
        (["--input", "mic", "--barge-in", "stop"], "--barge-in concerns the speech that --play plays"),
        (["--input", "mic", "--barge-in", "shout", "--play", "x.wav"], "'shout'"),
        (["--input", "mic", "--speaker", "x"], "--speaker concerns"),
        (
            ["--input", str(DEMO / "mic.flac"), "--reference", str(DEMO / "reference.flac"), "--ask-db", "12"],
            "found a recording",
        ),
        (["--input", "-", "--play", "x.wav"], "found --input -"),
        (["--input", "mic", "--reference", "monitor", "--play", "x.wav"], "found --reference monitor"),
        (["--input", "mic", "--play", ""], "is not the name of a file"),
    ],
)
def test_what_cannot_be_meant_is_one_line(words, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["run", *words, "--output", "out.wav"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and expected in lines[0] and not list(tmp_path.iterdir())


def test_speech_that_is_no_sound_is_one_line(tmp_path, capsys):
    (tmp_path / "speech.wav").write_text("hello")
    words = ["run", "--input", "mic", "--play", str(tmp_path / "speech.wav"), "--output", str(tmp_path / "out.wav")]
    assert main(words) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and "is not audio" in lines[0]


def test_a_machine_that_starts_no_more_threads_is_one_line_and_the_sound_goes_on(monkeypatch):
    def refuse(thread):
        raise RuntimeError("can't start new thread")

    said = []
    with EventCommand("--on-barge-in", INTERRUPTIONS, "true", said.append) as reaction:
        monkeypatch.setattr(threading.Thread, "start", refuse)
        reaction.hear(STARTED)
        monkeypatch.undo()
    assert said == ["--on-barge-in: cannot be run (can't start new thread): true"]


@pytest.mark.slow
def test_a_terminal_that_goes_away_does_not_cost_the_run_a_sample(tmp_path):
    """Nobody reads standard error any more, and an event is to be told there."""
    rng = np.random.default_rng(1)
    robot = 0.2 * rng.standard_normal(6 * 16_000)
    heard = np.concatenate((np.roll(robot, 700)[: 3 * 16_000], np.roll(robot, 1500)[3 * 16_000 :]))
    soundfile.write(tmp_path / "mic.wav", heard, 16_000, "FLOAT")
    soundfile.write(tmp_path / "ref.wav", robot, 16_000, "FLOAT")
    read, write = os.pipe()
    os.close(read)
    words = ["--input", "mic.wav", "--reference", "ref.wav", "--engine", "linear", "--output", "out.wav"]
    done = subprocess.run(argv("run", *words), cwd=tmp_path, stderr=write)
    os.close(write)
    assert done.returncode == 0 and soundfile.info(tmp_path / "out.wav").frames == 6 * 16_000
