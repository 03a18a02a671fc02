"""Servers of virtual sound devices, PulseAudio and PipeWire: two null sinks, seen by PortAudio by the names robot, robot_mic
and their monitors."""

from contextlib import ExitStack

import pytest

from bench.live import virtual_sound


@pytest.fixture(params=virtual_sound.SYSTEMS)
def new_server(request):
    """A function that starts a server of its own, with other sinks where they are given; all are ended afterwards."""
    with ExitStack() as stack:
        yield lambda *sinks: stack.enter_context(virtual_sound.server(sinks or virtual_sound.SINKS, request.param))


@pytest.fixture
def server(new_server):
    return new_server()
