"""A loudspeaker, a room and a microphone without hardware: what the examples of agents play into and listen to.

    python room.py heard.wav

alone plays the bundled robot's speech into it, lets the bundled human speak over it, and writes what the microphone
hears. The echo is the bundled robot's calibrated one, behind a lag; nothing here is a measurement of a real robot.
"""

import sys
from pathlib import Path

import numpy as np
import soundfile

import edgefilter

DEMO = Path(edgefilter.__file__).parent / "demo_data"
PROFILE = DEMO / "profile.npz"
RATE = edgefilter.SAMPLE_RATE


def read(name, start_s, end_s):
    return soundfile.read(DEMO / f"{name}.flac", dtype="float32")[0][round(start_s * RATE) : round(end_s * RATE)]


ROBOT = read("reference", 0.4, 6.1)
"""What the robot says, 5.7 s."""
HUMAN = read("human", 9.0, 15.0)
"""What the human says, as loud as the microphone hears it: 23 dB below the robot."""


class Room:
    """Everything at 16 kHz, one channel; time is what `hear` lets pass.

    lag_s: from the loudspeaker's buffer to the microphone, as sound systems have it. device_s: what the loudspeaker's
    buffer holds.
    """

    def __init__(self, lag_s=0.12, device_s=0.2):
        self.response = edgefilter.Profile.load(PROFILE).echo.impulse_response
        self.fan = read("mic", 0.0, 0.4)
        self.now = 0
        self.buffer = np.zeros(0, np.float32)
        self.device = round(device_s * RATE)
        self.played = []
        self._tail = np.zeros(0, np.float32)  # what will be heard of what was played
        self._lag = round(lag_s * RATE)
        self.human_from = None

    @property
    def full(self):
        """Whether the loudspeaker takes nothing now."""
        return self.buffer.size >= self.device

    def play(self, samples):
        self.buffer = np.concatenate((self.buffer, samples))

    def silence(self):
        """The loudspeaker forgets what it has not played yet."""
        self.buffer = self.buffer[:0]

    def speak(self):
        """The human begins now."""
        self.human_from = self.now

    def hear(self, count):
        """Let count samples pass; what the microphone hears of them."""
        out = np.zeros(count, np.float32)  # where the buffer runs dry the loudspeaker is silent
        out[: self.buffer.size] = self.buffer[:count]
        self.buffer = self.buffer[count:]
        self.played.append(out)
        echo = np.concatenate((np.zeros(self._lag, np.float32), np.convolve(out, self.response)))
        echo[: self._tail.size] += self._tail  # never longer: as many samples have gone from it as come now
        self._tail = echo
        mic = self._tail[:count] + self.fan[(self.now + np.arange(count)) % self.fan.size] + self.human(count)
        self._tail = self._tail[count:]
        self.now += count
        return mic.astype(np.float32)

    def human(self, count):
        if self.human_from is None:
            return np.zeros(count, np.float32)
        said = HUMAN[self.now - self.human_from :][:count]
        return np.concatenate((said, np.zeros(count - said.size, np.float32)))


if __name__ == "__main__":
    room = Room()
    room.play(ROBOT)
    heard = [room.hear(3 * RATE)]
    room.speak()
    soundfile.write(sys.argv[1], np.concatenate((*heard, room.hear(6 * RATE))), RATE)
    print("9.0 s heard")
