"""`edgefilter calibrate`: recordings, or a sound played and recorded now, to a profile; or that sound to a file."""

from __future__ import annotations

import argparse
import datetime
import sys
from pathlib import Path

import numpy as np

from edgefilter.audio.files import FileSink
from edgefilter.audio.reader import Reader
from edgefilter.calibration.calibrate import calibrate
from edgefilter.calibration.from_multisine import calibrate_multisine
from edgefilter.calibration.multisine import SWEEP_PART, generate_multisine
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
    if args.excitation:
        return _write_sound(args, given)
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
    if args.multisine:
        profile = calibrate_multisine(sweep, recording, fan, created=today, source=source)
    else:
        profile = calibrate(sweep, recording, fan, stepped_sine=args.stepped_sine, created=today, source=source)
    profile.save(args.output)
    if args.json:
        write_json(summary(profile), args.json)
    if args.json != "-":
        print(describe(profile))
        print(f"written to {args.output}")
    return 0


def _write_sound(args: argparse.Namespace, given: list[str]) -> int:
    """The sound that a calibration plays, to a file, for a robot that this program does not run on."""
    for name in (*given, *(word for word in ("live", "json") if getattr(args, word))):
        raise UsageError(f"--excitation only writes the sound to be played: leave --{name.replace('_', '-')} out")
    sound = _sound(args)
    with FileSink(args.excitation) as sink:
        sink.write(sound)
    print(f"{sound.size / SAMPLE_RATE:.0f} s of sound to be played written to {args.excitation}")
    return 0


def _sound(args: argparse.Namespace) -> Samples:
    """What is played, the sweep at the level that was asked for."""
    amplitude = 10 ** (args.level_db / 20)
    if not args.multisine:
        return generate_stepped_sine(amplitude) if args.stepped_sine else generate_sweep(amplitude=amplitude)
    if amplitude > SWEEP_PART:
        raise UsageError(
            f"--level-db is {args.level_db:g}, expected at most {20 * np.log10(SWEEP_PART):.0f} with --multisine:"
            " its loudest multisines peak so much higher than its sweep"
        )
    return generate_multisine(amplitude / SWEEP_PART)


def _read(path: str, role: str) -> Samples:
    reader = Reader(path, role.replace("_", " "))
    samples = np.concatenate([*reader.chunks(), np.zeros(0, np.float32)])
    for note in reader.notes:
        print(note, file=sys.stderr)
    return samples


def _record(args: argparse.Namespace) -> tuple[Samples, Samples, Samples]:
    from edgefilter.audio.play_and_record import play_and_record

    sweep = _sound(args)
    name = "a sweep and multisines" if args.multisine else "a sweep"
    print(f"keep quiet: {FAN_SECONDS} s of the fan, then {name} of {sweep.size / SAMPLE_RATE:.0f} s", file=sys.stderr)
    fan = play_and_record(args.speaker, args.input, np.zeros(FAN_SECONDS * SAMPLE_RATE, np.float32))
    recording = play_and_record(args.speaker, args.input, sweep)
    if args.save_input:
        folder = Path(args.save_input)
        folder.mkdir(parents=True, exist_ok=True)
        for name, samples in zip(RECORDINGS, (sweep, recording, fan)):
            with FileSink(folder / f"{name}.wav", float32=True) as sink:
                sink.write(samples)
    return sweep, recording, fan
