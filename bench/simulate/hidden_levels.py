"""Levels of recordings with hidden effects, to hold folders of cases against each other.

What one simulator makes and another.

    python -m bench.simulate.hidden_levels DIR [DIR ...]

Prints a Markdown table: median (10th to 90th percentile) over the cases of each folder.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import soundfile as sf
from scipy import signal

from bench.simulate.hidden_acoustics import decibels, power
from bench.simulate.simulated_robot import RATE, Array

BANDS_HZ = ((60, 200), (200, 500), (500, 1000), (1000, 2000), (2000, 4000), (4000, 6000), (6000, 7800))


def measure(case: Path) -> dict[str, float]:
    """Figures of one case by name."""
    sweep_mic, fan, ref, mic = (sf.read(case / f"{name}.flac")[0] for name in ("sweep_mic", "fan_only", "ref", "mic"))
    figures = {
        "recording, s": mic.size / RATE,
        "reference, dBFS": decibels(power(ref)),
        "fan, dBFS": decibels(power(fan)),
    }
    figures |= {
        "recording over fan, dB": decibels(power(mic) / power(fan)),
        "sweep over fan, dB": decibels(power(sweep_mic) / power(fan)),
    }
    figures |= {"recording's peak": float(np.abs(mic).max()), "sweep's peak": float(np.abs(sweep_mic).max())}
    for low, high in BANDS_HZ:
        figures[f"fan, {low}-{high} Hz, density over its mean, dB"] = decibels(
            density(fan, low, high) / density(fan, 60, 7800)
        )
        figures[f"recording over fan, {low}-{high} Hz, dB"] = decibels(
            density(mic, low, high) / density(fan, low, high)
        )
    return figures


def density(x: Array, low: float, high: float) -> float:
    """Mean power spectral density of x (n,) in a band (Welch, 75 ms)."""
    f, psd = signal.welch(x, RATE, nperseg=1200)
    return float(np.mean(psd[(f >= low) & (f < high)]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR")
    folders = {
        folder: [measure(path.parent) for path in sorted(folder.glob("*/mic.flac"))]
        for folder in parser.parse_args().folders
    }
    print("| | " + " | ".join(f"{folder.name}, {len(cases)} cases" for folder, cases in folders.items()) + " |")
    print("| --- " * (len(folders) + 1) + "|")
    for name in next(iter(folders.values()))[0]:
        spread = [np.percentile([case[name] for case in cases], [50, 10, 90]) for cases in folders.values()]
        print(
            f"| {name} | "
            + " | ".join(f"{middle:.3g} ({low:.3g} to {high:.3g})" for middle, low, high in spread)
            + " |"
        )


if __name__ == "__main__":
    main()
