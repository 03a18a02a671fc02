"""Find out what a profile lacks, add it, and see the error fall.

    python diagnose.py robot.npz mic.wav reference.wav better.npz

mic.wav holds the robot alone for some seconds, reference.wav what it said; mono, 16 kHz.
"""

import sys

import soundfile

from edgefilter import Profile, Recording

profile_path, mic_path, reference_path, output_path = sys.argv[1:]
profile = Profile.load(profile_path)
mic, _ = soundfile.read(mic_path, dtype="float32")
reference, _ = soundfile.read(reference_path, dtype="float32")
recording = Recording(mic, reference, profile)

print(f"{recording.compare().excess_db:.1f} dB over the noise floor")
found = recording.diagnose()
print(found.verdict, found.evidence)
for finding in found.ranking:
    print(f"{finding.effect}: {finding.evidence}")
names = [finding.effect for finding in found.ranking]
if names and not recording.prove(names).worse:
    profile, before, after = recording.add(names)
    print(f"  {before.excess_db:.1f} dB before they were added, {after.excess_db:.1f} dB after")
profile.save(output_path)
