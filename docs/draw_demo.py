"""Draws docs/before_after.png and docs/hidden.png: what `edgefilter demo` and `edgefilter demo --hidden` draw, made small.

Run from the root of the repository: python -m docs.draw_demo. It takes a minute or two.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from PIL import Image

from edgefilter.cli import main

DOCS = Path(__file__).parent
PICTURES = {"before_after.png": ([], "before_after.png"), "hidden.png": (["--hidden"], "two/before_after.png")}
WIDTH, COLOURS = 1000, 32


def shrink(drawn: Path, picture: Path) -> None:
    """Write a drawing at WIDTH pixels and COLOURS colours: about a fifth of its bytes."""
    with Image.open(drawn) as image:
        small = image.convert("RGB").resize(
            (WIDTH, round(image.height * WIDTH / image.width)), Image.Resampling.LANCZOS
        )
    small.quantize(COLOURS, dither=Image.Dither.NONE).save(picture, optimize=True)
    print(f"{picture}: {picture.stat().st_size // 1000} kB")


def draw() -> None:
    """Run both demos, and make their drawings small."""
    for name, (options, file) in PICTURES.items():
        with tempfile.TemporaryDirectory() as folder:
            if main(["demo", *options, "--output", folder]):
                raise SystemExit(1)
            shrink(Path(folder) / file, DOCS / name)


if __name__ == "__main__":
    draw()
