"""`edgefilter calibrate`: recordings, or a sweep played and recorded now, to a profile."""

from __future__ import annotations

import argparse
import datetime
import sys
from pathlib import Path

import numpy as np

from edgefilter.audio.files import FileSink
from edgefilter.audio.reader import Reader
from edgefilter.calibration.calibrate import calibrate
from edgefilter.calibration.stepped_sine import generate_stepped_sine
from edgefilter.calibration.sweep import generate_sweep
from edgefilter.commands.display import write_json
from edgefilter.commands.profile import summary
from edgefilter.errors import UsageError
from edgefilter.profile.text import describe
from edgefilter.types import SAMPLE_RATE, Samples

FAN_SECONDS = 5
RECORDINGS = ("sweep_reference", "sweep_recording", "noise_recording")


def main(args: argparse.Namespace) -> int:
    given = [name for name in RECORDINGS if getattr(args, name)]
    if args.live and given:
        raise UsageError(
            f"--live makes its own recordings, found --{given[0].replace('_', '-')} too: leave one of them out"
        )
    if not args.live and len(given) < len(RECORDINGS):
        missing = " ".join(f"--{name.replace('_', '-')} FILE" for name in RECORDINGS if name not in given)
        raise UsageError(f"calibration needs three recordings, missing: {missing} (or --live to make them now)")
    sweep, recording, fan = _record(args) if args.live else (_read(getattr(args, name), name) for name in RECORDINGS)
    source = (
        f"live: {args.speaker} to {args.input}" if args.live else ", ".join(getattr(args, name) for name in RECORDINGS)
    )
    today = datetime.date.today().isoformat()
    profile = calibrate(sweep, recording, fan, stepped_sine=args.stepped_sine, created=today, source=source)
    profile.save(args.output)
    if args.json:
        write_json(summary(profile), args.json)
    if args.json != "-":
        print(describe(profile))
        print(f"written to {args.output}")
    return 0


def _read(path: str, role: str) -> Samples:
    reader = Reader(path, role.replace("_", " "))
    samples = np.concatenate([*reader.chunks(), np.zeros(0, np.float32)])
    for note in reader.notes:
        print(note, file=sys.stderr)
    return samples


def _record(args: argparse.Namespace) -> tuple[Samples, Samples, Samples]:
    from edgefilter.audio.play_and_record import play_and_record

    amplitude = 10 ** (args.level_db / 20)
    sweep = generate_stepped_sine(amplitude) if args.stepped_sine else generate_sweep(amplitude=amplitude)
    print(f"keep quiet: {FAN_SECONDS} s of the fan, then a sweep of {sweep.size / SAMPLE_RATE:.0f} s", file=sys.stderr)
    fan = play_and_record(args.speaker, args.input, np.zeros(FAN_SECONDS * SAMPLE_RATE, np.float32))
    recording = play_and_record(args.speaker, args.input, sweep)
    if args.save_input:
        folder = Path(args.save_input)
        folder.mkdir(parents=True, exist_ok=True)
        for name, samples in zip(RECORDINGS, (sweep, recording, fan)):
            with FileSink(folder / f"{name}.wav", float32=True) as sink:
                sink.write(samples)
    return sweep, recording, fan
