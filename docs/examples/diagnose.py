"""Find out what a profile lacks, add it, and see the error fall.

    python diagnose.py robot.npz mic.wav reference.wav better.npz

mic.wav holds the robot alone for some seconds, reference.wav what it said; mono, 16 kHz.
"""

import sys

import soundfile

from edgefilter import Profile, add, compare, diagnose, prove

profile_path, mic_path, reference_path, output_path = sys.argv[1:]
profile = Profile.load(profile_path)
recording, _ = soundfile.read(mic_path, dtype="float32")
reference, _ = soundfile.read(reference_path, dtype="float32")

print(f"{compare(profile, recording, reference).excess_db:.1f} dB over the noise floor")
found = diagnose(profile, recording, reference)
print(found.verdict, found.evidence)
for finding in found.ranking:
    print(f"{finding.effect}: {finding.evidence}")
names = [finding.effect for finding in found.ranking]
if names and not prove(profile, names, recording, reference).worse:
    profile, before, after = add(profile, names, recording, reference)
    print(f"  {before.excess_db:.1f} dB before they were added, {after.excess_db:.1f} dB after")
profile.save(output_path)
