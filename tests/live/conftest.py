"""Servers of virtual sound devices: two null sinks, seen by PortAudio by the names robot, robot_mic and their monitors."""

import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "bench"))

import virtual_sound  # noqa: E402


@pytest.fixture
def new_server():
    """A function that starts a server of its own; all are ended afterwards."""
    with ExitStack() as stack:
        yield lambda: stack.enter_context(virtual_sound.server())


@pytest.fixture
def server(new_server):
    return new_server()
