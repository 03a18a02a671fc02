"""Ask whether the human has finished or only pauses: Pipecat's smart-turn, whose weights are in its package.

    python end_of_turn.py mic.wav reference.wav [robot.npz]

The classifier gets what the filter leaves, from 300 ms before the human was noticed on. Both recordings are mono at 16 kHz.
"""

import asyncio
import sys

import numpy as np
import soundfile
from pipecat.audio.turn.smart_turn.local_smart_turn_v3 import LocalSmartTurnAnalyzerV3

from edgefilter import SAMPLE_RATE, BargeInSettings, EgoFilter


def pcm16(samples):
    return (np.clip(samples, -1, 1) * 32767).astype("<i2").tobytes()


mic_path, reference_path, *profile = sys.argv[1:]
mic, reference = (soundfile.read(path, dtype="float32")[0] for path in (mic_path, reference_path))
ego = EgoFilter(profile[0] if profile else None, engine="crnn", barge_in=BargeInSettings(min_silence_s=0.2))
classifier, asked = LocalSmartTurnAnalyzerV3(), False
classifier.set_sample_rate(SAMPLE_RATE)
for at in range(0, min(mic.size, reference.size) - ego.hop + 1, ego.hop):
    human, speaking = ego.process(mic[at : at + ego.hop], reference[at : at + ego.hop]), ego.human_speaks
    events = {event.kind: event for event in ego.events()}
    if asked:
        classifier.append_audio(pcm16(human), speaking)
    elif started := events.get("speech_started"):
        asked = True
        classifier.append_audio(pcm16(started.sound.samples), True)  # ends where `human` does
        print(f"{started.sample / SAMPLE_RATE:.2f} s: begins")
    if stopped := events.get("speech_stopped"):
        state, _ = asyncio.run(classifier.analyze_end_of_turn())
        asked = state.name != "COMPLETE"
        print(f"{stopped.sample / SAMPLE_RATE:.2f} s: {state.name.lower()}")
