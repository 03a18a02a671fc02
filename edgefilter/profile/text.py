"""A profile in words and figures, for the terminal."""

from __future__ import annotations

import numpy as np

from edgefilter.dsp.frames import decibels
from edgefilter.dsp.psd import total_power
from edgefilter.echo.effects.catalogue import find
from edgefilter.profile.approximation import LinearApproximation
from edgefilter.profile.data import DISTORTION_ORDERS, Profile
from edgefilter.profile.while_moving import WhileMoving
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples


def describe(profile: Profile) -> str:
    """Lines of text: path, decay, fan, distortion, a bar for each band's signal-to-noise ratio, effects, warnings."""
    path = profile.echo.impulse_response
    energy = to_come(path)
    fan = decibels(total_power(profile.noise_psd), 1e-20)
    distortion = ", ".join(
        f"{order}: {'below the fan' if level <= -99.0 else f'{level:.1f} dB'}"
        for order, level in zip(DISTORTION_ORDERS, profile.distortion_db, strict=True)
    )
    lines = [
        f"made        {profile.created or 'date unknown'}" + (f" from {profile.source}" if profile.source else ""),
        (
            f"path        {path.size} taps ({1000 * path.size / SAMPLE_RATE:.0f} ms), direct sound at"
            f" {profile.delay:.0f} samples ({1000 * profile.delay / SAMPLE_RATE:.1f} ms), gain {decibels(energy[0], 1e-20):.1f} dB"
        ),
        f"decay       {_decay(energy)}",
        *([f"microphones {profile.microphones}; what is said here is of the first"] if profile.array else ()),
        f"fan         {fan:.1f} dB of full scale",
        f"distortion  orders {distortion}",
        *(_left_lines(profile.approximation) if profile.approximation else ()),
        *([_moving_line(profile.while_moving)] if profile.while_moving else ()),
        "signal-to-noise ratio of the sweep, by third octave",
    ]
    for (low, high), snr in zip(profile.band_hz, profile.band_snr_db, strict=True):
        bar = "#" * int(np.clip(round(float(snr) / 2), 0, 40))
        lines.append(f"  {low:5.0f} - {high:4.0f} Hz {snr:6.1f} dB  {bar}".rstrip())
    for name, values in profile.echo.effects:
        told = [(p.name, values[p.name]) for p in find(name).told if p.name in values]
        figures = ", ".join(f"{key} = {_figures(value)}" for key, value in told)
        lines.append(f"effect      {name}{', in one recording' if find(name).event else ''}: {figures}")
    lines.extend(f"WARNING     {text}" for text in profile.warnings)
    if not profile.warnings:
        lines.append("trust       nothing doubtful found")
    return "\n".join(lines)


def _figures(value: float | Array) -> str:
    """Three significant digits, which --json has whole; of a long array its length."""
    if np.size(value) > 4:
        return f"{np.size(value)} values"
    rounded = [f"{float(f'{number:.3g}'):g}" for number in np.ravel(value)]
    return rounded[0] if np.ndim(value) == 0 else f"({', '.join(rounded)})"


def _left_lines(known: LinearApproximation) -> list[str]:
    """What a linear path leaves at each volume, the loudest first, then the same in a sentence."""
    left = known.over_linear_db("noise", "even", "odd")
    parts = {name: known.over_linear_db(name) for name in ("even", "odd", "noise")}
    lines = ["left of the robot's voice by the best linear path: distortion of even and odd order, and noise"]
    for i in reversed(range(left.size)):
        told = [
            f"{name} {'below ' if name != 'noise' and db[i] < known.least_db[i] else ''}"
            f"{max(db[i], known.least_db[i]) if name != 'noise' else db[i]:.0f}"
            for name, db in parts.items()
        ]
        lines.append(f"  played at {known.level_db[i]:5.1f} dB of full scale {left[i]:6.1f} dB  ({', '.join(told)})")
    below = known.level_db[-1] - known.level_db
    softer = ", ".join(f"{below[i]:.0f} dB softer {left[i]:.0f}" for i in reversed(range(left.size - 1)))
    lines.append(f"volume      at this volume the path leaves {left[-1]:.0f} dB{'; ' if softer else ''}{softer}")
    return lines


def _moving_line(heard: WhileMoving) -> str:
    return (
        f"moving      what sounds with the voice is {-heard.level_db:.0f} dB below it, taken for a human {heard.moments:.0f} times in"
        f" {heard.seconds:.0f} s"
    )


def to_come(path: Samples) -> Array:
    """Energy of an impulse response (taps,) from each sample on (Schroeder 1965), (taps,)."""
    return np.cumsum(path[::-1].astype(np.float64) ** 2)[::-1]


def _decay(energy: Array) -> str:
    """Times at which the energy that is still to come has fallen by 10, 20 and 30 dB, counted from the direct sound."""
    left = decibels(energy / max(energy[0], 1e-30), 1e-20)
    times = [(db, int(np.argmax(left < -db))) for db in (10, 20, 30) if left.min() < -db]
    told = [f"-{db} dB after {1000 * max(n - PRE_ROLL, 0) / SAMPLE_RATE:.0f} ms" for db, n in times]
    return ", ".join(told) or "less than 10 dB"
