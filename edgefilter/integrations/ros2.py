"""ROS 2 by the wire protocol that its nodes speak (DDS), so that no installation of ROS is needed: the node /edgefilter.

Needs `pip install '.[ros2]'` in a checkout.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float32, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from edgefilter.audio.channels import Channels
from edgefilter.errors import DeviceError, SignalError, UsageError
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.integrations.duplex import Duplex
from edgefilter.types import SET_UP_WRONG, Event

QUEUE = 200
"""Messages of a topic that wait: 4 s of 20 ms."""


@dataclass
class AudioData(IdlStruct, typename="audio_common_msgs::msg::dds_::AudioData_"):  # type: ignore[call-arg]
    """audio_common_msgs/AudioData, as ROS 2 nodes name it on the wire; so are those below."""

    data: sequence[uint8]


@dataclass
class Empty(IdlStruct, typename="std_msgs::msg::dds_::Empty_"):  # type: ignore[call-arg]
    """std_msgs/Empty; no structure is empty on the wire."""

    structure_needs_at_least_one_member: uint8 = 0


@dataclass
class Bool(IdlStruct, typename="std_msgs::msg::dds_::Bool_"):  # type: ignore[call-arg]
    """std_msgs/Bool."""

    data: bool


@dataclass
class Float32(IdlStruct, typename="std_msgs::msg::dds_::Float32_"):  # type: ignore[call-arg]
    """std_msgs/Float32."""

    data: float32


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):  # type: ignore[call-arg]
    """builtin_interfaces/Time."""

    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):  # type: ignore[call-arg]
    """std_msgs/Header."""

    stamp: Time
    frame_id: str


@dataclass
class KeyValue(IdlStruct, typename="diagnostic_msgs::msg::dds_::KeyValue_"):  # type: ignore[call-arg]
    """diagnostic_msgs/KeyValue."""

    key: str
    value: str


@dataclass
class DiagnosticStatus(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticStatus_"):  # type: ignore[call-arg]
    """diagnostic_msgs/DiagnosticStatus."""

    level: uint8
    name: str
    message: str
    hardware_id: str
    values: sequence[KeyValue]


@dataclass
class DiagnosticArray(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticArray_"):  # type: ignore[call-arg]
    """diagnostic_msgs/DiagnosticArray."""

    header: Header
    status: sequence[DiagnosticStatus]


@dataclass(frozen=True)
class Topics:
    """Names of what comes in and goes out.

    rate: Hz, of the microphone's and the reference's 16-bit samples. channels: of the microphone's. reference_channels:
    of the reference's topic, None for as many as the microphone's. array: which channels of the microphone's topic are the
    microphones of an array, and which one is the reference, in place of its topic. The output then has one channel,
    otherwise as many as came in, all of them the filtered mean.
    """

    mic: str
    reference: str
    silenced: str
    human: str
    rate: int
    channels: int
    reference_channels: int | None
    array: Channels | None


class Node:
    """The filter between topics: /human, /barge_in, /voice_gain and /diagnostics out. domain: of DDS, ROS_DOMAIN_ID."""

    def __init__(self, ego: EgoFilter, topics: Topics, domain: int) -> None:
        self._topics = topics
        array = Channels.named(topics.array, there=topics.channels)
        self.duplex = Duplex(ego, on_event=self._tell, mic_channels=array)
        self._wrong: dict[str, str] = {}
        self._stop = threading.Event()
        try:
            participant = DomainParticipant(domain)
        except DDSException as error:
            raise DeviceError(f"domain {domain} of DDS cannot be joined: {error}; choose 0 to 232") from None
        # best effort hears reliable writers and others; reliable is heard by both
        hears = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(QUEUE))
        says = Qos(Policy.Reliability.Reliable(duration(milliseconds=100)), Policy.History.KeepLast(QUEUE))

        def topic(name: str, kind: type[IdlStruct]) -> Topic:
            if not name.startswith("/"):
                raise UsageError(f"topic '{name}' does not begin with a slash: give its whole name, such as /{name}")
            return Topic(participant, f"rt{name}", kind)

        self._mic = DataReader(participant, topic(topics.mic, AudioData), qos=hears)
        self._reference = DataReader(participant, topic(topics.reference, AudioData), qos=hears)
        self._silenced = DataReader(participant, topic(topics.silenced, Empty), qos=hears)
        self._human = DataWriter(participant, topic(topics.human, AudioData), qos=says)
        self._barge_in = DataWriter(participant, topic("/barge_in", Bool), qos=says)
        self._voice_gain = DataWriter(participant, topic("/voice_gain", Float32), qos=says)
        self._diagnostics = DataWriter(participant, topic("/diagnostics", DiagnosticArray), qos=says)

    def stop(self) -> None:
        """End `run` soon; may be called from a signal handler."""
        self._stop.set()

    def run(self, say: Callable[[str], None]) -> None:
        """Serve until `stop`; say: told what cannot be read, a line each."""
        reported = 0.0
        while not self._stop.is_set():
            busy = self._look(say)
            if time.monotonic() - reported >= 1.0:  # as diagnostics come in ROS
                reported = time.monotonic()
                self._report()
            if not busy:
                self._stop.wait(0.005)  # a third of a hop
        self.duplex.close()

    def _look(self, say: Callable[[str], None]) -> bool:
        """What has come, what was said before what was heard; whether anything had."""
        came = [
            (take, message)
            for reader, take in ((self._reference, self._say), (self._silenced, self._silence), (self._mic, self._hear))
            for message in reader.take(QUEUE)
            if isinstance(message, IdlStruct)  # not a sample that only says that a writer has gone
        ]
        for take, message in came:
            try:
                take(message)
            except SignalError as error:
                say(str(error))
        return bool(came)

    def _say(self, message: AudioData) -> None:
        channels = self._topics.reference_channels or self._topics.channels
        self.duplex.play_pcm16(bytes(message.data), self._topics.rate, channels)

    def _silence(self, message: Empty) -> None:
        self.duplex.interrupt()

    def _hear(self, message: AudioData) -> None:
        topics = self._topics
        answers = None if topics.array is None else 1
        human = self.duplex.hear_pcm16(bytes(message.data), topics.rate, topics.channels, answers)
        if human:
            self._human.write(AudioData(data=list(human)))

    def _tell(self, event: Event) -> None:
        if event.kind in ("speech_started", "speech_stopped"):
            self._barge_in.write(Bool(data=event.kind == "speech_started"))
        elif event.kind == "voice_gain":
            self._voice_gain.write(Float32(data=float(event.detail)))
        elif event.kind in SET_UP_WRONG:
            self._wrong[event.kind] = event.detail

    def _report(self) -> None:
        stats = self.duplex.ego.stats()
        values = {"engine": stats["engine"], "samples": stats["samples"], "latency_ms": stats["latency_ms"]}
        values |= {name: round(value, 3) for name, value in self.duplex.stats().items()}
        if stats["alignment"]:
            values |= {"lag_samples": stats["alignment"]["delay_samples"], "alignment": stats["alignment"]["state"]}
        wrong = "; ".join(f"{kind.replace('_', ' ')}: {detail}" for kind, detail in self._wrong.items())
        status = DiagnosticStatus(
            level=int(bool(wrong)),  # WARN or OK
            name="edgefilter",
            message=wrong or "filtering",
            hardware_id="",
            values=[KeyValue(key=name, value=str(value)) for name, value in values.items()],
        )
        now = time.time_ns()
        header = Header(stamp=Time(sec=now // 10**9, nanosec=now % 10**9), frame_id="")
        self._diagnostics.write(DiagnosticArray(header=header, status=[status]))
