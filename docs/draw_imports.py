"""Draws docs/imports.png: the rooms of the package on their floors, and who imports whom.

Run from the root of the repository: python -m docs.draw_imports. Rooms, floors and arrows are those that
tests/test_imports.py holds the package to.

The rooms stand on a staircase, each in a row and a column of its own. An arrow leaves its importer to the right and
drops into what it imports: to the right of a room and above it there is no other, so that no arrow crosses a room.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch

from tests.test_imports import LAYERS, all_arrows, between_rooms, summary

PICTURE = Path(__file__).with_name("imports.png")
DPI = 100
COLUMN, ROW = 89, 66  # pixels from room to room
ROOM = (82, 50)
LEFT, TOP = 44, 14
RADIUS = 6
INK, PALE = "#222222", "#f2f2ee"
COLOURS = ("#1f77b4", "#c65102", "#2ca02c", "#b22234", "#7a4fb5", "#8c564b", "#c2539f", "#5a5a5a", "#8a8b12", "#118a97")


def staircase(arrows: Counter[tuple[str, str]]) -> list[str]:
    """The rooms from the roof down; of two on one floor, first the one that imports more."""
    out = Counter(importer for importer, _ in arrows)
    return [room for layer in reversed(LAYERS) for room in sorted(layer, key=lambda room: (-out[room], room))]


def centre(step: int) -> tuple[float, float]:
    """Where the room on a step of the staircase has its middle, in pixels from the upper left corner."""
    return LEFT + COLUMN * (step + 0.5), TOP + ROW * (step + 0.5)


def width(count: int) -> float:
    """The width of an arrow in pixels: 1 for one import, 2.5 for ten, at most 5."""
    return min(0.3 + 0.7 * count**0.5, 5)


def lane(number: int, count: int, across: float) -> float:
    """The offset of one of several parallel lines that share the side of a room."""
    return (number - (count - 1) / 2) * min(across / count, 8)


def draw_floors(axes: Axes) -> None:
    """A band for each floor with its number, counted from the ground."""
    top = float(TOP)
    for number in range(len(LAYERS) - 1, -1, -1):
        height = ROW * len(LAYERS[number])
        if number % 2 == 0:
            axes.axhspan(top, top + height, color=PALE, zorder=0)
        axes.text(LEFT / 2, top + height / 2, str(number), ha="center", va="center", color="#777777", fontsize=10)
        top += height


def draw_rooms(axes: Axes, rooms: list[str]) -> None:
    """A box with its name for each room, in the colour of the arrows that leave it."""
    for step, room in enumerate(rooms):
        x, y = centre(step)
        corner = (x - ROOM[0] / 2, y - ROOM[1] / 2)
        colour = COLOURS[step % len(COLOURS)]
        axes.add_patch(
            FancyBboxPatch(
                corner, *ROOM, boxstyle="round,pad=0,rounding_size=6", fc="white", ec=colour, lw=1.4, zorder=4
            )
        )
        axes.text(x, y, room, ha="center", va="center", fontsize=9.5, color=INK, zorder=5)


def draw_arrows(axes: Axes, rooms: list[str], arrows: Counter[tuple[str, str]]) -> None:
    """Right, then down. Lanes are ordered so that arrows with one end in common do not cross."""
    step = {room: number for number, room in enumerate(rooms)}
    for (importer, imported), count in arrows.items():
        above, below = step[importer], step[imported]
        assert above < below, f"{importer} imports {imported}, which stands no lower"
        leaving = sorted((step[other] for start, other in arrows if start == importer), reverse=True)
        arriving = sorted((step[other] for other, end in arrows if end == imported), reverse=True)
        x0, y = centre(above)[0] + ROOM[0] / 2, centre(above)[1]
        y += lane(leaving.index(below), len(leaving), ROOM[1] - 6)
        x, y1 = centre(below)[0], centre(below)[1] - ROOM[1] / 2
        x += lane(arriving.index(above), len(arriving), ROOM[0] - 6)
        draw_arrow(axes, (x0, y), (x, y1), width(count), COLOURS[above % len(COLOURS)])


def draw_arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], pixels: float, colour: str) -> None:
    """One arrow with a round corner and a head."""
    y0, (x1, y1) = start[1], end
    points = pixels * 72 / DPI
    corner = [(x1 - RADIUS, y0), (x1 - 0.3 * RADIUS, y0 + 0.3 * RADIUS), (x1, y0 + RADIUS)]
    path = [start, *corner, (x1, y1 - 5)]
    axes.plot(*zip(*path), color=colour, lw=points, solid_capstyle="butt", solid_joinstyle="round", zorder=2)
    half = 1.5 + pixels / 2
    axes.fill([x1 - half, x1 + half, x1], [y1 - 6, y1 - 6, y1], color=colour, lw=0, zorder=3)


def draw_legend(axes: Axes, arrows: Counter[tuple[str, str]], bottom: float) -> None:
    """What the picture shows, in the empty corner under the staircase."""
    x, y = LEFT + 24, bottom - 4.2 * ROW
    axes.text(x, y, "Imports of edgefilter", fontsize=15, weight="bold", color=INK)
    axes.text(x, y + 30, summary(), fontsize=11, color=INK)
    axes.text(
        x,
        y + 60,
        "An arrow leads from a room to what it imports,\nin the colour of the importer.",
        fontsize=10,
        color=INK,
        va="top",
    )
    most = max(arrows.values())
    for number, count in enumerate((1, 5, most)):
        at = x + 140 * number
        axes.plot([at, at + 40], [y + 128] * 2, color=INK, lw=width(count) * 72 / DPI, solid_capstyle="butt")
        axes.text(at + 48, y + 128, f"{count} import{'s' * (count > 1)}", fontsize=10, color=INK, va="center")


def main() -> None:
    """Write the picture and print the line that docs/architecture.md quotes."""
    arrows = between_rooms(all_arrows())
    rooms = staircase(arrows)
    wide, high = LEFT + COLUMN * len(rooms) + 14, 2 * TOP + ROW * len(rooms)
    figure = plt.figure(figsize=(wide / DPI, high / DPI), dpi=DPI)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, wide), ylim=(high, 0))
    axes.set_axis_off()
    draw_floors(axes)
    draw_rooms(axes, rooms)
    draw_arrows(axes, rooms, arrows)
    draw_legend(axes, arrows, high)
    figure.savefig(PICTURE, metadata={"Description": summary()})
    print(summary())


if __name__ == "__main__":
    main()
