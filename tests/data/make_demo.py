"""Make edgefilter/demo_data and tests/data/demo_calibration: a SIMULATED robot that talks in a simulated room while a recorded human interrupts it.

python tests/data/make_demo.py --robot FIRST.flac SECOND.flac --human vm-intro.g722 --output edgefilter/demo_data

Needs pyroomacoustics and, for .g722, ffmpeg. The shipped files were made from two text-to-speech renderings
(Kokoro-82M, CC0) and the prompt vm-intro of Debian's asterisk-core-sounds-en-g722 (CC BY-SA 3.0). Nothing in it is a
measurement of a real robot."""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import pyroomacoustics
import soundfile
from scipy import signal

from edgefilter.calibration.calibrate import calibrate
from edgefilter.calibration.sweep import generate_sweep

RATE = 16000
ROOM, RT60_S = (5.2, 4.1, 2.8), 0.35
LOUDSPEAKER, MICROPHONE, HUMAN = (2.0, 1.9, 1.05), (2.04, 1.95, 1.22), (3.1, 2.2, 1.5)
PLAYBACK_DELAY = 310
"""Samples that playing and recording take in the calibration; the lags below come on top."""
LAGS = (1930, 5270)
"""Samples by which the first and the second utterance start late."""
STARTS_S, HUMAN_START_S, TOTAL_S = (0.4, 7.6), 9.0, 16.0
HUMAN_DB, FAN_DB = -23.0, -31.0
"""Human and fan at the microphone, relative to the robot's voice there."""
PEAK = 0.5
CALIBRATION = Path(__file__).parent / "demo_calibration"
"""The recordings that the profile is made from: tests and examples read them, the package does not."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--robot", nargs=2, required=True, type=Path, help="two utterances of the robot's voice, 16 kHz"
    )
    parser.add_argument("--human", required=True, type=Path, help="the human, any file that ffmpeg reads")
    parser.add_argument("--output", required=True, type=Path)
    args = parser.parse_args()
    rng = np.random.default_rng(20)
    utterances = [0.7 * x / np.abs(x).max() for x in (soundfile.read(path)[0] for path in args.robot)]
    to_robot, to_human = room_responses()
    length = round(TOTAL_S * RATE)
    reference, played = np.zeros(length), np.zeros(length)
    for utterance, start_s, lag in zip(utterances, STARTS_S, LAGS, strict=True):
        start = round(start_s * RATE)
        reference[start : start + utterance.size] += utterance
        played[start + lag : start + lag + utterance.size] += utterance
    echo = at_microphone(played, to_robot)
    gain = PEAK / np.abs(echo).max()
    echo *= gain
    level = active_level(echo)
    human = np.zeros(length)
    voice = signal.fftconvolve(read_human(args.human), to_human)
    start = round(HUMAN_START_S * RATE)
    voice = voice[: length - start]
    human[start : start + voice.size] = voice * level * 10 ** (HUMAN_DB / 20) / active_level(voice)
    fan = make_fan(rng, length + 20 * RATE)
    fan *= level * 10 ** (FAN_DB / 20) / fan.std()
    sweep = generate_sweep()
    sweep_recording = gain * at_microphone(sweep, to_robot) + fan[length : length + sweep.size]
    fan_alone = fan[-6 * RATE :]
    files = {
        "reference": reference,
        "mic": echo + human + fan[:length],
        "human": human,
        "sweep_reference": sweep,
        "sweep_recording": sweep_recording,
        "fan": fan_alone,
    }
    write(args.output, files)


def at_microphone(played: np.ndarray, to_robot: np.ndarray) -> np.ndarray:
    """The loudspeaker (band limits, mild even and odd nonlinearity, 30 to 40 dB down), then the room, then the playback delay."""
    moved = signal.sosfilt(signal.butter(2, 170, "highpass", fs=RATE, output="sos"), played)
    bent = moved + 0.04 * moved**2 - 0.06 * moved**3
    heard = signal.fftconvolve(bent, to_robot)
    return np.concatenate((np.zeros(PLAYBACK_DELAY), heard))[: played.size]


def room_responses() -> tuple[np.ndarray, np.ndarray]:
    """Image-source responses from the robot's loudspeaker and from the human to the robot's microphone."""
    absorption, order = pyroomacoustics.inverse_sabine(RT60_S, ROOM)
    room = pyroomacoustics.ShoeBox(
        ROOM, fs=RATE, materials=pyroomacoustics.Material(absorption), max_order=min(order, 30)
    )
    room.add_source(LOUDSPEAKER)
    room.add_source(HUMAN)
    room.add_microphone(MICROPHONE)
    room.compute_rir()
    return room.rir[0][0], room.rir[0][1]


def make_fan(rng: np.random.Generator, count: int) -> np.ndarray:
    """Falling noise with blade tones at multiples of 147 Hz."""
    noise = signal.lfilter([1.0], [1.0, -0.85], rng.standard_normal(count))
    noise /= noise.std()
    t = np.arange(count) / RATE
    for k, db in enumerate((-8, -14, -18, -24), start=1):
        noise += 10 ** (db / 20) * np.sqrt(2) * np.sin(2 * np.pi * 147 * k * t + rng.uniform(0, 6.28))
    return noise


def read_human(path: Path) -> np.ndarray:
    with tempfile.TemporaryDirectory() as folder:
        wav = Path(folder) / "human.wav"
        subprocess.run(["ffmpeg", "-v", "error", "-i", path, "-ar", str(RATE), "-ac", "1", wav], check=True)
        return soundfile.read(wav)[0]


def active_level(x: np.ndarray) -> float:
    """RMS over the 20 ms pieces that are within 30 dB of the loudest."""
    power = np.mean(x[: x.size // 320 * 320].reshape(-1, 320) ** 2, axis=1)
    return float(np.sqrt(power[power > power.max() * 1e-3].mean()))


def write(folder: Path, files: dict[str, np.ndarray]) -> None:
    read = {}
    for name, samples in files.items():
        assert np.abs(samples).max() < 1.0, name
        path = (CALIBRATION if name in ("sweep_reference", "sweep_recording", "fan") else folder) / f"{name}.flac"
        path.parent.mkdir(parents=True, exist_ok=True)
        soundfile.write(path, samples, RATE, subtype="PCM_16")
        read[name] = soundfile.read(path, dtype="float32")[0]
    profile = calibrate(
        read["sweep_reference"],
        read["sweep_recording"],
        read["fan"],
        source="simulated demo robot: sweep_reference, sweep_recording, fan",
    )
    profile.save(folder / "profile.npz")
    (folder / "LICENSE.md").write_text(LICENSE)
    print("\n".join(profile.warnings) or "calibration: nothing doubtful")


LICENSE = """# The demo recording: what it is, and its licences

Simulated. No robot was recorded: a text-to-speech voice was played through a simulated loudspeaker (image-source room, mild
nonlinearity), with simulated fan noise, by `tests/data/make_demo.py` in the source repository. Only the human is a recording.

| file | what | licence |
| --- | --- | --- |
| reference.flac | the robot's two utterances as sent to its loudspeaker; neural text-to-speech rendered with Kokoro-82M | CC0 1.0 |
| profile.npz | calibration of the simulated robot, from the recordings in `tests/data/demo_calibration` of the repository | CC0 1.0 |
| human.flac | the human alone at the microphone: a prompt in a simulated room | CC BY-SA 3.0 |
| mic.flac | robot, human and fan at the microphone | CC BY-SA 3.0 |
| hidden/CASE/reference.flac | what a robot says, rendered with Kokoro-82M | CC0 1.0 |
| hidden/CASE/mic.flac, truth.json | that robot after something happened, simulated by `bench/simulate/demo_robots.py`; what it was | CC0 1.0 |
| hidden/CASE/profile.npz | its calibration, from before | CC0 1.0 |

The human is the prompt `vm-intro` of the Asterisk core sounds (Debian package asterisk-core-sounds-en-g722), copyright 2003-2010
Allison Smith (http://www.theivrvoice.com), financed by Digium, Inc., licensed under Creative Commons Attribution-Share Alike 3.0
(https://creativecommons.org/licenses/by-sa/3.0/). Changes: level, simulated room, mixed with the robot in mic.flac.
CC0: https://creativecommons.org/publicdomain/zero/1.0/
"""


if __name__ == "__main__":
    main()
