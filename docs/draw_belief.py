"""Draws docs/belief.png: what the aligner believes of the lag, over recordings of a microphone and its reference.

Run from the root of the repository, for instance with live conversations end to end and a device whose loopback loses samples:
python -m docs.draw_belief MIC REFERENCE MIC REFERENCE.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import soundfile

from edgefilter.alignment.aligner import FURTHEST, LATEST, Aligner
from edgefilter.types import SAMPLE_RATE, Samples

PICTURE = Path(__file__).with_name("belief.png")
HOP, CELL, COLUMN, MARGIN = 256, 160, 8, 20
"""Samples a hop, samples of lag in a row of the picture, hops in a column, and rows beyond the lags that are believed."""


def believed(mic: Samples, ref: Samples) -> np.ndarray:
    """Probability (rows, columns) of lags over time, from -LATEST on: of the delay that is followed, and of the latest look's until the next."""
    aligner, belief, count = Aligner(HOP), None, min(mic.size, ref.size) // (HOP * COLUMN) * COLUMN
    chances = np.zeros(((LATEST + FURTHEST) // CELL + 1, count))
    for hop in range(count):
        now = slice(hop * HOP, (hop + 1) * HOP)
        belief, stats = aligner.step(mic[now], ref[now]).belief or belief, aligner.stats()
        told = [] if belief is None else [(belief.lags[-1], belief.probability[-1])]
        if stats["delay_samples"] is not None:
            told.append((stats["delay_samples"], stats["probability"]))
        for lag, probability in told:
            row = int(lag + LATEST) // CELL
            chances[row, hop] = max(chances[row, hop], probability)
    return chances.reshape(len(chances), -1, COLUMN).max(axis=2)


def draw(paths: list[str], picture: Path = PICTURE) -> None:
    """Write the picture of the pairs of recordings."""
    pairs = list(zip(paths[::2], paths[1::2], strict=True))
    figure, panes = plt.subplots(len(pairs), 1, figsize=(10.4, 3.2 * len(pairs)), layout="constrained", squeeze=False)
    for pane, (mic, ref) in zip(panes[:, 0], pairs):
        chances = believed(*(soundfile.read(path, dtype="float32")[0] for path in (mic, ref)))
        seconds, first, rows = chances.shape[1] * COLUMN * HOP / SAMPLE_RATE, -LATEST / SAMPLE_RATE, CELL / SAMPLE_RATE
        highest = first + len(chances) * rows
        image = pane.imshow(
            chances,
            origin="lower",
            aspect="auto",
            extent=(0, seconds, first, highest),
            vmin=0,
            vmax=1,
            cmap="magma",
            interpolation="none",
        )
        low, high = np.flatnonzero(chances.max(axis=1) > 0.5)[[0, -1]] + (-MARGIN, MARGIN)
        pane.set(title=Path(mic).stem, xlabel="time, s", ylabel="lag of the robot, s")
        pane.set_ylim(max(first + low * rows, first), min(first + high * rows, highest))
        figure.colorbar(image, ax=pane, label="probability")
    figure.savefig(picture, dpi=100)


if __name__ == "__main__":
    draw(sys.argv[1:])
