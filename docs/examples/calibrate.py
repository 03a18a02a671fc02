"""Make a robot's profile from three recordings, and look at what was measured.

    python calibrate.py sweep.wav heard.wav fan.wav robot.npz

sweep.wav is what was played (edgefilter.generate_sweep makes one), heard.wav what the microphone heard of it, fan.wav
some seconds of the robot being silent. All are mono at 16 kHz.
"""

import sys

import numpy as np
import soundfile

from edgefilter import calibrate

*recordings, output_path = sys.argv[1:]
sweep, heard, fan = (soundfile.read(path, dtype="float32")[0] for path in recordings)
profile = calibrate(sweep, heard, fan, source=", ".join(recordings))
profile.save(output_path)
for (low, high), snr in zip(profile.band_hz, profile.band_snr_db):
    print(f"{low:6.0f} to {high:5.0f} Hz: the sweep is {snr:4.0f} dB over the fan")
print(
    f"{profile.echo.impulse_response.size / 16:.0f} ms of impulse response; distortion"
    f" {np.max(profile.distortion_db):.0f} dB"
)
for warning in profile.warnings:
    print(f"WARNING {warning}")
