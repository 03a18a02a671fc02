"""The node /edgefilter over the real middleware, with messages as ROS 2 nodes name them; and recordings of theirs."""

import contextlib
import os
import signal
import subprocess
import time
from dataclasses import dataclass

import numpy as np
import pytest
import soundfile
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float32, int32, sequence, uint8, uint32
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from edgefilter import EgoFilter
from edgefilter.cli import main
from edgefilter.dsp.metrics import si_sdr
from edgefilter.filter.barge_in import BargeInSettings
from edgefilter.types import SAMPLE_RATE as RATE
from tests.program import ROOT, argv

PROFILE = ROOT / "edgefilter/demo_data/profile.npz"
FRAME = 320


@dataclass
class Audio(IdlStruct, typename="audio_common_msgs::msg::dds_::AudioData_"):
    data: sequence[uint8]


@dataclass
class Flag(IdlStruct, typename="std_msgs::msg::dds_::Bool_"):
    data: bool


@dataclass
class Number(IdlStruct, typename="std_msgs::msg::dds_::Float32_"):
    data: float32


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Pair(IdlStruct, typename="diagnostic_msgs::msg::dds_::KeyValue_"):
    key: str
    value: str


@dataclass
class Status(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticStatus_"):
    level: uint8
    name: str
    message: str
    hardware_id: str
    values: sequence[Pair]


@dataclass
class Statuses(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticArray_"):
    header: Header
    status: sequence[Status]


def received(reader):
    """What was sent; a sample without a message tells that its sender is gone."""
    return [sample for sample in reader.take(200) if not isinstance(sample, InvalidSample)]


class Robot:
    """The nodes around: a microphone in a simulated room, a voice, and those who listen; with ROS's usual quality of service."""

    def __init__(self, domain):
        self.domain, self.participant = domain, DomainParticipant(domain)
        reliable = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(200))
        lossy = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(200))
        self.mic = DataWriter(self.participant, Topic(self.participant, "rt/audio", Audio), qos=lossy)
        self.speech = DataWriter(self.participant, Topic(self.participant, "rt/speech", Audio), qos=reliable)
        self.human = DataReader(self.participant, Topic(self.participant, "rt/human", Audio), qos=reliable)
        self.barge_in = DataReader(self.participant, Topic(self.participant, "rt/barge_in", Flag), qos=reliable)
        self.gains = DataReader(self.participant, Topic(self.participant, "rt/voice_gain", Number), qos=reliable)
        self.reports = DataReader(self.participant, Topic(self.participant, "rt/diagnostics", Statuses), qos=reliable)

    def wait_for_node(self):
        """Until the node hears the microphone and the voice, and is heard."""
        end = time.monotonic() + 60
        while not (self.mic.get_matched_subscriptions() and self.speech.get_matched_subscriptions()
                   and self.human.get_matched_publications()):  # fmt: skip
            assert time.monotonic() < end, "the node was not found"
            time.sleep(0.1)

    def converse(self, room_of, seconds=6.0, human_at=3.0, paced=False):
        """The robot talks, as it is played or all at once, the human begins beside it; what the node sent, and when it told of the human."""
        room, sound, told = room_of.Room(), [], []
        said = np.rint(room_of.ROBOT * 32767).astype("<i2").tobytes()
        size = 2 * FRAME if paced else 64_000
        pieces = [Audio(data=list(said[at : at + size])) for at in range(0, len(said), size)]
        while pieces and not paced:
            self.speech.write(pieces.pop(0))
        room.play(room_of.ROBOT)
        time.sleep(0.3)
        began = time.monotonic()
        for step in range(round(seconds * RATE / FRAME)):
            if pieces:
                self.speech.write(pieces.pop(0))
            if step == round(human_at * RATE / FRAME):
                room.speak()
            heard = np.rint(room.hear(FRAME) * 32767).astype("<i2").tobytes()
            self.mic.write(Audio(data=list(heard)))
            time.sleep(max(0.0, began + (step + 1) * 0.02 - time.monotonic()))
            sound += [bytes(message.data) for message in received(self.human)]
            told += [(time.monotonic() - began, message.data) for message in received(self.barge_in)]
        time.sleep(0.5)
        sound += [bytes(message.data) for message in received(self.human)]
        return np.frombuffer(b"".join(sound), "<i2") / 32768, told


@contextlib.contextmanager
def node(robot, folder, *more, profile=PROFILE, end=signal.SIGTERM):
    """The command as it is typed, found by the robot and ended by this signal; said: what it then had said."""
    words = argv("ros2", "--profile", profile, "--domain", robot.domain, *more)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, cwd=folder, env=environment)
    try:
        assert "node /edgefilter" in process.stderr.readline()
        robot.wait_for_node()
        yield process
    finally:
        process.send_signal(end)
        _, process.said = process.communicate(timeout=20)
    assert process.returncode == (-end if end == signal.SIGKILL else 0)


@pytest.mark.slow
def test_the_node_gives_the_human_and_barge_in_also_after_it_was_killed_and_started_again(tmp_path, room_of):
    robot = Robot(domain=87)
    for end, asks in ((signal.SIGKILL, False), (signal.SIGTERM, True)):
        with node(robot, tmp_path, *(("--ask-db", 12) if asks else ()), end=end):
            sound, told = robot.converse(room_of, paced=asks)
            gains = [round(message.data, 2) for message in received(robot.gains)]
            reports = [message.status[0] for message in received(robot.reports)]
        assert sound.size > 5.5 * RATE
        assert told and told[0][1] and 3.0 < told[0][0] < 4.0, told
        assert gains[:2] == ([0.25, 1.0] if asks else []), gains  # what waits at the loudspeaker cannot be lowered
        both = slice(3 * RATE, round(5.4 * RATE))
        assert si_sdr(sound[both], room_of.HUMAN[: both.stop - both.start]) > 3  # before: -23 dB
        assert reports[-1].name == "edgefilter" and reports[-1].level == 0
        assert {"engine", "samples", "played_s"} <= {pair.key for pair in reports[-1].values}
        robot.barge_in.take(100)


@pytest.mark.slow
@pytest.mark.parametrize("loopback", [False, True])
def test_of_an_array_the_named_channels_are_its_microphones_and_the_human_is_one_channel(
    tmp_path, pair, talking, loopback
):
    profile, sound = talking if loopback else pair
    profile.save(tmp_path / "pair.npz")
    pcm = np.rint(sound * 32768).astype("<i2")
    reference = ("--reference-channel", 0) if loopback else ("--reference-channels", 1)
    words = ("--channels", 3, "--mic-channels", "1,2", *reference, "--engine", "ss")
    robot, heard = Robot(domain=89), b""
    with node(robot, tmp_path, *words, profile=tmp_path / "pair.npz"):
        for at in range(0, len(pcm) - FRAME, FRAME):
            robot.mic.write(Audio(data=list(pcm[at : at + FRAME].tobytes())))
            time.sleep(0.005)
            heard += b"".join(bytes(message.data) for message in received(robot.human))
        until = time.monotonic() + 20.0
        while len(heard) <= 2 * 2.5 * RATE and time.monotonic() < until:  # a busy machine is behind
            time.sleep(0.05)
            heard += b"".join(bytes(message.data) for message in received(robot.human))
    human = np.frombuffer(heard, "<i2") / 32768
    assert 2.5 * RATE < human.size < len(pcm)
    ego = EgoFilter(profile, engine="ss", barge_in=BargeInSettings(judge="network"))
    played = pcm[:, 0] / np.float32(32768) if loopback else np.zeros(len(pcm), np.float32)
    wanted = ego.process(pcm[:, 1:] / np.float32(32768), played)
    np.testing.assert_allclose(human, wanted[: human.size], atol=1 / 32768)


def test_a_message_that_is_no_sound_is_a_line_and_the_node_goes_on(tmp_path):
    robot = Robot(domain=88)
    with node(robot, tmp_path, end=signal.SIGINT) as process:
        robot.mic.write(Audio(data=[1, 2, 3]))
        robot.mic.write(Audio(data=[0] * 4096))
        end = time.monotonic() + 20
        while not (heard := robot.human.take(10)):
            assert time.monotonic() < end
            time.sleep(0.05)
        assert len(heard[0].data) > 0
    assert "found 3 bytes, expected whole 16-bit samples" in process.said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--mic", "audio"], "topic 'audio' does not begin with a slash"),
        (["--domain", "500"], "'500' is not a domain, 0 to 232"),
        (["--rate", "x"], "'x' is not a rate"),
        (["--reference-channel", "5"], "reference_channel is 5, expected mic_channels that name the others"),
        (
            ["--channels", "4", "--mic-channels", "all", "--reference-channel", "4"],
            "reference_channel is 4, expected mic_channels that name the others",
        ),
    ],
)
def test_what_cannot_be_a_node_is_one_line(words, said, capsys):
    assert main(["ros2", "--engine", "linear", *words]) == 2
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1 and said in told[0]


@pytest.fixture(params=["mcap", "sqlite3"])
def recording(request, tmp_path):
    """Two topics of a robot: its voice is silent, without messages, for a second in the middle."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("uint8[] data", "audio_common_msgs/msg/AudioData"))
    kind = store.types["audio_common_msgs/msg/AudioData"]
    rng = np.random.default_rng(0)
    sounds = {"/mic": rng.integers(-9000, 9000, 4 * RATE), "/tts": rng.integers(-9000, 9000, 4 * RATE)}
    sounds["/tts"][RATE : 2 * RATE] = 0
    plugin = StoragePlugin.MCAP if request.param == "mcap" else StoragePlugin.SQLITE3
    with Writer(tmp_path / "robot", version=9, storage_plugin=plugin) as writer:
        for topic, sound in sounds.items():
            connection = writer.add_connection(topic, kind.__msgtype__, typestore=store)
            for at in range(0, sound.size, FRAME):
                part = sound[at : at + FRAME].astype("<i2")
                if part.any():
                    stamp = 10**9 + round((at + FRAME) * 1e9 / RATE) + int(rng.integers(0, 10**7))  # 10 ms of jitter
                    raw = store.serialize_cdr(kind(data=np.frombuffer(part.tobytes(), np.uint8)), kind.__msgtype__)
                    writer.write(connection, stamp, raw)
    return tmp_path / "robot", sounds


def test_a_recording_becomes_the_files_that_every_command_takes(recording, tmp_path, capsys):
    bag, sounds = recording
    files = [*bag.glob("*.mcap")] or [bag]
    for path in {bag, *files}:
        words = ["--mic", "/mic", "--reference", "/tts", "--output", str(tmp_path / "out")]
        assert main(["ros2", "extract", str(path), *words]) == 0
        assert "mic.wav: 4.0 s of /mic" in capsys.readouterr().out
        mic, reference = (soundfile.read(tmp_path / f"out/{name}.wav")[0] for name in ("mic", "reference"))
        at = int(np.argmax(np.correlate(mic, sounds["/mic"][:4000] / 32768, "valid")))
        assert at < 0.02 * RATE
        np.testing.assert_allclose(mic[at : at + 4 * RATE], sounds["/mic"] / 32768, atol=1e-4)
        for at in (0, 32000):
            late = int(np.argmax(np.correlate(reference, sounds["/tts"][at : at + 4000] / 32768, "valid"))) - at
            assert abs(late) < 0.02 * RATE  # the messages' jitter


def test_a_topic_that_is_not_there_is_named_with_those_that_are(recording, tmp_path, capsys):
    bag, _ = recording
    words = ["--mic", "/nose", "--reference", "/tts", "--output", str(tmp_path / "out")]
    assert main(["ros2", "extract", str(bag), *words]) == 2
    assert "topic /nose is not in the recording, found /mic, /tts" in capsys.readouterr().err


def test_what_is_no_recording_is_one_line(tmp_path, capsys):
    (tmp_path / "robot.mcap").write_bytes(b"no recording")
    (tmp_path / "metadata.yaml").write_text("nothing: true")
    words = ["--mic", "/mic", "--reference", "/tts", "--output", str(tmp_path / "out")]
    assert main(["ros2", "extract", str(tmp_path / "robot.mcap"), *words]) == 1
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1 and "cannot be read as a recording of ROS 2" in told[0]
    (tmp_path / "metadata.yaml").unlink()
    assert main(["ros2", "extract", str(tmp_path / "robot.mcap"), *words]) == 1
    assert "has no metadata.yaml beside the recording" in capsys.readouterr().err
