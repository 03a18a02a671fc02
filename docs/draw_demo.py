"""Draws docs/before_after.png and docs/hidden.png, what `edgefilter demo` and `edgefilter demo --hidden` draw, made small, and docs/report.png.

The last is the top of the second hidden robot's page. Run from the root of the repository, with Chromium installed:
python -m docs.draw_demo. It takes a minute or two.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

from PIL import Image

from edgefilter.cli import main

DOCS = Path(__file__).parent
PICTURES = {"before_after.png": ([], "before_after.png"), "hidden.png": (["--hidden"], "two/before_after.png")}
WIDTH, COLOURS = 1000, 32
PAGE, PAGE_SIZE = "two/report.html", "1180,1150"


def shrink(drawn: Path, picture: Path) -> None:
    """Write a drawing at WIDTH pixels and COLOURS colours: about a fifth of its bytes."""
    with Image.open(drawn) as image:
        small = image.convert("RGB").resize(
            (WIDTH, round(image.height * WIDTH / image.width)), Image.Resampling.LANCZOS
        )
    small.quantize(COLOURS, dither=Image.Dither.NONE).save(picture, optimize=True)
    print(f"{picture}: {picture.stat().st_size // 1000} kB")


def photograph(page: Path, picture: Path) -> None:
    """Write what Chromium shows of a page."""
    options = ("--headless", "--no-sandbox", "--hide-scrollbars", f"--window-size={PAGE_SIZE}")
    subprocess.run(["chromium", *options, f"--screenshot={picture}", page.as_uri()], check=True, capture_output=True)


def draw() -> None:
    """Run both demos, and make their drawings small."""
    for name, (options, file) in PICTURES.items():
        with tempfile.TemporaryDirectory() as folder:
            if main(["demo", *options, "--output", folder]):
                raise SystemExit(1)
            shrink(Path(folder) / file, DOCS / name)
            if options:
                photograph(Path(folder) / PAGE, Path(folder) / "report.png")
                shrink(Path(folder) / "report.png", DOCS / "report.png")


if __name__ == "__main__":
    draw()
