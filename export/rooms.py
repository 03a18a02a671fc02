"""Rooms to train in: impulse responses of robot and human by the image-source method."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from edgefilter.types import SAMPLE_RATE, Samples

HUMANS = 3
"""Positions of the human per room."""
MAX_ORDER = 60
RANGES = {
    "lab": ((5.0, 8.0), (4.0, 6.0), (0.15, 0.35), (0.6, 1.9)),
    "office": ((3.0, 5.5), (2.5, 4.5), (0.35, 0.8), (0.6, 1.9)),
    "hall": ((5.0, 9.0), (3.0, 7.0), (0.5, 1.0), (0.3, 4.0)),
}
"""Length, width in m, RT60 in s and the human's distance in m of each kind of room."""


@dataclass(frozen=True, eq=False)
class Room:
    """Impulse responses of a room. robot: (n,) from the loudspeaker to the microphone; humans: HUMANS responses (n,) from as far as RANGES says.

    Float32, 16 kHz.
    """

    kind: str
    rt60_s: float
    robot: Samples
    humans: tuple[Samples, ...]


def draw_room(rng: np.random.Generator, kind: str) -> Room:
    """A shoebox room of that kind (Allen & Berkley 1979, by pyroomacoustics), robot and humans somewhere in it."""
    import pyroomacoustics as pra  # here, so that RANGES can be had on a machine without it

    lengths, widths, decays, distances = RANGES[kind]
    size = np.array([rng.uniform(*lengths), rng.uniform(*widths), rng.uniform(2.4, 3.2)])
    rt60_s = max(rng.uniform(*decays), 1.05 * _shortest_decay(size))
    absorption, order = pra.inverse_sabine(rt60_s, size)
    room = pra.ShoeBox(size, fs=SAMPLE_RATE, materials=pra.Material(absorption), max_order=min(order, MAX_ORDER))
    margin = 0.5
    microphone = np.array(
        [rng.uniform(margin, size[0] - margin), rng.uniform(margin, size[1] - margin), rng.uniform(0.6, 1.4)]
    )
    room.add_microphone(microphone)
    loudspeaker = rng.standard_normal(3)
    room.add_source(microphone + rng.uniform(0.06, 0.3) * loudspeaker / np.linalg.norm(loudspeaker))
    for _ in range(HUMANS):
        room.add_source(_mouth(rng, microphone, size, distances))
    room.compute_rir()
    skip = pra.constants.get("frac_delay_length") // 2
    robot, *humans = (np.asarray(response[skip:], np.float32) for response in room.rir[0])
    return Room(kind, rt60_s, robot, tuple(humans))


def _shortest_decay(size: np.ndarray) -> float:
    """RT60 in s of Sabine's formula with walls that absorb everything."""
    surface = 2 * (size[0] * size[1] + size[1] * size[2] + size[0] * size[2])
    return 24 * math.log(10) / 343.0 * float(np.prod(size)) / surface


def _mouth(
    rng: np.random.Generator, microphone: np.ndarray, size: np.ndarray, distances: tuple[float, float]
) -> np.ndarray:
    """A point at such a distance from the microphone, up to 0.7 m higher, inside the room."""
    while True:
        angle, reach = rng.uniform(0, 2 * math.pi), rng.uniform(*distances)
        mouth = microphone + np.array([reach * math.cos(angle), reach * math.sin(angle), rng.uniform(0.0, 0.7)])
        if ((mouth > 0.2) & (mouth < size - 0.2)).all():
            return mouth
