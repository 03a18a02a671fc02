"""Rooms, converter clocks and levels of the simulated robots with a hidden effect.

Shares no code with the filter's own echo model.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pyroomacoustics as pra
from scipy import signal

from bench.simulate.simulated_robot import RATE, Array

SOUND_M_S = 343.0
PHASES = 4096
HALF_WIDTH = 32


@dataclass(frozen=True)
class Place:
    """A robot in a shoebox room.

    Size (3,) in m, wall absorption, highest order of reflection, microphone and loudspeaker (3,) in m.
    """

    size: Array
    absorption: float
    order: int
    microphone: Array
    loudspeaker: Array

    def response(self) -> Array:
        """(m,) impulse response by image sources (Allen & Berkley 1979; pyroomacoustics), without its filter delay."""
        room = pra.ShoeBox(self.size, fs=RATE, materials=pra.Material(self.absorption), max_order=self.order)
        room.add_microphone(self.microphone)
        room.add_source(self.loudspeaker)
        room.compute_rir()
        return np.asarray(room.rir[0][0][pra.constants.get("frac_delay_length") // 2 :], np.float64)

    def microphone_moved(self, step: Array) -> Place:
        return replace(self, microphone=self.microphone + step)

    def robot_moved(self, step: Array) -> Place:
        """Loudspeaker and microphone moved together, kept 0.2 m from the walls."""
        inside = [np.clip(point + step, 0.2, self.size - 0.2) - point for point in (self.microphone, self.loudspeaker)]
        allowed = np.where(np.abs(inside[0]) < np.abs(inside[1]), *inside)
        return replace(self, microphone=self.microphone + allowed, loudspeaker=self.loudspeaker + allowed)


def draw_place(
    rng: np.random.Generator, rt60_s: float, geometry: Array | None = None, size: Array | None = None
) -> Place:
    """A room of this reverberation time (Sabine's formula, +-25 %).

    geometry (3,): from microphone to loudspeaker in m, else drawn, 0.1-0.3 m. size (3,) in m, else drawn.
    """
    if size is None:
        size = np.array([rng.uniform(3.8, 7.5), rng.uniform(3.2, 5.5), rng.uniform(2.5, 3.2)])
    if geometry is None:
        direction = np.array([*rng.uniform(-1, 1, size=2), rng.uniform(-0.8, -0.1)])
        geometry = rng.uniform(0.1, 0.3) * direction / np.linalg.norm(direction)
    absorption, order = pra.inverse_sabine(rt60_s, size)
    microphone = np.array([*rng.uniform(0.9, size[:2] - 0.9), rng.uniform(0.8, 1.3)])
    return Place(size, absorption, min(order, 50), microphone, microphone + geometry)


def direction(rng: np.random.Generator) -> Array:
    """(3,) of length 1, anywhere."""
    x = rng.standard_normal(3)
    return x / np.linalg.norm(x)


def reflector(rng: np.random.Generator, place: Place) -> Callable[[float], Array]:
    """Impulse response (m,) of one reflection from a person or a panel at a given distance in m.

    A flat mirror that returns less treble the rougher it is: an image source and a low-pass of first order.
    """
    towards, loss, corner = direction(rng), rng.uniform(0.5, 0.9), rng.uniform(2500, 7000)
    towards[2] *= 0.2
    towards /= np.linalg.norm(towards)
    b, a = signal.butter(1, corner, fs=RATE)

    def at(distance_m: float) -> Array:
        offset = place.loudspeaker - place.microphone
        image = offset + 2 * max(distance_m - offset @ towards, 0.02) * towards
        length = float(np.linalg.norm(image))
        impulse = fractional_delay(np.eye(1, 4096)[0], length / SOUND_M_S * RATE)
        return signal.lfilter(b, a, loss / (4 * math.pi * length) * impulse)

    return at


@functools.cache
def _sinc_table() -> Array:
    """(PHASES + 1, 2 HALF_WIDTH) Kaiser-windowed sincs (beta 9), row p for a position p / PHASES behind a sample."""
    distance = np.arange(-HALF_WIDTH + 1, HALF_WIDTH + 1)[None] - np.arange(PHASES + 1)[:, None] / PHASES
    return np.sinc(distance) * np.i0(9.0 * np.sqrt(np.clip(1.0 - (distance / HALF_WIDTH) ** 2, 0.0, 1.0))) / np.i0(9.0)


def read_at(x: Array, positions: Array) -> Array:
    """Samples x (n,) at any positions (m,) in samples, 0 outside.

    Positions rounded to 1/4096 of a sample (error below -74 dB at 4 kHz).
    """
    table = _sinc_table()
    padded = np.pad(x, 2 * HALF_WIDTH)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * HALF_WIDTH)
    whole = np.floor(positions).astype(int)
    phase = np.rint((positions - whole) * PHASES).astype(int)
    first = np.clip(whole + HALF_WIDTH + 1, 0, windows.shape[0] - 1)
    out = np.empty(positions.size)
    for start in range(0, positions.size, 1 << 13):
        part = slice(start, start + (1 << 13))
        out[part] = np.einsum("ij,ij->i", windows[first[part]], table[phase[part]])
    return out


def fractional_delay(x: Array, samples: float) -> Array:
    """Samples x (n,) later by any number of samples >= 0, of the same length."""
    whole = int(np.floor(samples))
    taps = read_at(np.eye(1, 4 * HALF_WIDTH, 2 * HALF_WIDTH)[0], np.arange(4 * HALF_WIDTH) - (samples - whole))
    late = signal.oaconvolve(x, taps)[2 * HALF_WIDTH :][: x.size]
    return np.concatenate([np.zeros(whole), late])[: x.size]


def sweep(rng: np.random.Generator) -> Array:
    """Exponential sweep, 40 to 8000 Hz (Farina 2000, eq. (2)), 5-8 s, peak 0.25-0.45, between silence."""
    seconds, peak = rng.uniform(5, 8), rng.uniform(0.25, 0.45)
    n = int(seconds * RATE)
    rate = math.log(8000 / 40)
    x = peak * np.sin(2 * math.pi * 40 * seconds / rate * (np.exp(np.arange(n) / n * rate) - 1.0))
    fade = np.sin(0.5 * math.pi * np.arange(320) / 320) ** 2
    x[:320] *= fade
    x[-320:] *= fade[::-1]
    return np.concatenate([np.zeros(RATE // 2), x, np.zeros(RATE)])


def power(x: Array) -> float:
    return float(np.mean(np.square(x)))


def decibels(ratio: float) -> float:
    return 10 * math.log10(max(ratio, 1e-12))


def solve(measure: Callable[[float], float], target: float, low: float, high: float, tolerance: float = 0.15) -> float:
    """The x between low and high (both > 0) where measure (rising or falling in x) is target: bisection of log x.

    An end if out of reach.
    """
    rising = measure(high) > measure(low)
    a, b = math.log(low), math.log(high)
    for _ in range(14):
        middle = 0.5 * (a + b)
        found = measure(math.exp(middle))
        if abs(found - target) < tolerance:
            break
        a, b = (middle, b) if (found < target) == rising else (a, middle)
    return math.exp(middle)
