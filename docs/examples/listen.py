"""Microphone, filter, where speech begins and ends, recogniser: all in one file.

    python listen.py mic.wav reference.wav [robot.npz] [WHISPER]
    ... | python listen.py - - [robot.npz] [WHISPER]

Reads a recording with what the robot said, or from a pipe 16-bit stereo at 16 kHz (microphone, reference); with `mic`
as the first word, the default microphone and the monitor of the default output (`mic -`). Each thing that the human
says is cut out by the filter's events and handed to Whisper (faster-whisper; WHISPER is a folder or a name such as
base); without, its time is printed.
"""

import sys

import numpy as np
from words import Words

from edgefilter import SAMPLE_RATE, EgoFilter
from edgefilter.commands.run import make_source  # the command line's own; not of the public API

BEFORE = SAMPLE_RATE // 2  # of what came before the event: the first sounds of a word are heard before they are sure

mic, reference, *more = sys.argv[1:]
profile = next((word for word in more if word.endswith(".npz")), None)
words = Words(next((word for word in more if word != profile), None))
ego = EgoFilter(profile=profile)
heard, first, began = (
    np.zeros(0, np.float32),
    0,
    None,
)  # what was filtered; the sample it starts with; who speaks, since when


def listen(human):
    """Take the next filtered samples; print what was said where somebody has just stopped speaking."""
    global heard, first, began
    heard = np.concatenate((heard, human))
    for event in ego.events():
        if event.kind == "speech_started":
            began = max(first, event.sample - BEFORE)
        elif event.kind == "speech_stopped" and began is not None:
            said = heard[began - first : event.sample - first]
            print(f"{began / SAMPLE_RATE:.2f} to {event.sample / SAMPLE_RATE:.2f} s: {words(said)}", flush=True)
            began = None
    if began is None and heard.size > BEFORE:
        first, heard = first + heard.size - BEFORE, heard[-BEFORE:]


with make_source(mic, None if "-" in (mic, reference) or mic == "mic" else reference, "-") as source:
    print(*source.notes, sep="\n", file=sys.stderr, flush=True)  # which devices
    try:
        for block in source:
            for at in range(0, block.mic.size, 320):  # 20 ms, as they come live
                listen(ego.process(block.mic[at : at + 320], block.ref[at : at + 320]))
    except KeyboardInterrupt:  # how a live run ends
        pass
listen(ego.flush())
if began is not None:  # the recording ended in mid-sentence
    print(f"{began / SAMPLE_RATE:.2f} s to the end: {words(heard[began - first :])}")
