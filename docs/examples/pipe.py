"""Filter in a program's own audio loop: blocks as they come, of any length, and the answer at once.

    ... | python pipe.py [robot.npz] | ...

Reads signed 16-bit little-endian stereo at 16 kHz from standard input (left the microphone, right what the robot says),
writes mono to standard output as soon as it is finished, and tells on standard error when the human begins and stops to
speak. In a robot the two lines that read and write are its audio driver's.
"""

import sys

import numpy as np

from edgefilter import SAMPLE_RATE, EgoFilter

BLOCK = 320  # 20 ms, as voice frameworks use; any other length gives the same samples

ego = EgoFilter(profile=sys.argv[1] if len(sys.argv) > 1 else None)
while data := sys.stdin.buffer.read(4 * BLOCK):
    mic, reference = np.frombuffer(data, "<i2").reshape(-1, 2).T.astype(np.float32) / 32768
    human = ego.process(mic, reference)
    sys.stdout.buffer.write(np.round(np.clip(human, -1, 32767 / 32768) * 32768).astype("<i2").tobytes())
    for event in ego.events():
        if event.kind in ("speech_started", "speech_stopped"):
            print(f"{event.sample / SAMPLE_RATE:.2f} s: {event.kind}", file=sys.stderr)
human = ego.flush()  # the last samples: as many are out as came in
sys.stdout.buffer.write(np.round(np.clip(human, -1, 32767 / 32768) * 32768).astype("<i2").tobytes())
