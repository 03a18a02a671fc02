"""What the human says, in words: behind `edgefilter run`, which filters and tells where speech begins and ends.

    edgefilter run --input mic --output - --quiet --log-json events.jsonl | python listen.py events.jsonl [WHISPER]

`--input mic.wav --reference tts.wav` does the same with a recording. `edgefilter run` writes the human as 16-bit samples,
and each event as a line of JSON. Each passage between speech_started and
speech_stopped is handed to Whisper (faster-whisper; WHISPER is a folder or a name such as base); without, its time is
printed.
"""

import json
import signal
import sys
from collections import deque

import numpy as np
from words import Words

RATE = 16_000
BEFORE = RATE // 2  # samples kept from before the event: a word's first sounds come before the filter is sure

signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends edgefilter run, and with it the pipe
words = Words(*sys.argv[2:])
human, first, began = np.zeros(0, np.float32), 0, None  # samples; the number of the first; where speech began


def finish(end):
    said = words(human[began - first : end - first])
    print(f"{began / RATE:.2f} to {end / RATE:.2f} s: {said}", flush=True)


data, events = sys.stdin.buffer.read1(), deque()
with open(sys.argv[1]) as log:  # there since the first samples
    while data:
        data += sys.stdin.buffer.read(len(data) % 2)
        human = np.concatenate((human, np.frombuffer(data, "<i2").astype(np.float32) / 32768))
        events.extend(json.loads(line) for line in log)
        while events and (at := round(events[0]["time"] * RATE)) <= first + human.size:
            kind = events.popleft()["kind"]
            if kind == "speech_started":
                began = max(first, at - BEFORE)
            elif kind == "speech_stopped" and began is not None:
                finish(at)
                began = None
        if began is None and human.size > 2 * BEFORE:
            first, human = first + human.size - 2 * BEFORE, human[-2 * BEFORE :]
        data = sys.stdin.buffer.read1()
if began is not None:  # it ended in mid-sentence
    finish(first + human.size)
