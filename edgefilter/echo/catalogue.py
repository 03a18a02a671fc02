"""The effects that come with the package, in the order in which they are listed."""

from __future__ import annotations

from edgefilter.echo.bandlimit import Bandlimit
from edgefilter.echo.chassis_resonance import ChassisResonance
from edgefilter.echo.clock_drift import ClockDrift
from edgefilter.echo.compression import Compression
from edgefilter.echo.delay_jump import DelayJump
from edgefilter.echo.effect import Effect, names, register
from edgefilter.echo.fan_noise import FanNoise
from edgefilter.echo.late_reverb import LateReverb
from edgefilter.echo.loudspeaker import SpeakerNonlinearity
from edgefilter.echo.mic_agc import MicAgc
from edgefilter.echo.mic_clipping import MicClipping
from edgefilter.echo.path_change import PathChange
from edgefilter.echo.playback_gain import PlaybackGain
from edgefilter.echo.rattle import Rattle

EFFECTS: tuple[Effect, ...] = (
    PlaybackGain(),
    SpeakerNonlinearity(),
    Compression(),
    ClockDrift(),
    DelayJump(),
    MicAgc(),
    MicClipping(),
    Bandlimit(),
    ChassisResonance(),
    LateReverb(),
    PathChange(),
    Rattle(),
    FanNoise(),
)


def load() -> None:
    """Register all of them, once."""
    for effect in EFFECTS:
        if effect.name not in names():
            register(effect)
