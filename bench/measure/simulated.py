r"""Do simulated recordings look like real ones? What the linear stage leaves of the robot without a profile, side by side.

    python -m bench.measure.simulated --items DATA --real DIR [--pattern 'NAME*'] --output bench/results/simulated

DATA: items of export/dataset.py, of which those without a profile are taken, the human (who is known) subtracted. DIR:
pairs NAME_lpb.wav and NAME_mic.wav (or .flac) in which nobody but the loudspeaker is heard; each is filtered anew in pieces as long
as the items. Of each piece from START_S on, over the hops in which the robot is heard: ERLE, the residual's level by
frequency under the microphone's, how much louder than its usual level the residual's loud moments are, and, where
AECMOS is installed, its judgement of the echo. Writes OUTPUT.json, OUTPUT.md and OUTPUT.png.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy import signal

from bench import results_writer
from bench.measure import picture
from bench.measure.levels import frame_power
from bench.measure.real_recordings import read
from bench.measure.real_scores import aecmos
from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.linear import Linear
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.filter.stream import Stream
from edgefilter.types import SAMPLE_RATE, Samples

START_S, PIECE_S = 4.0, 12.0
HEARD_DB = 25.0
"""A hop counts where the microphone is within so much of its loudest."""
BANDS_HZ = np.geomspace(100, 7600, 20)
PARTS = {"ERLE, dB": "erle_db", "residual's loud moments over its median, dB": "bursts_db", "AECMOS, echo": "echo_mos"}


def examine(mic: Samples, left: Samples, reference: Samples) -> dict[str, object] | None:
    """Figures of one piece (n,): microphone and what the linear stage left; None where the robot is hardly heard."""
    start, hop = round(START_S * SAMPLE_RATE), StftConfig().hop
    mic, left, reference = mic[start:], left[start:], reference[start:]
    before, after = frame_power(mic, hop), frame_power(left, hop)
    heard = before > 10 ** (-HEARD_DB / 10) * before.max(initial=0.0)
    if before.max(initial=0.0) < 1e-7 or heard.sum() < SAMPLE_RATE / hop:
        return None
    ratio_db = 10 * np.log10((after[heard] + 1e-12) / (before[heard] + 1e-12))
    frequencies, spectra = signal.welch(np.stack((left, mic)), SAMPLE_RATE, nperseg=1024)
    bands = np.digitize(frequencies, BANDS_HZ)
    power = np.stack([spectra[:, bands == band].sum(axis=1) for band in range(1, BANDS_HZ.size)], axis=1)
    mos = aecmos()
    signals = {name: np.clip(x, -1, 1) for name, x in (("lpb", reference), ("mic", mic), ("enh", left))}
    return {
        "echo_mos": mos(signals, "st")["echo_mos"] if mos else None,
        "erle_db": float(10 * np.log10(before[heard].sum() / after[heard].sum())),
        "bursts_db": float(np.percentile(ratio_db, 95) - np.median(ratio_db)),
        "spectrum_db": [float(x) for x in 10 * np.log10((power[0] + 1e-15) / (power[1] + 1e-15))],
    }


def simulated(folder: Path) -> Iterator[dict[str, object]]:
    """Figures of the items without a profile, at an unweakened linear stage or not, as they come."""
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        raise UsageError(f"{folder} holds no items: make them with python -m export.dataset --recipe wide")
    for path in paths:
        with np.load(path) as item:
            if json.loads(str(item["about"]))["warm"]:
                continue
            mic, error, clean, reference = (
                item["reference_scale" if name == "reference" else "scale"] / 32767 * item[name].astype(np.float32)
                for name in ("mic", "error", "clean", "reference")
            )
            if reference.any() and (found := examine(mic - clean, error - clean, reference)):
                yield found


def real(folder: Path, patterns: list[str]) -> Iterator[dict[str, object]]:
    """Figures of pieces of PIECE_S of the recordings of such names, each filtered from nothing."""
    found = sorted({path for pattern in patterns for path in folder.glob(f"{pattern}_lpb.*")})
    pairs = [(path, path.with_name(path.name.replace("_lpb.", "_mic."))) for path in found]
    if not pairs:
        raise UsageError(f"{folder} holds no NAME_lpb.wav (or .flac) with its NAME_mic.wav")
    size = round(PIECE_S * SAMPLE_RATE)
    for pair in pairs:
        reference, mic = map(read, pair)
        for at in range(0, min(mic.size, reference.size) - size + 1, size):
            stream = Stream(Linear())
            piece = slice(at, at + size)
            left = np.concatenate((stream.process(mic[piece], reference[piece]), stream.flush()))
            if figures := examine(mic[piece], left, reference[piece]):
                yield figures


def overlap(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Part of `theirs` that lies between the 5th and 95th percentile of `ours`."""
    low, high = np.percentile(ours, [5, 95])
    return float(np.mean((theirs >= low) & (theirs <= high)))


def measured(sets: dict[str, list[dict]]) -> dict[str, str]:
    """Those of PARTS that there are figures of."""
    return {
        label: key
        for label, key in PARTS.items()
        if all(row[key] is not None for rows in sets.values() for row in rows)
    }


def plot(sets: dict[str, list[dict]], output: Path) -> None:
    """A histogram of each figure, and the spectrum's median and 5 to 95 % range."""
    parts = measured(sets)
    figure, axes = picture.panels(1, len(parts) + 1, (4.5 * len(parts) + 5, 4))
    for axis, (label, key) in zip(axes, parts.items()):
        for name, rows in sets.items():
            axis.hist([row[key] for row in rows], bins=20, density=True, alpha=0.5, label=f"{name}, {len(rows)}")
        axis.set(xlabel=label, ylabel="density")
        axis.legend()
    centres = np.sqrt(BANDS_HZ[1:] * BANDS_HZ[:-1])
    for name, rows in sets.items():
        low, middle, high = np.percentile([row["spectrum_db"] for row in rows], [5, 50, 95], axis=0)
        (line,) = axes[-1].semilogx(centres, middle, label=name)
        axes[-1].fill_between(centres, low, high, alpha=0.2, color=line.get_color())
    axes[-1].set(xlabel="Hz", ylabel="residual under the microphone, dB")
    axes[-1].legend()
    picture.save(figure, output)


def markdown(sets: dict[str, list[dict]], name: str) -> str:
    cells = []
    for label, key in measured(sets).items():
        values = {kind: np.array([row[key] for row in rows]) for kind, rows in sets.items()}
        ranges = ["{:.1f} / {:.1f} / {:.1f}".format(*np.percentile(each, [5, 50, 95])) for each in values.values()]
        cells.append([label, *ranges, f"{100 * overlap(values['simulated'], values['real']):.0f} %"])
    head = [
        "5 / 50 / 95 %",
        *(f"{kind}, {len(rows)} pieces" for kind, rows in sets.items()),
        "real within 5-95 % of simulated",
    ]
    return "\n".join([*results_writer.table(head, cells), "", f"![histograms and spectra]({name}.png)", ""])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--items", type=Path, required=True, metavar="DATA")
    parser.add_argument("--real", type=Path, required=True, metavar="DIR")
    parser.add_argument("--pattern", nargs="+", default=["*"], help="of names in DIR, without _lpb and what follows")
    parser.add_argument("--output", type=Path, required=True, metavar="PATH")
    options = parser.parse_args()
    try:
        made_with = results_writer.stamp({"recordings": [options.real]})
        sets = {"simulated": list(simulated(options.items)), "real": list(real(options.real, options.pattern))}
    except (EdgefilterError, OSError) as error:
        print(f"simulated: {error}", file=sys.stderr)
        return 1
    plot(sets, options.output)
    page = markdown(sets, options.output.name)
    print(results_writer.write(options.output, made_with, "Simulated beside real", page, sets))
    return 0


if __name__ == "__main__":
    sys.exit(main())
