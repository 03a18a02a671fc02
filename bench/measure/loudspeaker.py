"""Which model of the loudspeaker holds on seconds that it was not fitted to, on simulated robots and real devices.

    OMP_NUM_THREADS=1 python -m bench.measure.loudspeaker --conversations DIR [DIR ...] --hidden DIR [DIR ...]
        --pairs DIR [DIR ...] --output bench/results/loudspeaker

Each recording's first seconds teach a path of 0.5 s, and a path with a model of the loudspeaker ahead of it, in turns;
its later seconds judge them. Figures are ERLE there, of the path alone, and what a model adds to it, dB: mean, 95 %
interval over recordings, the worst. Conversations: the robot's first utterance teaches, the rest judges, without the
human, whom a simulation can take out. Hidden cases: those that hide this effect, or nothing, 10 s teach. Pairs
(NAME_lpb, NAME_mic): real devices, 10 s teach, or half of what is shorter than 20 s; a human who speaks in one stays in.
"sweep": the effect from the calibration's sweep, another room, before the path is taught. "20 dB louder": by how many dB
more the share of what a model adds rises when the reference does, worst of all recordings.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import soundfile as sf
from tqdm import tqdm

from bench import results_writer
from bench.measure.intervals import interval
from bench.measure.loudspeaker_models import EFFECT, MODELS, Play, fit_effect, fit_from_sweep, fit_model, path_alone
from bench.measure.picture import panels, save
from edgefilter.dsp.lag import correlation_near, flat_cross
from edgefilter.echo.recording import MAX_OFFSET
from edgefilter.echo.wiener import convolve_from
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

TAUGHT_S = 10.0
TUNED = 6
"""Pairs of one real device with lower numbers were looked at while the models were chosen."""
LOUDER = np.float32(10.0)
OURS, SWEEP = "effect, guarded", "effect, from the sweep"
SYSTEMS = (*MODELS, OURS, SWEEP)


@dataclass(frozen=True, eq=False)
class Recording:
    """reference (n,), aligned, and microphone (n,), without a human where that is known; split: where judging begins."""

    group: str
    name: str
    reference: Samples
    microphone: Samples
    split: int
    sweep: tuple[Samples, Samples] | None = None


def read(path: Path) -> Samples:
    return sf.read(path, dtype="float32")[0]


def aligned(reference: Samples, microphone: Samples, known: int | None = None) -> tuple[Samples, Samples]:
    """Both (n,), the direct sound PRE_ROLL samples after its reference; the lag is found in the first known samples."""
    x, y = reference[:known], microphone[:known]
    n = 1 << int(np.ceil(np.log2(2 * max(x.size, y.size))))
    reach = int(MAX_OFFSET * SAMPLE_RATE)
    near = correlation_near(flat_cross(x, y, n), n, min(reach, n // 2 - 1))
    lag = int(np.argmax(np.abs(near))) - near.size // 2 - PRE_ROLL
    moved = np.concatenate((np.zeros(max(lag, 0), np.float32), reference[max(-lag, 0) :]))
    return np.pad(moved, (0, max(microphone.size - moved.size, 0)))[: microphone.size], microphone


def conversations(folder: Path) -> Iterator[Recording]:
    for case in sorted(path.parent for path in folder.glob("*/meta.json")):
        split = int(json.loads((case / "meta.json").read_text())["t_main"])
        robot = read(case / "mic.flac") - read(case / "clean.flac")
        sweep = aligned(read(case / "sweep_ref.flac"), read(case / "sweep_mic.flac"))
        yield Recording(folder.name, case.name, *aligned(read(case / "ref.flac"), robot, split), split, sweep)


def hidden(folder: Path) -> Iterator[Recording]:
    for case in sorted(path.parent for path in folder.glob("*/truth.json")):
        effects = json.loads((case / "truth.json").read_text())["effects"]
        if EFFECT.name not in effects and effects != ["none"]:
            continue
        group = f"hidden {folder.name}, {'nothing' if effects == ['none'] else 'distortion'}"
        yield Recording(
            group, case.name, *aligned(read(case / "ref.flac"), read(case / "mic.flac")), int(TAUGHT_S * SAMPLE_RATE)
        )


def pairs(folder: Path) -> Iterator[Recording]:
    for path in sorted(folder.glob("*_lpb.*")):
        name = path.stem.removesuffix("_lpb")
        if "nearend" in name:
            continue
        x, y = aligned(read(path), read(path.with_name(path.name.replace("_lpb", "_mic"))))
        group = "real, others"
        if name[-2:].isdigit():
            group = f"real, {name[:-3]}, {'00-05' if int(name[-2:]) < TUNED else '06 on'}"
        yield Recording(group, name, x, y, min(int(TAUGHT_S * SAMPLE_RATE), y.size // 2))


def erle_db(recording: Recording, response: Array, play: Play | None) -> float:
    """Over the seconds that judge."""
    driven = play(recording.reference) if play else recording.reference
    left = (recording.microphone - convolve_from(driven, response, 0))[recording.split :]
    heard = recording.microphone[recording.split :]
    return float(10 * np.log10(np.sum(np.float64(heard) ** 2) / np.sum(np.float64(left) ** 2)))


def rise_db(x: Samples, play: Play | None) -> float:
    """By how much what is played beside x (n,) rises more than x does, when that is LOUDER; 0 where nothing is."""
    if play is None:
        return 0.0
    quiet, loud = np.mean((play(x) - x) ** 2), np.mean((play(LOUDER * x) - LOUDER * x) ** 2)
    return float(10 * np.log10(loud / LOUDER**2 / max(quiet, 1e-30)))


def examine(recording: Recording) -> dict:
    """ERLE of the path alone, by system what it adds to that and its rise_db."""
    x, y = recording.reference[: recording.split], recording.microphone[: recording.split]
    alone = erle_db(recording, path_alone(x, y), None)
    fits = {name: fit_model(model, x, y) for name, model in MODELS.items()} | {OURS: fit_effect(x, y)}
    if recording.sweep:
        fits[SWEEP] = fit_from_sweep(recording.sweep, x, y)
    gains = {name: erle_db(recording, *fit) - alone for name, fit in fits.items()}
    rises = {name: rise_db(x, play) for name, (_, play) in fits.items()}
    return {
        "group": recording.group,
        "name": recording.name,
        "erle_db": alone,
        "gain_db": gains,
        "rise_db": rises,
        "kept": fits[OURS][1] is not None,
    }


def cell(gains: list[float]) -> str:
    low, high = interval(lambda draws: draws.mean(axis=1), gains)
    return f"{np.mean(gains):+.2f} ({low:+.2f} to {high:+.2f}), worst {min(gains):+.2f}"


def page(rows: list[dict]) -> str:
    """A row a system, a column a group."""
    groups = list(dict.fromkeys(row["group"] for row in rows))
    of = {group: [row for row in rows if row["group"] == group] for group in groups}
    head = ["path alone, ERLE dB", *(f"{np.mean([row['erle_db'] for row in of[group]]):.1f}" for group in groups), ""]
    kept = ["recordings; the effect kept", *(f"{len(of[g])}; {sum(row['kept'] for row in of[g])}" for g in groups), ""]
    lines = []
    for system in SYSTEMS:
        cells = []
        for group in groups:
            gains = [row["gain_db"][system] for row in of[group] if system in row["gain_db"]]
            cells.append(cell(gains) if gains else "")
        rises = [row["rise_db"][system] for row in rows if system in row["rise_db"]]
        lines.append([system, *cells, f"{max(rises):+.0f} dB" if rises else ""])
    text = __doc__.split("\n\n")[2].strip()
    return "\n".join([text, "", *results_writer.table(["", *groups, "20 dB louder"], [kept, head, *lines])])


def draw(rows: list[dict], output: Path) -> None:
    """Gain of each recording, a panel a group."""
    groups = list(dict.fromkeys(row["group"] for row in rows))
    figure, axes = panels(1, len(groups), (2.6 * len(groups) + 1.5, 3.6))
    for ax, group in zip(axes, groups, strict=True):
        for at, system in enumerate(SYSTEMS):
            gains = [row["gain_db"][system] for row in rows if row["group"] == group and system in row["gain_db"]]
            ax.plot(gains, np.full(len(gains), at), "o", ms=4, alpha=0.6)
        ax.axvline(0.0, color="0.6", lw=0.8)
        ax.set(title=group, xlabel="ERLE gained, dB", yticks=range(len(SYSTEMS)), ylim=(len(SYSTEMS) - 0.5, -0.5))
        ax.set_yticklabels(SYSTEMS if ax is axes[0] else [])
    save(figure, output)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--conversations", type=Path, nargs="*", default=[])
    parser.add_argument("--hidden", type=Path, nargs="*", default=[])
    parser.add_argument("--pairs", type=Path, nargs="*", default=[])
    parser.add_argument("--output", type=Path, default=Path("bench/results/loudspeaker"))
    options = parser.parse_args()
    readers = {"conversations": conversations, "hidden": hidden, "pairs": pairs}
    data = {kind: getattr(options, kind) for kind in readers}
    made_with = results_writer.stamp({kind.upper(): folders for kind, folders in data.items() if folders})
    found = [recording for kind, folders in data.items() for folder in folders for recording in readers[kind](folder)]
    if not found:
        parser.error("no recordings: give --conversations, --hidden or --pairs")
    rows = [examine(recording) for recording in tqdm(found, unit="recording")]
    print(results_writer.write(options.output, made_with, "Models of the loudspeaker", page(rows), {"rows": rows}))
    draw(rows, options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
