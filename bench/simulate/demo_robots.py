"""Make the recordings of `edgefilter demo --hidden`: two simulated robots, one with one hidden effect and one with two.

    python -m bench.simulate.demo_robots --voices robot/val --output edgefilter/demo_data/hidden

--voices: a folder with a transcripts.tsv (path, speaker, seconds, text) of synthetic voices. A case is a folder: mic and
reference (FLAC, 16 kHz, 16 bit), profile.npz, the calibration before the effect, and truth.json: what is hidden, with
what parameters, and talk_s, the moment from which a human is mixed in when the demo runs.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.recordings import CALIBRATION
from bench.simulate.conversations import Clip, read_clips, read_speech, write_item
from bench.simulate.hidden_cases import hide, scale
from bench.simulate.hidden_robot import draw_scene
from bench.simulate.simulated_robot import RATE, Array, Rng
from edgefilter.calibration.calibrate import calibrate

ALONE_S, PAUSE_S, TALK_S = 11.0, 1.2, 5.0
"""Seconds of the robot alone, of silence then, and of what it says, at least, while the human interrupts it."""
ROBOT_OVER_FAN_DB = 27.0


@dataclass(frozen=True)
class Hidden:
    """One case: the effects that a recording of this voice holds, in the order in which sound meets them, and how strong they are."""

    name: str
    effects: tuple[str, ...]
    strength: str
    voice: str
    seed: int


CASES = (
    Hidden("one", ("late_reverb",), "clear", "am_puck", 1),
    Hidden("two", ("fan_noise", "late_reverb"), "moderate", "bf_lily", 2),
)


def said(rng: Rng, clips: list[Clip]) -> tuple[Array, float]:
    """Sentences for ALONE_S, a pause, one more for at least TALK_S, peak 0.8, (n,); and the second before that one."""
    parts, order = [np.zeros(RATE // 2)], list(rng.permutation(len(clips)))
    while sum(part.size for part in parts) < ALONE_S * RATE:
        parts += [read_speech(clips[order.pop()]), np.zeros(int(rng.uniform(0.2, 0.6) * RATE))]
    parts.append(np.zeros(int(PAUSE_S * RATE)))
    start = sum(part.size for part in parts)
    last = next(speech for i in order if (speech := read_speech(clips[i])).size >= TALK_S * RATE)
    x = np.concatenate([*parts, last, np.zeros(RATE // 2)])
    return 0.8 * x / np.abs(x).max(), start / RATE - 0.5


def make(case: Hidden, clips: list[Clip]) -> tuple[dict[str, Array], dict]:
    rng = np.random.default_rng([case.seed, 27])
    reference, talk_s = said(rng, [clip for clip in clips if clip.speaker == case.voice])
    scene = draw_scene(rng, reference, ROBOT_OVER_FAN_DB)
    chain, parameters = scene.usual, {}
    for effect in case.effects:
        chain, parameters[effect], _ = hide(rng, scene, chain, effect, case.strength)
    signals = scale(scene.signals | {"mic": scene.record(chain)}, parameters)
    truth = {"effects": sorted(case.effects), "strength": case.strength, "params": parameters, "talk_s": talk_s}
    return signals, truth | {"tolerances": scene.tolerances, "voice": case.voice}


def write(folder: Path, signals: dict[str, Array], truth: dict) -> None:
    """The files of a case, 16 bit, the profile from what 16 bit leave of the calibration's recordings."""
    rounded = {name: (np.round(x * 32768) / 32768).astype(np.float32) for name, x in signals.items()}
    write_item(folder, {"mic": rounded["mic"], "reference": rounded["ref"]}, "truth", truth)
    profile = calibrate(*map(rounded.get, CALIBRATION), source=f"simulated robot '{folder.name}'")
    profile.save(folder / "profile.npz")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--voices", type=Path, required=True, metavar="DIR", help="the robot's voices")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    args = parser.parse_args()
    clips = read_clips(args.voices, (2.0, 9.0))
    for case in CASES:
        write(args.output / case.name, *make(case, clips))


if __name__ == "__main__":
    main()
