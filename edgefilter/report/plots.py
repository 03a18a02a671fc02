"""Pictures of a profile and of a filtered recording; with the rest of report/, the only import of matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from edgefilter.audio.files import whole
from edgefilter.dsp.frames import decibels
from edgefilter.errors import EdgefilterError
from edgefilter.profile.approximation import LinearApproximation
from edgefilter.profile.data import DISTORTION_ORDERS, GRID_HZ, LOW_SNR_DB, Profile
from edgefilter.profile.text import to_come
from edgefilter.report.media import spectrogram_db
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

INK, ACCENT, SOFT = "#222222", "#b5442c", "#5b7c99"


def plot_profile(profile: Profile, path: str | Path) -> None:
    """Draw impulse response, decay, both readings of the response with the fan, and the bands, to a PNG, SVG or PDF.

    Below them, where the profile holds them: at each level of the voice the echo that a linear path explains, and the residual.
    """
    known = profile.approximation
    figure = _figure(11, 8 if known is None else 11.5)
    if known is None:
        axes = figure.subplots(2, 2)
    else:
        grid = figure.add_gridspec(2, 1, height_ratios=(8, 3.5))
        axes = figure.add_subfigure(grid[0]).subplots(2, 2)
        _draw_levels(figure.add_subfigure(grid[1]), known)
    taps = profile.echo.impulse_response.astype(np.float64)
    ms = (np.arange(taps.size) - PRE_ROLL) / SAMPLE_RATE * 1000
    first = ms < 40
    axes[0, 0].plot(ms[first], taps[first], color=INK, linewidth=0.8)
    _label(axes[0, 0], "Impulse response, first 40 ms", "ms after the direct sound", "amplitude")
    squared, left = taps**2, to_come(profile.echo.impulse_response)
    decay = _db(squared / max(float(np.max(squared)), 1e-30))
    axes[0, 1].plot(ms, decay, color=SOFT, linewidth=0.3, label="impulse response, squared")
    axes[0, 1].plot(ms, _db(left / max(left[0], 1e-30)), color=ACCENT, label="energy that is still to come")
    axes[0, 1].set_ylim(-90, 3)
    axes[0, 1].legend(loc="upper right")
    _label(axes[0, 1], "Decay", "ms after the direct sound", "dB")
    _draw_spectra(axes[1, 0], profile)
    _draw_bands(axes[1, 1], profile)
    if profile.warnings:
        warnings = "; ".join(text.split(":")[0][:60] for text in profile.warnings)[:140]
        figure.suptitle(f"not to be trusted: {warnings}", color=ACCENT, fontsize=9)
    _save(figure, path)


def plot_before_after(signals: Mapping[str, Samples], path: str | Path) -> None:
    """Draw the spectrograms of named recordings (n,), 16 kHz, one below the other with one legend, to a PNG, SVG or PDF."""
    figure = _figure(11, 2.4 * len(signals))
    axes = figure.subplots(len(signals), 1, sharex=True, squeeze=False)[:, 0]
    levels = [spectrogram_db(samples) for samples in signals.values()]
    loudest = max(float(level.max()) for level in levels)
    for axis, level, (name, samples) in zip(axes, levels, signals.items(), strict=True):
        extent = (0, samples.size / SAMPLE_RATE, 0, SAMPLE_RATE / 2000)
        look = {"vmin": -85, "vmax": -35, "cmap": "magma"}
        picture = axis.imshow((level - loudest).T, origin="lower", aspect="auto", extent=extent, **look)
        axis.set_title(name, loc="left", fontsize=10)
        axis.set_ylabel("frequency, kHz")
    axes[-1].set_xlabel("time, s")
    label = "colour: level, dB relative to the loudest sound"
    figure.colorbar(picture, ax=list(axes), label=label, aspect=40, pad=0.01)
    _save(figure, path)


def _draw_levels(part: SubFigure, known: LinearApproximation) -> None:
    """Densities at the microphone, one picture a level, the softest first."""
    curves = (("linear", INK, "-"), ("even", ACCENT, "-"), ("odd", ACCENT, ":"), ("noise", SOFT, "-"))
    left = known.over_linear_db("noise", "even", "odd")
    top = float(_db(known.linear.max()))
    axes = part.subplots(1, left.size, sharey=True, squeeze=False)[0]
    for i, axis in enumerate(axes):
        for name, colour, style in curves:
            density = getattr(known, name)[i, 1:]
            density = np.where(density > 0.0, _db(density), np.nan)  # chance takes the noise off to below 0
            label = name if name in ("linear", "noise") else f"{name} distortion"
            axis.semilogx(GRID_HZ[1:], density, color=colour, linestyle=style, linewidth=1.0, label=label)
        axis.set_xlim(50, 8000)
        axis.set_ylim(top - 85, top + 5)
        title = f"Played at {known.level_db[i]:.1f} dB of full scale:\na linear path leaves {left[i]:.1f} dB"
        _label(axis, title, "Hz", "dB of full scale² / Hz, at the microphone" if i == 0 else "")
    axes[0].legend(loc="upper right", fontsize=8)


def _draw_spectra(axis: Axes, profile: Profile) -> None:
    n = max(1 << 15, profile.echo.impulse_response.size)
    spectrum = np.abs(np.fft.rfft(profile.echo.impulse_response, n))
    hz = np.arange(spectrum.size) * SAMPLE_RATE / n
    axis.semilogx(hz[1:], _db(spectrum[1:] ** 2), color=SOFT, linewidth=0.5, label="from the impulse response")
    smoothed = "smoothed: |Hm Hs|, eq. (5) of Li et al. 2024"
    axis.semilogx(GRID_HZ[1:], _db(profile.response[1:] ** 2), color=INK, linewidth=1.2, label=smoothed)
    fan = axis.twinx()
    fan.semilogx(GRID_HZ[1:], _db(profile.noise_psd[1:]), color=ACCENT, linewidth=1.0)
    fan.set_ylabel("fan, dB of full scale² / Hz", color=ACCENT)
    axis.set_xlim(50, 8000)
    axis.set_ylim(-60, max(10.0, float(_db(profile.response**2).max()) + 3))
    axis.legend(loc="lower center", fontsize=8)
    _label(axis, "Response and fan", "Hz", "dB")


def _draw_bands(axis: Axes, profile: Profile) -> None:
    low, high = profile.band_hz.T
    colours = [ACCENT if snr < LOW_SNR_DB else SOFT for snr in profile.band_snr_db]
    axis.bar(low, profile.band_snr_db, width=high - low, align="edge", color=colours, edgecolor="white")
    axis.axhline(LOW_SNR_DB, color=INK, linewidth=0.8, linestyle=":")
    axis.set_xscale("log")
    title = f"Signal-to-noise ratio of the sweep by third octave\nred: too noisy, below {LOW_SNR_DB:.0f} dB"
    by_order = zip(DISTORTION_ORDERS, profile.distortion_db, strict=True)
    orders = ", ".join(f"{order}: {level:.0f}" for order, level in by_order)
    _label(axis, f"{title}\ndistortion by harmonic, dB: {orders}", "Hz", "dB")


def _db(power: Array) -> Array:
    return decibels(power, 1e-20)


def _label(axis: Axes, title: str, x: str, y: str) -> None:
    axis.set_title(title, loc="left", fontsize=10)
    axis.set_xlabel(x)
    axis.set_ylabel(y)
    axis.grid(alpha=0.25)


def _figure(width: float, height: float) -> Figure:
    return Figure(figsize=(width, height), layout="constrained", dpi=110)


def _save(figure: Figure, path: str | Path) -> None:
    try:
        with whole(path, "the picture") as file:
            figure.savefig(file, format=Path(path).suffix[1:] or "png")
    except ValueError as error:
        reason = str(error).splitlines()[0]
        raise EdgefilterError(
            f"{path}: the picture cannot be written ({reason}); name a .png, .svg or .pdf file"
        ) from None
