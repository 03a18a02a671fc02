"""Virtual devices in place of all others."""

import sys

import pytest

from edgefilter.audio import port
from tests.audio.virtual_portaudio import CALLBACK_S, VirtualPortAudio


@pytest.fixture
def plug(monkeypatch):
    """A function that puts virtual devices, and their clock, in place of all others."""

    def plug(*devices):
        system = VirtualPortAudio(*devices)
        monkeypatch.setitem(sys.modules, "sounddevice", system)
        monkeypatch.setattr(port, "time", system)
        monkeypatch.setattr(port, "POLL_S", CALLBACK_S / 2)
        return system

    return plug
