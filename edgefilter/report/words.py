"""The names of effects and verdicts as people say them, for the terminal and the report."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from edgefilter.echo.effects.catalogue import find, names

if TYPE_CHECKING:
    from edgefilter.diagnosis.diagnose import Interval

UNITS = {"1": "", "1e-6": "ppm"}
"""Units of parameters that read better otherwise."""


def spoken(effect: str) -> str:
    """The effect inside a sentence; one without a title, or whose file is not loaded, by its name without underscores."""
    return (find(effect).title if effect in names() else "") or effect.replace("_", " ")


def title(effect: str) -> str:
    """The effect as a heading, without its article."""
    words = spoken(effect).removeprefix("a ")
    return words[:1].upper() + words[1:]


def joined(words: Iterable[str]) -> str:
    """Join words as in "a, b and c"."""
    *first, last = list(words) or [""]
    return f"{', '.join(first)} and {last}" if first else last


def sentence(words: str) -> str:
    """The words with a capital and a full stop, where they have none."""
    words = words.strip()
    return words and words[:1].upper() + words[1:] + ("" if words.endswith((".", "!", "?")) else ".")


def headline(verdict: str, effects: Iterable[str], calibrated: bool = True) -> str:
    """One sentence for the verdict of a diagnosis.

    Calibrated: whether there was a profile that could lack something.
    """
    found = joined(spoken(effect) for effect in effects)
    if verdict == "missing" and not calibrated:
        return f"Found in the recording, besides what is stationary and linear: {found}."
    if verdict == "explained" and not calibrated:
        return (
            "A stationary linear path explains this recording; what it is made of cannot be told without a calibration."
        )
    if verdict == "missing":
        return f"Missing from the profile: {found}."
    if verdict == "explained":
        return "The profile explains this recording."
    return "Something is in this recording that no known effect explains" + (f", besides {found}." if found else ".")


def decibels(value: float) -> str:
    """One decimal, and no minus before a zero."""
    return f"{0.0 if abs(value) < 0.05 else value:.1f}"


def figure(value: float) -> str:
    """A number with three significant digits; without an exponent where people would not write one."""
    value = float(value)
    if value == 0 or not 1e-4 <= abs(value) < 1e7:
        return f"{value:.3g}"
    return f"{value:.{max(0, 2 - math.floor(math.log10(abs(value))))}f}"


def interval_text(interval: Interval) -> str:
    """Say "0.61 s (0.56 to 0.66)"; several values one after the other, each with its own range."""
    values, lows, highs = (np.atleast_1d(x) for x in (interval.value, interval.low, interval.high))
    unit = UNITS.get(interval.unit, interval.unit)
    shown = [
        f"{figure(v)} {unit}".rstrip() + (f" ({figure(low)} to {figure(high)})" if low < high else "")
        for v, low, high in zip(values, lows, highs)
    ]
    return ", ".join(shown) or "none"
