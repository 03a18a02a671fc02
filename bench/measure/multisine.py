"""What a calibration by multisines knows of a simulated robot's distortion, and what the diagnosis makes of it.

    python -m bench.measure.multisine --voices robot/test --seed 9001 --count 8 --output bench/results/multisine

Each robot (bench/simulate/hidden_robot.py, with the ordinary tolerances, nothing hidden) plays the sound of
`edgefilter.generate_multisine`, then talks for 20 to 30 s on another day. Its loudspeaker distorts faintly, 9 to 16 dB
below the fan, or plainly, from 6 dB below to 3 dB above it, in turn. What it tells is held against the truth: the
distortion against what no linear filter explains of Gaussian noise of the same level and spectrum through the same
loudspeaker and room, the linear part against the impulse response at small signals.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from scipy import signal
from tqdm import tqdm

from bench import results_writer
from bench.measure.intervals import interval
from bench.simulate.conversations import Clip, read_voices
from bench.simulate.hidden_acoustics import fractional_delay
from bench.simulate.hidden_cases import read_reference
from bench.simulate.hidden_robot import FAINT_DB, Scene, draw_scene
from bench.simulate.simulated_robot import RATE, Array, fan_noise
from edgefilter import Profile, calibrate_multisine, diagnose, generate_multisine
from edgefilter.calibration.multisine import BAND_HZ, SPEECH_DB
from edgefilter.errors import EdgefilterError
from edgefilter.profile.data import GRID_HZ

PLAIN_DB = (-6.0, 3.0)
ROBOT_OVER_FAN_DB = (18.0, 30.0)
FRAME = 8192
SECONDS = 30
"""Of the noise that tells the truth."""
INTRODUCTION = """Robots with the ordinary tolerances and nothing hidden, calibrated by `generate_multisine`. Distortion:
over the fan while the robot talks; in noise of the loudest multisines' level over the linear part, as it is and as
`calibrate --multisine` finds it. Gain: root mean square error of the best linear approximation, 200 to 2000 Hz. Excess
and names: what `diagnose` says of 20 to 30 s of speech with the profile of the sweep alone, and with what the multisines
know; any name is a false alarm. dB."""


@dataclass(frozen=True)
class Row:
    """One robot; dB but for the lists of names and the verdicts."""

    robot: int
    strength: str
    over_fan: float
    distortion: float
    found: float
    gain_error: float
    excess_sweep: float
    names_sweep: list[str]
    verdict_sweep: str
    excess: float
    names: list[str]
    verdict: str


def measure(seed: int, index: int, voices: dict[str, list[Clip]]) -> Row:
    """Robot index of this seed."""
    rng = np.random.default_rng([seed, index])
    reference = read_reference(rng, voices[str(rng.choice(sorted(voices)))])
    strength, range_db = (("faint", FAINT_DB), ("plain", PLAIN_DB))[index % 2]
    scene = draw_scene(rng, reference, rng.uniform(*ROBOT_OVER_FAN_DB), range_db)
    profile = calibrated(rng, scene)
    mic, said = scene.record(scene.usual).astype(np.float32), reference.astype(np.float32)
    plain, knowing = (diagnose(p, mic, said) for p in (replace(profile, approximation=None), profile))
    known = profile.approximation
    assert known is not None
    distortion, gain = truth(scene, float(known.level_db[-1]))
    inside = (GRID_HZ > 200) & (GRID_HZ < 2000)
    error = 20 * np.log10(known.gain[-1][inside] / gain[inside])
    return Row(
        index,
        strength,
        scene.tolerances["distortion_over_fan_db"],
        distortion,
        float(known.over_linear_db("even", "odd")[-1]),
        float(np.sqrt(np.mean(error**2))),
        plain.comparison.excess_db,
        [finding.effect for finding in plain.ranking],
        plain.verdict,
        knowing.comparison.excess_db,
        [finding.effect for finding in knowing.ranking],
        knowing.verdict,
    )


def heard(scene: Scene, played: Array, linear: bool = False) -> Array:
    """(n,) what the robot's microphone hears of a sound on the day of the calibration, without the fan."""
    path = signal.oaconvolve(scene.place.response(), scene.shell)
    pressure = scene.usual.loudspeaker.play(played, linear)
    return scene.gain * fractional_delay(signal.oaconvolve(pressure, path)[: played.size], scene.delay)


def calibrated(rng: np.random.Generator, scene: Scene) -> Profile:
    """The profile that the robot's multisines give."""
    played = generate_multisine()
    fan = np.sqrt(scene.fan_power) * fan_noise(rng, scene.fan_amplitude, played.size)
    recording = heard(scene, played.astype(np.float64)) + fan
    return calibrate_multisine(played, *(x.astype(np.float32) for x in (recording, scene.signals["fan_only"])))


def truth(scene: Scene, level_db: float) -> tuple[float, Array]:
    """Distortion over the linear part, dB, and the linear gain (601,), of Gaussian noise at that level.

    By the coherence of what is heard with what a linear loudspeaker would bring there (Bendat & Piersol 2010, sec. 6.1):
    between these two there is no room, which would outlast a frame.
    """
    n = SECONDS * RATE
    hz = np.fft.rfftfreq(n, 1 / RATE)
    shape = 10 ** (np.polynomial.Polynomial(SPEECH_DB)(np.log10(np.maximum(hz, 1.0))) / 20)
    shape[(hz < BAND_HZ[0]) | (hz > BAND_HZ[1])] = 0.0
    noise = np.fft.irfft(shape * np.fft.rfft(np.random.default_rng(1).standard_normal(n)), n)
    noise *= 10 ** (level_db / 20) / noise.std()
    straight, sound = heard(scene, noise, linear=True), heard(scene, noise)
    pairs = ((noise, noise), (straight, straight), (sound, sound), (straight, sound))
    (at, own), (_, linear), (_, whole), (_, cross) = (signal.csd(a, b, RATE, nperseg=FRAME) for a, b in pairs)
    explained = np.abs(cross) ** 2 / np.maximum(linear.real, 1e-30)
    left = float(10 * np.log10(np.sum(whole.real - explained) / np.sum(explained)))
    width = np.maximum(GRID_HZ * (2 ** (1 / 12) - 1), 30.0)
    inside = np.abs(at[:, None] - GRID_HZ) <= width
    power = (explained[:, None] * inside).sum(axis=0) / np.maximum((own.real[:, None] * inside).sum(axis=0), 1e-30)
    return left, np.sqrt(power)


def page(rows: list[Row]) -> str:
    """The counts, then robot by robot."""
    off = np.abs([row.found - row.distortion for row in rows])
    mean, low, high = float(off.mean()), *interval(lambda x: x.mean(axis=1), off)
    alarms = [sum(bool(row.names_sweep) for row in rows), sum(bool(row.names) for row in rows)]
    cells = [
        [
            row.robot,
            row.strength,
            *(f"{value:.1f}" for value in (row.over_fan, row.distortion, row.found, row.gain_error)),
            *(f"{row.excess_sweep:.1f}", _said(row.verdict_sweep, row.names_sweep)),
            *(f"{row.excess:.1f}", _said(row.verdict, row.names)),
        ]
        for row in rows
    ]
    columns = ["robot", "distortion", "over the fan", "in noise", "found", "gain", "excess, sweep", "said"]
    return "\n".join(
        [
            *(INTRODUCTION, ""),
            f"Distortion off by {mean:.1f} dB in the mean [{low:.1f}, {high:.1f}], at most {off.max():.1f}. False alarms:"
            f" {alarms[0]} of {len(rows)} with the sweep, {alarms[1]} of {len(rows)} with multisines.",
            "",
            *results_writer.table([*columns, "excess, multisines", "said"], cells),
        ]
    )


def _said(verdict: str, names: list[str]) -> str:
    return f"{verdict}: {', '.join(names)}" if names else verdict


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--voices", type=Path, nargs="+", required=True, metavar="DIR", help="the robot's voices")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=8)
    parser.add_argument("--output", type=Path, metavar="PATH", help="PATH.json and PATH.md are written")
    options = parser.parse_args()
    try:
        made_with = results_writer.stamp({"voices": options.voices})
        voices = read_voices(options.voices)
        rows = [measure(options.seed, index, voices) for index in tqdm(range(options.count), unit="robot")]
    except (EdgefilterError, OSError) as error:
        print(f"multisine: {error}", file=sys.stderr)
        return 1
    content = {"seed": options.seed, "rows": [asdict(row) for row in rows]}
    print(results_writer.write(options.output, made_with, "Calibration by multisines", page(rows), content))
    return 0


if __name__ == "__main__":
    sys.exit(main())
