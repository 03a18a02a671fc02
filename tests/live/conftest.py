"""Servers of virtual sound devices, PulseAudio and PipeWire: two null sinks, seen by PortAudio by the names robot, robot_mic
and their monitors."""

import os
import subprocess
from contextlib import ExitStack

import pytest

from bench.live import virtual_sound

ON_BOTH = ("test_devices", "test_virtual_microphone", "test_play")
"""Modules whose tests run on both systems always; the others, of minutes, on PipeWire where EDGEFILTER_LIVE=all is set."""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "new_server" in metafunc.fixturenames:
        both = metafunc.module.__name__.endswith(ON_BOTH) or os.environ.get("EDGEFILTER_LIVE") == "all"
        metafunc.parametrize("new_server", virtual_sound.SYSTEMS[: 1 + both], indirect=True)


@pytest.fixture
def new_server(request):
    """A function that starts a server of its own, with other sinks where they are given; all are ended afterwards."""
    with ExitStack() as stack:
        yield lambda *sinks, channels=1: stack.enter_context(
            virtual_sound.server(sinks or virtual_sound.SINKS, request.param, channels)
        )


@pytest.fixture
def server(new_server):
    return new_server()


@pytest.fixture
def loopback(server):
    """The microphone hears what the output plays."""
    words = ("source=robot.monitor", "sink=robot_mic", "latency_msec=60", "adjust_time=0")
    subprocess.run(["pactl", "load-module", "module-loopback", *words], env=server.environment, check=True)
    return server
