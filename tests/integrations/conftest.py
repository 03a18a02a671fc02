"""The examples' simulated room, imported as they import it, and a filter whose reference can be looked at."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from edgefilter import EgoFilter

EXAMPLES = Path(__file__).parents[2] / "docs/examples"


class Watched(EgoFilter):
    """Keeps the reference that it got."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.references = []

    def process(self, mic_block, ref_block):
        self.references.append(ref_block)
        return super().process(mic_block, ref_block)


@pytest.fixture(scope="session")
def example():
    """Imports a program of docs/examples as a module."""
    if str(EXAMPLES) not in sys.path:
        sys.path.append(str(EXAMPLES))
    return importlib.import_module


@pytest.fixture(scope="session")
def room_of(example):
    return example("room")


@pytest.fixture
def ego(room_of):
    return Watched(room_of.PROFILE)


@pytest.fixture
def check_conversation(room_of):
    """What each example must show: the human is noticed, the robot stops, the reference is what was played."""

    def check(log, room, stats, references, human_at_s):
        told = {what.split(":")[0]: seconds for seconds, what in log}
        assert human_at_s < told["the human speaks"] < human_at_s + 1.0, log  # 0.2 to 0.3 s where the machine is idle
        played, said = (np.trim_zeros(np.concatenate(parts)) for parts in (room.played, references))
        whole = room_of.ROBOT.size
        assert human_at_s * 16_000 < played.size < 0.85 * whole, "cut off in mid-word"
        both = min(played.size, said.size)
        np.testing.assert_array_equal(played[:both], said[:both])
        assert abs(played.size - said.size) < 0.3 * 16_000  # what the loudspeaker's buffer holds, and a frame
        assert stats["played_s"] * 16_000 == pytest.approx(said.size, abs=0.1 * 16_000)

    return check
