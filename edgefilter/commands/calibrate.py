"""`edgefilter calibrate`: recordings, or a sound played and recorded now, to a profile; or that sound to a file."""

from __future__ import annotations

import argparse
import datetime
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from edgefilter.audio.files import write_file
from edgefilter.audio.measure import play_and_record
from edgefilter.calibration.calibrate import calibrate
from edgefilter.calibration.moving import calibrate_moving
from edgefilter.calibration.multisine import SWEEP_PART, calibrate_multisine, generate_multisine
from edgefilter.calibration.sweep import generate_sweep
from edgefilter.commands.display import countdown, print_result, say
from edgefilter.commands.outputs import MOVING, RECORDINGS, flag
from edgefilter.commands.profile import summary
from edgefilter.commands.recordings import read
from edgefilter.errors import DeviceError, UsageError
from edgefilter.filter.budget import DEMO
from edgefilter.profile.text import describe
from edgefilter.types import SAMPLE_RATE, Samples

NOISE_S = 5
"""Of the noise alone: a power spectral density good to 1 dB in bands of 60 Hz."""
BUFFERS_S = (0.2, 0.4, 0.6)
"""Asked of the sound system, the later ones where the first lost sound. 0.2 s lost nothing beside a client of 20 ms on a
PulseAudio null sink, where 0.05 s did four times of four; with two of 0.6 s the delay is still below the 1.6 s in which a
calibration looks for the sweep."""


def main(args: argparse.Namespace) -> None:
    given = [flag(name) for name in RECORDINGS if getattr(args, name)]
    missing = [flag(name) for name in RECORDINGS if not getattr(args, name)]
    if args.excitation:
        _write_sound(args, given)
    elif args.live:
        if found := given[:1] or args.while_moving:
            raise UsageError(f"--live makes its own recordings, found {found[0]} too: leave one of them out")
        with _folder(args.save_input) as folder:
            recordings = _record(args, folder)
            moving = None if args.while_moving is None else _record_moving(args, folder)
            _calibrate(args, f"live: {args.speaker} to {args.input}", moving, *recordings)
    elif missing:
        files = " ".join(f"{name} FILE" for name in missing)
        raise UsageError(f"calibration needs three recordings, missing: {files} (or --live to make them now)")
    else:
        names, mics = [getattr(args, name) for name in RECORDINGS], args.mic_channels
        sweep, *heard = (
            read(path, role.replace("_", " "), only) for path, role, only in zip(names, RECORDINGS, (None, mics, mics))
        )
        moving = None
        if args.while_moving is not None:
            mic, ref = _two(args.while_moving)
            moving = read(mic, "recording of the moving robot", mics), read(ref, "reference of the moving robot")
        _calibrate(args, ", ".join(names), moving, sweep, *heard)


def _two(names: list[str]) -> list[str]:
    if len(names) != 2:
        raise UsageError(
            f"--while-moving got {len(names)} files, expected two, MIC REF: what the microphone hears of the robot that talks and"
            " moves, and what it says (or --live to make them now)"
        )
    return names


def _calibrate(
    args: argparse.Namespace, source: str, moving: tuple[Samples, Samples] | None, *recordings: Samples
) -> None:
    """Make the profile and say what is in it. moving: what is heard of the moving robot, and what it says."""
    make = calibrate_multisine if args.multisine else calibrate
    profile = make(*recordings, created=datetime.date.today().isoformat(), source=source)
    if moving:
        profile = calibrate_moving(profile, *moving)
    profile.save(args.output)
    print_result(args, [describe(profile), f"written to {args.output}"], summary(profile))


def _write_sound(args: argparse.Namespace, given: list[str]) -> None:
    """The sound that a calibration plays, to a file, for a robot that this program does not run on."""
    unneeded = [flag(name) for name in ("live", "json", "while_moving") if getattr(args, name) not in (None, False)]
    for name in (*given, *unneeded):
        raise UsageError(f"--excitation only writes the sound to be played: leave {name} out")
    sound = _sound(args)
    write_file(args.excitation, sound)
    print(f"{sound.size / SAMPLE_RATE:.0f} s of sound to be played written to {args.excitation}")


def _sound(args: argparse.Namespace) -> Samples:
    """What is played, the sweep at the level that was asked for."""
    amplitude = 10 ** (args.level_db / 20)
    if not args.multisine:
        return generate_sweep(amplitude=amplitude)
    if amplitude > SWEEP_PART:
        raise UsageError(
            f"--level-db is {args.level_db:g}, expected at most {20 * np.log10(SWEEP_PART):.0f} with --multisine:"
            " its loudest multisines peak so much higher than its sweep"
        )
    return generate_multisine(amplitude / SWEEP_PART)


def _record(args: argparse.Namespace, folder: Path) -> tuple[Samples, Samples, Samples]:
    """The sound that is played, what the microphone picks up of it, and the noise alone; each is in the folder at once."""
    sound = _sound(args)
    name = "a sweep and multisines" if args.multisine else "a sweep"
    silence = np.zeros(NOISE_S * SAMPLE_RATE, np.float32)
    write_file(folder / "sweep_reference.wav", sound, float32=True)
    told = f"now quiet: {NOISE_S} s of the robot's noise alone"
    noise = take(args, silence, told, folder / "noise_recording.wav")
    told = f"now playing: {round(sound.size / SAMPLE_RATE)} s of {name}"
    return sound, take(args, sound, told, folder / "sweep_recording.wav"), noise


def _record_moving(args: argparse.Namespace, folder: Path) -> tuple[Samples, Samples]:
    """What the microphone hears while a voice is played and the robot moves, and that voice."""
    voice = read(str(DEMO / "reference.flac"), "voice")
    # as loud as the multisines, whose loud moments are as those of speech
    peak = 10 ** (args.level_db / 20) / SWEEP_PART
    voice *= min(1.0, peak) / np.abs(voice).max()
    recorded, said = (folder / f"{name}.wav" for name in MOVING)
    write_file(said, voice, float32=True)
    told = f"now talking: {round(voice.size / SAMPLE_RATE)} s of a voice; let the robot move as it does when it talks"
    return take(args, voice, told, recorded), voice


def take(args: argparse.Namespace, sound: Samples, what: str, file: Path | None = None) -> Samples:
    """Play on --speaker and record on --input, again with larger buffers if samples were lost, since a gap would be measured as part of the path.

    file: keeps each recording, also one with gaps or cut off.
    """

    def keep(recorded: Samples) -> None:
        if file:
            write_file(file, recorded, float32=True)

    for latency_s in BUFFERS_S:
        channels = getattr(args, "mic_channels", None)
        found, holes = play_and_record(args.speaker, args.input, sound, latency_s, countdown(what), channels, keep)
        if not holes:
            return found
        say(f"the recording has holes ({holes})")
    raise DeviceError(
        f"the recording has holes ({holes}), also with buffers of {latency_s:g} s: close other programs and measure"
        " again"
    )


@contextmanager
def _folder(path: str | None) -> Iterator[Path]:
    """Where recordings are kept: the folder that was asked for, or one that is left behind if the calibration fails."""
    folder = Path(path or tempfile.mkdtemp(prefix="edgefilter-"))
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield folder
    except BaseException:
        if any(folder.glob("*_recording.wav")):
            say(f"what was recorded is kept in {folder}")
        elif not path:
            shutil.rmtree(folder)
        raise
    if not path:
        shutil.rmtree(folder)
