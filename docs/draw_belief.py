"""Draws docs/belief.png: what the aligner believes of the lag, over two recordings of a microphone and its reference.

Run from the root of the repository, for instance with a live conversation and a device whose loopback loses samples:
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

from edgefilter.alignment.aligner import LATEST, Aligner
from edgefilter.alignment.lag_search import STEEP
from edgefilter.types import SAMPLE_RATE, Samples

PICTURE = Path(__file__).with_name("belief.png")
HOP, CELL, COLUMN = 256, 160, 8
"""Samples a hop, samples of lag in a row of the picture, hops in a column."""


class Watched(Aligner):
    """An aligner that says after each hop how likely each lag is, in rows of CELL samples."""

    seen: np.ndarray | None = None

    def believe(self) -> np.ndarray:
        """Probability by row of lags, (rows,): of the delay while it is known, otherwise of what the last search saw."""
        rows = np.zeros((self._max_lag + LATEST) // CELL + 1)
        if self._known and not self._refuted:
            rows[int(self._drift.delay + LATEST) // CELL] = self._probability
        elif self._open and self.seen is not None:
            np.maximum.at(rows, np.arange(self.seen.size) // CELL, self.seen)
        return rows

    def _search(self) -> bool:
        before = vars(self._lags).get("_crosses")
        switched = super()._search()
        crosses = vars(self._lags).get("_crosses")
        if crosses and crosses is not before:
            score = self._lags._scored(crosses[0])
            best = self._lags._best(score)
            odds = (best.odds if best else 0.0) * (np.maximum(score, 0.0) / score.max()) ** STEEP
            self.seen = odds / (1.0 + odds.sum())
        return switched


def believed(mic: Samples, ref: Samples) -> tuple[np.ndarray, float]:
    """Probability (rows, columns) of each lag over time, and the lag of the first row in seconds."""
    aligner, columns = Watched(HOP), []
    for at in range(0, min(mic.size, ref.size) - HOP + 1, HOP):
        aligner.step(mic[at : at + HOP], ref[at : at + HOP])
        columns.append(aligner.believe())
    whole = np.array(columns[: len(columns) // COLUMN * COLUMN])
    return whole.reshape(-1, COLUMN, whole.shape[1]).max(axis=1).T, -LATEST / SAMPLE_RATE


def draw(paths: list[str]) -> None:
    """Write the picture of the pairs of recordings."""
    pairs = list(zip(paths[::2], paths[1::2], strict=True))
    figure, panes = plt.subplots(len(pairs), 1, figsize=(10.4, 3.2 * len(pairs)), layout="constrained", squeeze=False)
    for pane, (mic, ref) in zip(panes[:, 0], pairs):
        chances, first = believed(*(soundfile.read(path, dtype="float32")[0] for path in (mic, ref)))
        seconds, highest = chances.shape[1] * COLUMN * HOP / SAMPLE_RATE, first + chances.shape[0] * CELL / SAMPLE_RATE
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
        heard = np.flatnonzero(chances.max(axis=1) > 0.5)
        top = first + (heard.max() + 20) * CELL / SAMPLE_RATE if heard.size else highest
        pane.set(title=Path(mic).stem, xlabel="time, s", ylabel="lag of the robot, s", ylim=(first, min(top, highest)))
        figure.colorbar(image, ax=pane, label="probability")
    figure.savefig(PICTURE, dpi=100)


if __name__ == "__main__":
    draw(sys.argv[1:])
