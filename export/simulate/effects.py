"""Effects of the catalogue with values at random, for the simulated robot."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from edgefilter.echo.effects.packet_loss import PacketLoss
from edgefilter.echo.measurement import Values
from edgefilter.echo.model import EchoModel
from edgefilter.types import SAMPLE_RATE, Array

PATH_CHANGE = 0.3
"""Share of wide items in which the path changes on the way."""
LOST_MORE = 2.0
"""Factor between the share of packets that a made recording loses and the share that the measured recording lost: from 1/2 to 2."""
Found = tuple[tuple[str, Values], ...]
"""Effects by name, with their values."""


def elsewhere(rng: np.random.Generator, found: Found, seconds: float) -> Found:
    """Effects that were found in one recording, as they are in another of so many seconds.

    What lasts is the same. Other packets are lost, about as often; the other events were that recording's alone.
    """
    packets = [(name, _other_packets(rng, values, seconds)) for name, values in found if name == PacketLoss.name]
    return (*packets, *EchoModel(np.ones(1, np.float32), found).lasting().effects)


def _other_packets(rng: np.random.Generator, values: Values, seconds: float) -> Values:
    length_s, times = float(values["length_ms"]) / 1000, np.atleast_1d(np.asarray(values["times_s"], float))
    share = times.size * length_s / (times.max() + length_s) * LOST_MORE ** rng.uniform(-1, 1)
    return {**values, **_lost(rng, share, length_s, seconds)}


def _lost(rng: np.random.Generator, share: float, length_s: float, seconds: float) -> Values:
    """About that share of all packets of length_s, each by itself."""
    firsts = np.arange(rng.uniform(0, length_s), seconds, length_s)
    lost = firsts[rng.random(firsts.size) < share]
    return {"times_s": lost, "lost": float(lost.size)}


def draw_effects(rng: np.random.Generator, share: float, wideness: float, seconds: float) -> Found:
    """None, one or two effects that are nobody's defect in particular, and now and then a path that changes."""
    names: list[str] = []
    if rng.random() < share:
        names += [str(name) for name in rng.choice(list(DRAWN), size=int(rng.integers(1, 3)), replace=False)]
    drawn = tuple((name, DRAWN[name](rng, seconds)) for name in names)
    if rng.random() < wideness * PATH_CHANGE:
        drawn += (("path_change", _path_change(rng, seconds)),)
    return drawn


def _decay(rng: np.random.Generator, rt60_s: float, level_db: float, samples: int) -> Array:
    """Noise that decays by 60 dB in rt60_s, its energy level_db over a unit impulse, (samples,)."""
    taps = rng.standard_normal(samples) * 10 ** (-3 * np.arange(samples) / (rt60_s * SAMPLE_RATE))
    return 10 ** (level_db / 20) * taps / np.linalg.norm(taps)


def _path_change(rng: np.random.Generator, seconds: float) -> Values:
    taps = _decay(rng, rng.uniform(0.02, 0.3), rng.uniform(-20, 0), 2048)
    return {"time_s": rng.uniform(0.2, 0.9) * seconds, "duration_s": rng.uniform(0.01, 1.0), "taps": taps}


def _late_reverb(rng: np.random.Generator, seconds: float) -> Values:
    rt60_s, level_db = rng.uniform(0.2, 1.0), rng.uniform(-20, -5)
    return {"rt60_s": rt60_s, "level_db": level_db, "taps": _decay(rng, rt60_s, level_db, 6000)}


def _chassis_resonance(rng: np.random.Generator, seconds: float) -> Values:
    return {
        "frequency_hz": 10 ** rng.uniform(2.0, 3.6),
        "q": 10 ** rng.uniform(0.7, 2.0),
        "gain_db": rng.uniform(-25, -3),
        "phase_deg": rng.uniform(-180, 180),
    }


def _compression(rng: np.random.Generator, seconds: float) -> Values:
    return {
        "threshold_db": rng.uniform(-40, -15),
        "ratio": rng.uniform(1.5, 8),
        "attack_ms": rng.uniform(1, 50),
        "release_ms": rng.uniform(50, 600),
    }


def _bandlimit(rng: np.random.Generator, seconds: float) -> Values:
    return {"cutoff_hz": rng.uniform(3000, 7500), "order": float(rng.integers(2, 9))}


def _delay_jump(rng: np.random.Generator, seconds: float) -> Values:
    steps = int(rng.integers(1, 3))
    return {"times_s": np.sort(rng.uniform(1.0, seconds, steps)), "samples": rng.uniform(-400, 400, steps)}


def _packet_loss(rng: np.random.Generator, seconds: float) -> Values:
    length_ms, share = float(rng.choice((10, 20, 30, 40, 60))), 10 ** rng.uniform(-2.5, -1.0)
    fill, fade_ms = float(rng.choice((0.0, rng.uniform(), 1.0))), float(rng.choice((0.0, rng.uniform(0, 4))))
    lost = _lost(rng, share, length_ms / 1000, seconds)
    return {**lost, "length_ms": length_ms, "fill": fill, "fade_ms": fade_ms}


DRAWN: dict[str, Callable[[np.random.Generator, float], Values]] = {
    "late_reverb": _late_reverb,
    "chassis_resonance": _chassis_resonance,
    "compression": _compression,
    "bandlimit": _bandlimit,
    "delay_jump": _delay_jump,
    "packet_loss": _packet_loss,
}
"""Effects that act on the robot alone; distortion, rattle, volume and drift are drawn for themselves, and what acts on
the whole microphone is in microphone.py."""
