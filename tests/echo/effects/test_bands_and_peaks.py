"""Limiters hold peaks down, multi-band compressors each of their bands; either is told from one compressor."""

import numpy as np
import pytest

from edgefilter.echo.effect import complete, neutral
from edgefilter.echo.effects import catalogue
from edgefilter.echo.effects.multiband_compression import find_crossovers
from edgefilter.echo.wiener import spectra
from tests.conformance import robot_alone

LIMITER, BANDS = catalogue.find("limiter"), catalogue.find("multiband_compression")


def tone(hz: float, level_db: float, seconds: float = 1.0) -> np.ndarray:
    """A sine whose peaks are at that level."""
    n = np.arange(round(16_000 * seconds))
    return (10 ** (level_db / 20) * np.sin(2 * np.pi * hz / 16_000 * n)).astype(np.float32)


def test_no_peak_passes_the_ceiling_and_what_stays_below_is_untouched():
    values = complete(LIMITER, {"ceiling_db": -12.0, "release_ms": 100.0})
    assert np.abs(LIMITER.apply(tone(500, -2.0), values, 16_000)).max() == pytest.approx(10 ** (-12 / 20), rel=1e-5)
    quiet = tone(500, -12.5)
    np.testing.assert_array_equal(LIMITER.apply(quiet, values, 16_000), quiet)


def test_the_gain_comes_back_exponentially():
    values = complete(LIMITER, {"ceiling_db": -20.0, "release_ms": 200.0})
    x = np.concatenate((tone(1000, 0.0), 1e-3 * np.ones(8000, np.float32)))
    after = 20 * np.log10(LIMITER.apply(x, values, 16_000)[16_000 + 1600] / 1e-3)
    assert after == pytest.approx(-20.0 + 0.1 / 0.2 * 20 / np.log(10), abs=0.1)  # the peak falls by 1/e in 200 ms


@pytest.mark.parametrize(("hz", "band"), [(60, 0), (900, 1), (7000, 2)])
def test_each_band_is_turned_down_by_its_own_ratio(hz, band):
    ratio = np.ones(3)
    ratio[band] = 4.0
    values = {"crossover_hz": np.array([250.0, 3000.0]), "threshold_db": -30.0, "ratio": ratio, "release_ms": 50.0}
    out = BANDS.apply(tone(hz, -7.0), complete(BANDS, values), 16_000)
    # 20 dB over the threshold are let through as 5; the edges of its neighbours, 42 dB down, add some tenths
    assert 20 * np.log10(np.std(out[8000:]) / np.std(tone(hz, -7.0))) == pytest.approx(-15.0, abs=0.5)


def test_bands_at_rest_add_up_to_the_voice_but_for_the_crossovers_phase():
    values = {"crossover_hz": np.array([300.0, 2500.0]), "makeup_db": np.full(3, 6.0)}
    out = BANDS.apply(np.eye(1, 4096, dtype=np.float32)[0], complete(BANDS, values), 16_000)
    gain_db = 20 * np.log10(np.abs(np.fft.rfft(out)))
    np.testing.assert_allclose(gain_db[5:], 6.0, atol=0.7)  # two crossovers one after the other, not compensated


def test_crossovers_are_found_by_their_phase_and_only_where_they_are():
    values = {"crossover_hz": np.array([350.0, 2000.0]), "makeup_db": np.array([2.0, 1.0, -1.0])}
    measurement, model = robot_alone("multiband_compression", values)
    low, high, _ = find_crossovers(spectra(measurement, model, 20.0))
    assert low == pytest.approx(350, rel=0.2) and high == pytest.approx(2000, rel=0.2)
    turned, model = robot_alone("playback_gain", {"gain_db": -4.0})
    assert BANDS.fit(turned, model) == neutral(BANDS)


def test_a_volume_that_was_turned_is_no_limiter():
    assert LIMITER.fit(*robot_alone("playback_gain", {"gain_db": -4.0})) == neutral(LIMITER)
