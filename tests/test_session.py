"""What a run accounts for, on every system."""

import json
import subprocess
import sys

import numpy as np
import pytest
import soundfile

from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.session import filter_blocks
from edgefilter.types import Block, Event, Turn


@pytest.mark.slow
def test_every_command_starts_where_there_is_no_resource_module(tmp_path):
    """As on Windows."""
    soundfile.write(tmp_path / "mic.wav", np.full(4000, 0.1), 16000)
    words = ["run", "--input", "mic.wav", "--engine", "bypass", "--output", "out.wav", "--json", "-", "--quiet"]
    code = (
        "import sys; sys.modules['resource'] = None\nfrom importlib import import_module\nfrom pathlib import Path\n"
        "from edgefilter.cli import main\nimport_module('edgefilter.filter.timing').STATUS = Path('nowhere')\n"
        "[import_module(f'edgefilter.commands.{name}') for name in 'add calibrate compare demo devices"
        f" diagnose profile remove'.split()]\nsys.exit(main({words!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["peak_memory_mb"] is None


@pytest.mark.parametrize("due", [True, False])
def test_a_recording_which_has_no_deadline_is_not_told_to_be_too_slow_for_it(due):
    told: list[Event] = []
    silence = np.zeros(4096, np.float32)

    class Nowhere:
        def write(self, out: np.ndarray) -> None: ...

    ego = EgoFilter(engine="linear", budget_ms=1e-6)  # which no hop keeps
    report = filter_blocks([Block(silence, silence, 0)] * 3, ego, Nowhere(), tell=told.append, due=due)
    assert [event.kind for event in told] == [event.kind for event in report.events] == ["overloaded"] * due


def test_the_report_of_a_run_keeps_what_happened_without_its_sound():
    """A run may last for weeks, and each turn of the human holds seconds of sound: who is told may keep it."""
    told: list[Event] = []
    spoken = Event("speech_stopped", 320, "", Turn(0, np.ones(320, np.float32)))
    silence = np.zeros(320, np.float32)

    class Nowhere:
        def write(self, out: np.ndarray) -> None: ...

    report = filter_blocks(
        [Block(silence, silence, 0)],
        EgoFilter(engine="bypass"),
        Nowhere(),
        tell=told.append,
        troubles=lambda sample, last: [] if last else [spoken],
    )
    assert told == [spoken] and told[0].turn is spoken.turn
    assert list(report.events) == [spoken] and report.events[0].turn is None


def test_a_verdict_counts_what_the_report_no_longer_keeps():
    """Only the latest thousand events were looked at: of a long run the first minutes were forgotten."""
    block = Block(np.zeros(160, np.float32), np.zeros(160, np.float32), 0)
    said = [Event("reference_late", 0, "it is late"), *[Event("speech_started", 0, "")] * 1500]

    class Nowhere:
        def write(self, out: np.ndarray) -> None: ...

    class Judge(EgoFilter):
        judges_speech = True

    report = filter_blocks(
        [block], Judge(engine="bypass"), Nowhere(), troubles=lambda sample, last: [] if last else said
    )
    assert report.verdict and (report.verdict.noticed, report.verdict.wrong) == (1500, ("at 0.0 s it is late",))
