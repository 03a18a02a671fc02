"""The program's command line, and the sounds that are bundled with it."""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
DEMO = ROOT / "edgefilter/demo_data"


def edgefilter(*arguments):
    return [sys.executable, "-m", "edgefilter.cli", *map(str, arguments)]
