"""Recordings of ROS 2 (mcap files and bags) as the WAV files that every other command takes.

Needs `pip install '.[ros2]'` in a checkout.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from edgefilter.audio.files import make_folder, open_sink
from edgefilter.audio.pairing import MAX_WAIT
from edgefilter.dsp.resample import Resampler
from edgefilter.errors import AudioFileError, UsageError
from edgefilter.integrations.duplex import from_pcm16
from edgefilter.types import SAMPLE_RATE, Samples


def extract(bag: Path, topics: dict[str, str], folder: Path, rate: int, channels: int) -> dict[str, float]:
    """Write the topics' sound as FOLDER/NAME.wav, 16 kHz mono, with one beginning; their seconds by name.

    bag: the folder that `ros2 bag record` made, or the file in it. topics: name of the file: topic. rate, channels: of the
    16-bit samples in the messages. Raises AudioFileError for what is no recording, UsageError for a topic that is not in it
    or holds no sound.
    """
    if bag.is_file() and bag.suffix != ".bag":
        bag = bag.parent
        if not (bag / "metadata.yaml").exists():
            raise AudioFileError(f"{bag} has no metadata.yaml beside the recording: 'ros2 bag reindex' makes it")
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("uint8[] data", "audio_common_msgs/msg/AudioData"))
    try:
        with AnyReader([bag], default_typestore=store) as reader:
            sounds = {name: list(_messages(reader, topic, channels)) for name, topic in topics.items()}
    except (AnyReaderError, OSError, ValueError) as error:
        raise AudioFileError(f"{bag} cannot be read as a recording of ROS 2: {' '.join(str(error).split())}") from None
    begin = min(time - samples.size / rate for parts in sounds.values() for time, samples in parts[:1])
    make_folder(folder, "the sounds of the recording")
    seconds = {}
    for name, parts in sounds.items():
        with open_sink(folder / f"{name}.wav") as sink:
            resampler = Resampler(rate, SAMPLE_RATE)
            written = 0
            for time, samples in parts:
                missing = round((time - begin) * rate) - samples.size - written
                # messages come with jitter: silence stands in only for sound that is later than a device's may be
                if missing > MAX_WAIT / SAMPLE_RATE * rate or (missing > 0 and not written):
                    sink.write(resampler.push(np.zeros(missing, np.float32)))
                    written += missing
                sink.write(resampler.push(samples))
                written += samples.size
            sink.write(resampler.push(np.zeros(0, np.float32), last=True))
        seconds[name] = written / rate
    return seconds


def _messages(reader: AnyReader, topic: str, channels: int) -> Iterator[tuple[float, Samples]]:
    """Each message's time of arrival, seconds, and its samples (n,)."""
    found = [each for each in reader.connections if each.topic == topic]
    if not found:
        there = ", ".join(sorted({each.topic for each in reader.connections})) or "none"
        raise UsageError(f"topic {topic} is not in the recording, found {there}")
    for connection, stamp, raw in reader.messages(connections=found):
        message = reader.deserialize(raw, connection.msgtype)
        sound = getattr(getattr(message, "audio", message), "data", None)
        if not isinstance(sound, np.ndarray) or sound.dtype.itemsize > 2:
            raise UsageError(f"topic {topic} holds {connection.msgtype}, expected audio_common_msgs/msg/AudioData")
        yield stamp / 1e9, from_pcm16(sound.tobytes(), channels)
