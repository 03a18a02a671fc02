"""A robot without a loopback: nobody can say when its loudspeaker plays, so it announces what it is about to say.

    python announce.py mic.wav utterance.wav human.wav [robot.npz]

The utterance is looked for in the microphone; from about 0.1 s after its first sound on it is the reference.
"""

import sys

import numpy as np
import soundfile

from edgefilter import SAMPLE_RATE, EgoFilter

HOP = 256

mic_path, utterance_path, output_path, *profile = sys.argv[1:]
mic, _ = soundfile.read(mic_path, dtype="float32")
utterance, _ = soundfile.read(utterance_path, dtype="float32")
ego = EgoFilter(profile=profile[0] if profile else None)
ego.announce(utterance)
nothing = np.zeros(HOP, np.float32)
finished = [ego.process(mic[at : at + HOP], nothing[: mic.size - at]) for at in range(0, mic.size, HOP)]
soundfile.write(output_path, np.concatenate((*finished, ego.flush())), SAMPLE_RATE)
print(f"heard {ego.stats()['alignment']['announced_heard']} of 1 utterance")
