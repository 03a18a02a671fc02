"""The effects that come with the package, in the order in which they are listed."""

from __future__ import annotations

from edgefilter.echo.effect import Effect, names, register
from edgefilter.echo.effects.bandlimit import Bandlimit
from edgefilter.echo.effects.chassis_resonance import ChassisResonance
from edgefilter.echo.effects.clock_drift import ClockDrift
from edgefilter.echo.effects.compression import Compression
from edgefilter.echo.effects.delay_jump import DelayJump
from edgefilter.echo.effects.fan_noise import FanNoise
from edgefilter.echo.effects.late_reverb import LateReverb
from edgefilter.echo.effects.mic_agc import MicAgc
from edgefilter.echo.effects.mic_clipping import MicClipping
from edgefilter.echo.effects.path_change import PathChange
from edgefilter.echo.effects.playback_gain import PlaybackGain
from edgefilter.echo.effects.rattle import Rattle
from edgefilter.echo.effects.speaker_nonlinearity import SpeakerNonlinearity

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
