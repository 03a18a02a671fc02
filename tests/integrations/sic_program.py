"""A program of the Social Interaction Cloud: a room's microphone as a component, the human's ears, and a robot that talks.

Usage: sic_program.py FOLDER [four]. Writes what the human's component has sent, as JSON and samples. four: the microphone
sends four channels at 48 kHz, interleaved, as Pepper's does where all are asked for; the human then is at 48 kHz, too.
"""

import json
import sys
import threading
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "docs/examples"))

import room as simulated  # noqa: E402
from sic_framework import SICComponentManager, SICConfMessage  # noqa: E402
from sic_framework.core.connector import SICConnector  # noqa: E402
from sic_framework.core.message_python2 import AudioMessage, AudioRequest  # noqa: E402
from sic_framework.core.sensor_python2 import SICSensor  # noqa: E402
from sic_framework.core.sic_application import SICApplication  # noqa: E402

from edgefilter.integrations.sic import Human, HumanConf, SpeechMessage  # noqa: E402

FRAME = 1600  # 0.1 s
FRAMES = 60
ROOM = simulated.Room()
BEGIN = threading.Event()
FOUR = sys.argv[2:] == ["four"]


def messages():
    """Bytes and rate of each message."""
    heard = []
    for frame in range(FRAMES):
        if frame == 30:
            ROOM.speak()
        heard.append(ROOM.hear(FRAME))
    sound, rate = np.concatenate(heard), 16000
    if FOUR:
        from scipy.signal import resample_poly  # takes a second

        rate, own = 48000, 0.1 * np.std(ROOM.fan) * np.random.default_rng(5).standard_normal((4, 3 * sound.size))
        sound = np.stack([np.roll(resample_poly(sound, 3, 1), 9 * at) for at in range(4)], axis=1) + own.T
    pcm = np.rint(sound * 32767).astype("<i2")
    return [(part.tobytes(), rate) for part in np.split(pcm, FRAMES)]


class RoomMicrophoneSensor(SICSensor):
    def execute(self):
        BEGIN.wait(1.0)
        if not BEGIN.is_set() or self.sent >= FRAMES:
            time.sleep(0.05)
            return None
        time.sleep(max(0.0, self.begun + self.sent * 0.1 - time.monotonic()) if self.sent else 0.0)
        self.begun = self.begun or time.monotonic()
        self.messages = self.messages or messages()
        heard, rate = self.messages[self.sent]
        self.sent += 1
        return AudioMessage(heard, sample_rate=rate)

    begun, sent, messages = 0.0, 0, None

    @staticmethod
    def get_conf():
        return SICConfMessage()

    @staticmethod
    def get_inputs():
        return []

    @staticmethod
    def get_output():
        return AudioMessage


class RoomMicrophone(SICConnector):
    component_class = RoomMicrophoneSensor
    component_group = "Room"


def main():
    app = SICApplication()
    threading.Thread(
        target=lambda: SICComponentManager([RoomMicrophoneSensor], component_group="Room"), daemon=True
    ).start()
    time.sleep(1.0)
    sound, told = [], []

    def take(message):
        if isinstance(message, SpeechMessage):
            told.append([message.kind, message.seconds, message.is_speaking, message.detail])
        else:
            sound.append(np.frombuffer(message.waveform, "<i2"))

    microphone = RoomMicrophone()
    human = Human(input_source=microphone, conf=HumanConf(mic_channels=[0, 1, 2, 3] if FOUR else None))
    human.register_callback(take)
    ROOM.play(simulated.ROBOT)
    human.request(AudioRequest(np.rint(simulated.ROBOT * 32767).astype("<i2").tobytes(), 16000))
    BEGIN.set()
    end = time.monotonic() + 30
    while sum(map(len, sound)) < (3 if FOUR else 1) * (FRAMES - 2) * FRAME and time.monotonic() < end:
        time.sleep(0.1)
    folder = Path(sys.argv[1])
    np.save(folder / "human.npy", np.concatenate(sound) if sound else np.zeros(0))
    (folder / "told.json").write_text(json.dumps(told))
    app.shutdown()


main()
