"""What is said of a program of other people that a simulated robot's sound passes through, and numbers to set it by.

wild_tuning.py and wild_reporting.py share no suite, so that a suite's way to do things is not learned. Right names: the
first is what the manual says that the effect does, others that are right as well stand behind it, the reason beside
them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bench.simulate.wild_tools import Command

Rng = np.random.Generator
Place = Literal["source", "room", "microphone"]


@dataclass(frozen=True)
class Program:
    """One effect of one program: where it stands, the names that are right, and a setting drawn at random.

    draw: None for a simulator of rooms, which is given the room itself.
    """

    name: str
    place: Place
    right: tuple[str, ...]
    draw: Callable[[Rng], Command] | None


def either(rng: Rng, low: float, high: float) -> float:
    """A number of that size, of either sign."""
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))


def volume(rng: Rng) -> float:
    """dB: much softer, or a little louder, as the headroom is."""
    return float(rng.choice([rng.uniform(-8.0, -1.5), rng.uniform(1.5, 2.5)]))


def gains(rng: Rng, count: int, most: float = 9.0) -> list[float]:
    """(count,) dB of neighbouring bands, none alike."""
    return [float(round(value, 1)) for value in rng.uniform(-most, most, count)]


def echoes_ms(rng: Rng, count: int) -> list[float]:
    return sorted(float(round(value, 2)) for value in rng.uniform(1.0, 9.0, count))
