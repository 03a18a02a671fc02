"""What code makes of a recording, held against what it made before: a number or a condition that nobody meant to change is noticed."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

BEFORE = Path(__file__).parent / "data/before"
WRITE = "EDGEFILTER_WRITE_BEFORE"
"""Set in the environment it writes what is found, in place of what was found before: read the difference before you commit it."""
DIGITS = 6
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
MOST = 150
"""Entries of a list; of a longer one every second, third and so on."""


def same_as_before(name: str, found: object, absolute: float = 5e-3, relative: float = 1e-4) -> None:
    """Hold numbers, words, and lists and mappings of them, against those of NAME.json.

    absolute, relative: by which a number may be off, the larger of the two. Processors round differently; what is found
    by trying, or by a network, amplifies that.
    """
    file, now = BEFORE / f"{name}.json", _plain(found)
    if os.environ.get(WRITE):
        file.write_text(json.dumps(now, indent=0, separators=(",", ":")) + "\n")
    different = _differences(json.loads(file.read_text()), now, name, (absolute, relative))
    assert not different, "\n".join(
        [*different[:10], f"{len(different)} in all; {WRITE}=1 writes them, where they are meant"]
    )


def levels_db(x: np.ndarray, seconds: float = 0.25) -> list[float]:
    """Level of each stretch of x (n,), dB re full scale, no less than -100."""
    size = round(seconds * 16000)
    power = np.mean(np.square(x[: x.size // size * size].reshape(-1, size), dtype=np.float64), axis=1)
    return [float(level) for level in 10.0 * np.log10(power + 1e-10)]


def _plain(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(each) for each in value[:: 1 + len(value) // MOST]]
    if isinstance(value, (float, np.floating)):
        return float(f"{value:.{DIGITS}g}") if np.isfinite(value) else str(value)
    return int(value) if isinstance(value, np.integer) else value


def _differences(before: object, now: object, where: str, within: tuple[float, float]) -> list[str]:
    if isinstance(before, dict) and isinstance(now, dict) and before.keys() == now.keys():
        return [one for key in before for one in _differences(before[key], now[key], f"{where}.{key}", within)]
    if isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        pairs = enumerate(zip(before, now, strict=True))
        return [one for at, pair in pairs for one in _differences(*pair, f"{where}[{at}]", within)]
    return [] if _equal(before, now, *within) else [f"{where}: {before!r} before, {now!r} now"]


def _equal(before: object, now: object, absolute: float, relative: float) -> bool:
    """Numbers within what processors differ by, also in words, where that may turn their last digit."""
    if isinstance(before, str) and isinstance(now, str):
        digits = [len(number.partition(".")[2]) for number in NUMBER.findall(before)]
        pairs = zip(map(float, NUMBER.findall(before)), map(float, NUMBER.findall(now)), digits, strict=False)
        close = all(abs(one - other) < 1.01 * 10.0**-count + relative * abs(one) for one, other, count in pairs)
        return close and NUMBER.sub("#", before) == NUMBER.sub("#", now)
    numbers = all(isinstance(one, (int, float)) and not isinstance(one, bool) for one in (before, now))
    return bool(now == (pytest.approx(before, rel=relative, abs=absolute) if numbers else before))
