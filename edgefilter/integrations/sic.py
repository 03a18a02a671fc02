"""Social Interaction Cloud: a component that takes a robot's microphone and what it says, and gives the human and barge-in.

    python -m edgefilter.integrations.sic --profile robot.npz        # beside the robot's own component manager

    human = Human(input_source=pepper.mic)
    human.register_callback(on_human)                   # AudioMessage, and SpeechMessage when the human begins or ends
    human.request(AudioRequest(wave, rate), block=False)                  # what is sent to the loudspeaker, too

Needs `pip install '.[sic]'` in a checkout, and the framework's Redis server.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import redis
from sic_framework import SICComponentManager
from sic_framework.core.component_python2 import SICComponent
from sic_framework.core.connector import SICConnector
from sic_framework.core.message_python2 import AudioMessage, AudioRequest, SICConfMessage, SICMessage, SICRequest
from sic_framework.core.utils import is_sic_instance

from edgefilter.audio.channels import Channels
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.filter.barge_in import BargeInSettings
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.integrations.duplex import Duplex
from edgefilter.options import ASK, CONFIRM, ENGINE, FALSE_STARTS, MIC_CHANNELS
from edgefilter.types import SAMPLE_RATE, Event


def _options(words: list[str] | None = None) -> dict[str, Any]:
    """What a command line says of the filter, as keywords of _ears."""
    parser = argparse.ArgumentParser(prog="python -m edgefilter.integrations.sic", description=__doc__.splitlines()[0])
    parser.add_argument("--profile", help="the calibrated robot")
    parser.add_argument("--engine", **ENGINE)
    parser.add_argument("--channels", type=int, default=1, help="of the microphone's sound, interleaved")
    parser.add_argument("--mic-channels", **MIC_CHANNELS)
    parser.add_argument("--confirm-s", **CONFIRM)
    parser.add_argument("--false-starts-per-hour", **FALSE_STARTS)
    parser.add_argument("--ask-db", **ASK)
    return vars(parser.parse_args(words))


_default = _options([])


@dataclass(eq=False, repr=False)
class HumanConf(SICConfMessage):
    """Options of `Human(conf=...)`; those left out are taken from the component's command line.

    profile: file of the calibrated robot, on the component's machine. engine: as in `EgoFilter`. channels: how many the
    microphone's sound interleaves, which its messages do not tell. mic_channels: as in `Duplex`. confirm_s, ask_db,
    threshold: as in `BargeInSettings`.
    """

    profile: str | None = None
    engine: str | None = None
    channels: int | None = None
    mic_channels: Sequence[int] | None = None
    confirm_s: float | None = None
    ask_db: float | None = None
    threshold: float | None = None


def _ears(
    profile: str | None,
    engine: str,
    channels: int,
    mic_channels: Sequence[int] | Channels | None,
    confirm_s: float,
    threshold: float,
    ask_db: float,
    on_event: Callable[[Event], None] | None = None,
) -> tuple[Duplex, int]:
    """The filter for a microphone of so many channels, and their number; raises EdgefilterError where it cannot be made."""
    if channels < 1:
        raise UsageError(f"channels is {channels}, expected at least 1")
    array = Channels.named(mic_channels, there=channels)
    settings = BargeInSettings(threshold, confirm_s=confirm_s, judge="network", ask_db=ask_db)
    ego = EgoFilter(profile, engine=engine, barge_in=settings)
    return Duplex(ego, on_event=on_event, mic_channels=array), channels


class SpeechMessage(SICMessage):
    """The human began or stopped speaking, the robot should lower its voice, or something was connected wrongly.

    kind, detail: of the `edgefilter.Event`; the detail of "voice_gain" is the gain. seconds: of the microphone. is_speaking:
    whether the human speaks now; None for events of other kinds.
    """

    def __init__(self, event: Event) -> None:
        super().__init__()
        self.kind, self.detail = event.kind, event.detail
        self.seconds = event.sample / SAMPLE_RATE
        self.is_speaking = {"speech_started": True, "speech_stopped": False}.get(event.kind)


class SilencedRequest(SICRequest):
    """Tell the component that the robot fell silent in mid-word: what was not played yet is no reference."""


class HumanComponent(SICComponent):
    """Takes AudioMessage of the microphone, AudioRequest of what is said, and sends AudioMessage and SpeechMessage."""

    COMPONENT_STARTUP_TIMEOUT = 10

    def __init__(self, *words: object, **more: object) -> None:
        super().__init__(*words, **more)
        said = {name: value for name, value in vars(self.params).items() if name in _default and value is not None}
        self._duplex, self._channels = _ears(**_default | said, on_event=self._tell)

    @staticmethod
    def get_conf() -> HumanConf:
        """Return what is meant without a configuration."""
        return HumanConf()

    @staticmethod
    def get_inputs() -> list[type]:
        """Return the types of message that are taken."""
        return [AudioMessage]

    @staticmethod
    def get_output() -> type:
        """Return the type of the sound that is sent."""
        return AudioMessage

    def start(self) -> None:
        """Serve until the manager says that it is over."""
        super().start()
        self._signal_to_stop.wait()
        self._stopped.set()

    def on_message(self, message: AudioMessage) -> None:
        """Filter what the microphone heard, and send what is finished."""
        human = self._duplex.hear_pcm16(bytes(message.waveform), message.sample_rate, self._channels, 1)
        if human:
            answer = AudioMessage(human, sample_rate=message.sample_rate)
            answer._timestamp = message._timestamp
            self.output_message(answer)

    def on_request(self, request: SICRequest) -> SICMessage:
        """Take what is said as the reference, or its end."""
        if is_sic_instance(request, AudioRequest):
            self._duplex.play_pcm16(bytes(request.waveform), request.sample_rate)
        elif is_sic_instance(request, SilencedRequest):
            self._duplex.interrupt()
        else:
            raise NotImplementedError(f"found {type(request).__name__}, expected AudioRequest or SilencedRequest")
        return SICMessage()

    def _tell(self, event: Event) -> None:
        message = SpeechMessage(event)
        message._timestamp = self._get_timestamp()
        self.output_message(message)

    def _cleanup(self) -> None:
        self._duplex.close()


class Human(SICConnector):
    """The component for a program: `Human(input_source=microphone)`."""

    component_class = HumanComponent
    component_group = "Edgefilter"


def main(words: list[str] | None = None) -> int:
    """Serve the component where it is asked for; one line and exit code 1 where that fails."""
    _default.update(_options(words))
    try:
        _ears(**_default)  # what cannot be made is said now
        manager = SICComponentManager([HumanComponent], component_group=Human.component_group, auto_serve=False)
    except (redis.exceptions.RedisError, EdgefilterError, OSError) as error:
        of_redis = isinstance(error, redis.exceptions.RedisError)
        what = "the Redis server of DB_IP, DB_PORT and DB_PASS cannot be reached: " if of_redis else ""
        print(f"edgefilter: {what}{error}", file=sys.stderr)
        return 1
    print(f"serving HumanComponent at {manager.ip}", file=sys.stderr)
    manager.serve()
    return 0


if __name__ == "__main__":
    # messages are known by the module that they are of, which is not __main__
    sys.exit(importlib.import_module("edgefilter.integrations.sic").main())
