"""Draws docs/arrays.png: what each further microphone brings, from bench/results/arrays.json.

Run from the root of the repository: python -m docs.draw_arrays.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from bench import results

PICTURE = Path(__file__).with_name("arrays.png")
WAYS = {"as it is spoken": "crnn-{}", "finished turns": "crnn-{}-turns"}
COUNTS = (1, 2, 3, 4)
PANES = {
    "the robot talks, laboratory": ("paper/lab", "live/lab"),
    "the robot talks, office": ("paper/office", "live/office"),
    "its fan alone, both rooms": ("no_echo/",),
}
"""How the names of each pane's clips begin."""


def words_wrong(rows: list[dict], system: str) -> float:
    """Errors over words, %, an utterance counted as at most 100 %."""
    own = [row for row in rows if row["system"] == system]
    return 100 * sum(min(row["errors"], row["words"]) for row in own) / sum(row["words"] for row in own)


def draw() -> None:
    """Write the picture."""
    found = results.read(results.RESULTS / "arrays.json")["parts"]["evaluation"]["rows"]
    every = [dict(zip(found["columns"], values, strict=True)) for values in found["values"]]
    figure, panes = plt.subplots(1, len(PANES), figsize=(10.4, 3.4), sharey=True, layout="constrained")
    for pane, (title, begin) in zip(panes, PANES.items()):
        rows = [row for row in every if row["clip"].startswith(begin)]
        for shift, (way, name), colour in zip((-0.2, 0.2), WAYS.items(), ("#1f77b4", "#c65102")):
            systems = [name.format(count) if count > 1 else "crnn" for count in COUNTS]
            heights = [words_wrong(rows, system) for system in systems]
            bars = pane.bar([count + shift for count in COUNTS], heights, 0.38, color=colour, label=way)
            pane.bar_label(bars, fmt="%.0f", fontsize=9)
        pane.axhline(words_wrong(rows, "clean"), color="#222222", linestyle="--", label="the human alone")
        pane.set(title=title, xlabel="microphones", xticks=COUNTS)
        pane.spines[["top", "right"]].set_visible(False)
    panes[0].set(ylabel="words wrong, %", ylim=(0, 100))
    panes[0].legend(frameon=False)
    figure.savefig(PICTURE, dpi=100)


if __name__ == "__main__":
    draw()
