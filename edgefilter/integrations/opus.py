"""Opus packets to samples and back, by libopus within PyAV. Needs `pip install '.[opus]'` in a checkout."""

from __future__ import annotations

import av
import av.error
import numpy as np

from edgefilter.audio.raw import FULL_SCALE
from edgefilter.errors import SignalError
from edgefilter.types import SAMPLE_RATE, Samples

FRAME_MS = 20
"""Length of a packet that is made here."""


class Decoder:
    """One mono stream of packets, decoded in their order."""

    def __init__(self) -> None:
        self._codec = av.CodecContext.create("libopus", "r")
        # the clock of Opus, whatever was encoded (RFC 6716, section 2)
        self._codec.sample_rate, self._codec.layout = 48_000, "mono"

    def decode(self, packet: bytes) -> Samples:
        """The samples (n,) of a packet at 48 kHz; raises SignalError for bytes that are none."""
        try:
            frames = self._codec.decode(av.Packet(packet)) if packet else []
        except (av.error.FFmpegError, ValueError) as error:
            raise SignalError(f"found {len(packet)} bytes that are no Opus packet ({type(error).__name__})") from None
        parts = [frame.to_ndarray().reshape(-1, len(frame.layout.channels)) for frame in frames]
        if not parts:
            return np.zeros(0, np.float32)
        return np.concatenate(parts)[:, 0].astype(np.float32) / np.float32(FULL_SCALE)


class Encoder:
    """One mono stream at 16 kHz as packets of 20 ms. bitrate: bits a second."""

    def __init__(self, bitrate: int) -> None:
        self._codec = av.CodecContext.create("libopus", "w")
        self._codec.sample_rate, self._codec.layout, self._codec.format = SAMPLE_RATE, "mono", "flt"
        self._codec.bit_rate = bitrate
        self._codec.options = {"application": "voip", "frame_duration": str(FRAME_MS)}
        self._size = SAMPLE_RATE * FRAME_MS // 1000
        self._waiting = np.zeros(0, np.float32)

    def push(self, samples: Samples, last: bool) -> list[bytes]:
        """Take samples (n,) and return the packets that are complete; after `last`, filled up with silence, nothing follows."""
        waiting = np.concatenate((self._waiting, samples))
        if last:
            waiting = np.pad(waiting, (0, -waiting.size % self._size))
        whole = waiting.size // self._size * self._size
        self._waiting = waiting[whole:]
        packets: list[bytes] = []
        for at in range(0, whole, self._size):
            frame = av.AudioFrame.from_ndarray(waiting[None, at : at + self._size], format="flt", layout="mono")
            frame.sample_rate = SAMPLE_RATE
            packets += [bytes(packet) for packet in self._codec.encode(frame)]
        return packets
