"""Filter a recording with what the robot said.

    python filter_file.py mic.wav reference.wav human.wav [robot.npz]

Both recordings are mono at 16 kHz; `edgefilter run` also takes other rates and channel counts.
"""

import sys

import soundfile

from edgefilter import SAMPLE_RATE, enhance

mic_path, reference_path, output_path, *profile = sys.argv[1:]
mic, mic_rate = soundfile.read(mic_path, dtype="float32")
reference, reference_rate = soundfile.read(reference_path, dtype="float32")
if {mic_rate, reference_rate} != {SAMPLE_RATE}:
    sys.exit(f"found {mic_rate} and {reference_rate} Hz, expected {SAMPLE_RATE}: resample them first")
count = min(mic.size, reference.size)
human = enhance(mic[:count], reference[:count], profile=profile[0] if profile else None)
soundfile.write(output_path, human, SAMPLE_RATE)
print(f"{count / SAMPLE_RATE:.1f} s filtered")
