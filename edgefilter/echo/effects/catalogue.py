"""The effects that the package knows: its own, in the order in which sound meets them, and those of the user.

A new effect is a file in this folder and a line in EFFECTS. Within a stage effects do not commute (a compressor behind a
turned volume is not one before it), so EchoModel applies them in the order of this list, whichever was found first.
Effects of the user's own come after these within their stage, by name.
"""

from __future__ import annotations

from collections.abc import Iterable

from edgefilter.echo.effect import STAGES, Effect, complete
from edgefilter.echo.effects.bandlimit import Bandlimit
from edgefilter.echo.effects.chassis_resonance import ChassisResonance
from edgefilter.echo.effects.clock_drift import ClockDrift
from edgefilter.echo.effects.codec import Codec
from edgefilter.echo.effects.compression import Compression
from edgefilter.echo.effects.delay_jump import DelayJump
from edgefilter.echo.effects.early_path import EarlyPath
from edgefilter.echo.effects.equaliser import Equaliser
from edgefilter.echo.effects.fan_noise import FanNoise
from edgefilter.echo.effects.free_laws import (
    FreeCurve,
    FreeCurveBehind,
    FreeFilter,
    FreeFilterAhead,
    FreeGain,
    FreeGainBehind,
    FreeLag,
    FreeModulation,
)
from edgefilter.echo.effects.late_reverb import LateReverb
from edgefilter.echo.effects.limiter import Limiter
from edgefilter.echo.effects.mic_agc import MicAgc
from edgefilter.echo.effects.mic_clipping import MicClipping
from edgefilter.echo.effects.multiband_compression import MultibandCompression
from edgefilter.echo.effects.noise_suppression import NoiseSuppression
from edgefilter.echo.effects.packet_loss import PacketLoss
from edgefilter.echo.effects.path_change import PathChange
from edgefilter.echo.effects.playback_gain import PlaybackGain
from edgefilter.echo.effects.rattle import Rattle
from edgefilter.echo.effects.speaker_nonlinearity import SpeakerNonlinearity
from edgefilter.echo.measurement import Values
from edgefilter.errors import UsageError
from edgefilter.types import Array

EFFECTS: tuple[Effect, ...] = (
    FreeFilterAhead(),
    PlaybackGain(),
    Compression(),
    MultibandCompression(),
    Limiter(),
    FreeGain(),
    DelayJump(),
    PacketLoss(),
    Codec(),
    SpeakerNonlinearity(),
    FreeCurve(),
    Rattle(),
    EarlyPath(),
    LateReverb(),
    PathChange(),
    Bandlimit(),
    Equaliser(),
    ChassisResonance(),
    FreeFilter(),
    FreeCurveBehind(),
    FreeGainBehind(),
    FreeModulation(),
    FreeLag(),
    ClockDrift(),
    MicAgc(),
    MicClipping(),
    NoiseSuppression(),
    FanNoise(),
)
"""From the player's volume to the microphone's converter, then the noise."""
_PLACE = {effect.name: place for place, effect in enumerate(EFFECTS)}
_known: dict[str, Effect] = {effect.name: effect for effect in EFFECTS}


def register(effect: Effect) -> None:
    """Make an effect known by its name; load_effect() has checked it."""
    _known[effect.name] = effect


def names() -> tuple[str, ...]:
    """All known effects."""
    return tuple(_known)


def find(name: str) -> Effect:
    """The effect of that name; raises UsageError with the known names."""
    if name not in _known:
        raise UsageError(f"unknown effect '{name}': choose one of {', '.join(sorted(_known))}")
    return _known[name]


def chain(effects: Iterable[tuple[str, Values]]) -> list[tuple[Effect, dict[str, float | Array]]]:
    """Each effect with all of its values, in the order in which they are applied: by stage, then as EFFECTS lists them, then by name."""
    found = [(find(name), values) for name, values in effects]
    found.sort(key=lambda pair: (STAGES.index(pair[0].stage), _PLACE.get(pair[0].name, len(_PLACE)), pair[0].name))
    return [(effect, complete(effect, values)) for effect, values in found]
