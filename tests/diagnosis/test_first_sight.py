"""What a diagnosis says within a second or two: which families of effects are there, and how much each explains."""

import numpy as np
import pytest

from edgefilter.diagnosis.recording import Recording
from edgefilter.echo.model import EchoModel
from edgefilter.report.text import first_sight_line
from tests.diagnosis.robot_scene import office, path, profile, record, voice

TREMBLE = {"rate_hz": 6.0, "mean": 1.0, "waves": np.array([0.4, 0, 0, 0, 0, 0, 0, 0])}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "seen"),
    [
        (EchoModel(path()), []),
        (EchoModel(path()).with_effect("playback_gain", {"gain_db": -3.0}), ["volume"]),
        (office(), ["linear path"]),
        (EchoModel(path()).with_effect("free_modulation", TREMBLE), ["modulation"]),
        (office().with_effect("playback_gain", {"gain_db": -6.0}), ["volume", "linear path"]),
    ],
    ids=["nothing", "volume", "room", "tremolo", "room and volume"],
)
def test_the_families_that_are_there_are_seen_the_largest_first(robot, seen):
    x = voice(8.0)
    found = Recording(record(x, robot), x, profile()).at_first_sight()
    assert list(found)[: len(seen)] == seen and bool(found) == bool(seen)
    assert list(found.values()) == sorted(found.values(), reverse=True)


def test_it_is_one_line():
    assert first_sight_line({"volume": 3.84, "linear path": 1.14}) == "at first sight volume 3.8 dB, linear path 1.1 dB"
    assert "no family" in first_sight_line({})
