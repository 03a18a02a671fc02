"""A run between real streams of a sound server that ends and starts again, beside a second run that is killed."""

import json
import signal
import subprocess
import threading
import time
from pathlib import Path

import pytest
import soundfile

from bench.live import virtual_sound
from tests.program import ROOT, argv

pytestmark = pytest.mark.slow


class Run:
    """`edgefilter run` from the default microphone into NAME.wav; what it says is read as it comes."""

    def __init__(self, server, folder, name):
        self.file, self.json, self.said = folder / f"{name}.wav", folder / f"{name}.json", []
        command = argv(
            "run", "--input", "mic", "--output", self.file, "--engine", "bypass", "--no-learn", "--quiet", "--json", self.json,
        )  # fmt: skip
        self.process = subprocess.Popen(command, env=server.environment, cwd=ROOT, stderr=subprocess.PIPE, text=True)
        self._reader = threading.Thread(target=lambda: self.said.extend(self.process.stderr))
        self._reader.start()

    def size(self):
        return self.file.stat().st_size if self.file.exists() else 0

    def says(self, words):
        return any(words in line for line in list(self.said))

    def end(self, number=None):
        """The exit code after that signal, or after its own end."""
        if number:
            self.process.send_signal(number)
        code = self.process.wait(120)  # a loaded machine starts Python slowly
        self._reader.join()
        assert not self.says("Traceback"), self.said
        return code


def wait_for(condition):
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


def test_a_run_outlives_the_sound_server_and_a_second_run_and_ends_whole_by_a_signal(server, tmp_path):
    first = Run(server, tmp_path, "first")
    wait_for(lambda: first.size() > 10_000)

    same = Run(server, tmp_path, "first")
    assert same.end() == 1
    assert [line for line in same.said if line.startswith("edgefilter:") and "is being written by another" in line]

    second = Run(server, tmp_path, "second")  # one microphone can be heard by two
    wait_for(lambda: second.size() > 32_000)
    second.end(signal.SIGKILL)
    kept = soundfile.info(second.file)
    assert kept.frames * 2 + 44 == second.size() > 32_000  # to the last block, not only to the last second

    server.stop()
    wait_for(lambda: first.says("device gone microphone"))
    again = virtual_sound.start_server(Path(server.environment["HOME"]), system=server.system)
    try:
        wait_for(lambda: first.says("device back microphone"))
        grown = first.size()
        wait_for(lambda: first.size() > grown + 16_000)
        assert first.end(signal.SIGTERM) == 0
    finally:
        again.stop()
    stats = json.loads(first.json.read_text())
    assert stats["samples_in"] == stats["samples_out"] == soundfile.info(first.file).frames
    source = stats["source"]
    assert (source["microphone_gone"], source["microphone_back"]) == (1, 1) and source["microphone_away"] > 2 * 16000
    assert stats["samples_lost"] == source["lost"] >= source["microphone_away"]
