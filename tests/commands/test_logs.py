"""--log-json and --record: what happened, line by line, and everything that it takes to repeat a run."""

import json
import os
import subprocess

import numpy as np
import pytest
import soundfile

from edgefilter import EgoFilter, Profile, enhance
from edgefilter.cli import main
from edgefilter.commands.observers import EventLog
from edgefilter.errors import AudioFileError
from edgefilter.types import Event
from tests.diagnosis.robot_scene import profile
from tests.program import argv


@pytest.fixture
def folder(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    for name in ("mic", "ref"):
        soundfile.write(tmp_path / f"{name}.wav", 0.1 * rng.standard_normal(16_000), 16_000, "FLOAT")
    profile().save(tmp_path / "robot.npz")
    monkeypatch.chdir(tmp_path)
    return tmp_path


RUN = ["run", "--input", "mic.wav", "--reference", "ref.wav", "--engine", "ss", "--no-learn", "--quiet"]


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_each_event_is_on_the_disk_when_it_happens(tmp_path):
    log = EventLog(tmp_path / "log")
    log.hear(Event("learned", 24_000, "the path, 3.1 dB better"))
    found = lines(tmp_path / "log")
    assert [found[0][name] for name in ("time", "kind", "detail")] == [1.5, "learned", "the path, 3.1 dB better"]
    assert found[0]["at"].endswith("+00:00")
    log.close()


def test_a_log_that_takes_no_more_ends_and_the_run_does_not(folder, capsys):
    assert main([*RUN, "--output", "out.wav", "--log-json", "/dev/full"]) == 1
    said = capsys.readouterr().err.splitlines()
    assert "log /dev/full takes no more lines: No space left on device" in said[-1]
    assert soundfile.info("out.wav").frames == 16_000


def test_a_reader_that_went_away_ends_the_log_and_not_the_run(folder):
    command = argv(*RUN, "--output", "out.wav", "--log-json", "-")
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert done.returncode == 1 and "Broken pipe" in done.stderr and "Traceback" not in done.stderr
    assert soundfile.info("out.wav").frames == 16_000


def test_a_record_holds_everything_that_it_takes_to_repeat_the_run(folder, capsys):
    assert main([*RUN, "--profile", "robot.npz", "--output", "out.wav", "--record", "r", "--log-json", "-"]) == 0
    mic, ref, out = (soundfile.read(f"r/{name}.wav", dtype="float32")[0] for name in ("mic", "reference", "output"))
    np.testing.assert_array_equal(mic, soundfile.read("mic.wav", dtype="float32")[0])
    again = enhance(mic, ref, Profile.load("r/profile.npz"), engine="ss")
    np.testing.assert_array_equal(out, again)
    kept, printed = lines(folder / "r/events.jsonl"), capsys.readouterr().out.splitlines()
    assert [line["kind"] for line in kept] == [json.loads(line)["kind"] for line in printed]
    assert kept[0]["kind"] == "started" and kept[0]["engine"] == "ss"
    assert kept[-1]["kind"] == "ended" and kept[-1]["samples_out"] == 16_000 and kept[-1]["time"] == 1.0
    assert json.loads((folder / "r/run.json").read_text())["samples_in"] == 16_000


def test_a_record_is_not_written_over_another(folder, capsys):
    assert main([*RUN, "--output", "out.wav", "--record", "r"]) == 0
    assert not (folder / "r/profile.npz").exists()  # the run had none
    before = {path.name: path.read_bytes() for path in (folder / "r").iterdir()}
    capsys.readouterr()
    assert main([*RUN, "--output", "out.wav", "--record", "r"]) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and "--record r holds mic.wav, reference.wav" in said[0] and "name a new folder" in said[0]
    assert before == {path.name: path.read_bytes() for path in (folder / "r").iterdir()}


def test_a_log_in_a_folder_that_is_not_there_is_one_line_before_the_work(folder, capsys):
    assert main([*RUN, "--output", "out.wav", "--log-json", "no/log"]) == 1
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and "--log-json no/log" in said[0] and not (folder / "out.wav").exists()
    with pytest.raises(AudioFileError, match="log no/log cannot be written: No such file"):
        EventLog("no/log")


def test_what_the_filter_noticed_is_in_the_log(folder):
    """A lag that jumps: the event of the filter, with its time and its words."""
    rng = np.random.default_rng(1)
    robot = 0.2 * rng.standard_normal(6 * 16_000)
    heard = np.concatenate((np.roll(robot, 700)[: 3 * 16_000], np.roll(robot, 1500)[3 * 16_000 :]))
    soundfile.write("mic.wav", heard, 16_000, "FLOAT")
    soundfile.write("ref.wav", robot, 16_000, "FLOAT")
    assert main([*RUN, "--output", "out.wav", "--log-json", "log"]) == 0
    found = [line for line in lines(folder / "log") if line["kind"] == "realigned"]
    ego = EgoFilter(engine="ss")
    ego.process(*(soundfile.read(name, dtype="float32")[0] for name in ("mic.wav", "ref.wav")))
    ego.flush()
    expected = [(round(e.sample / 16_000, 3), e.detail) for e in ego.events() if e.kind == "realigned"]
    assert [(line["time"], line["detail"]) for line in found] == expected and len(found) >= 2
