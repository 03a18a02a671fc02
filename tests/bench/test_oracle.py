"""The best linear filter of a stretch: it finds a filter that is there, and never does worse than any other."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from bench.measure import oracle

RATE = 16000
SPAN = slice(16_000, 32_000)


def scene(noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    ref = rng.standard_normal(40_000)
    path = rng.standard_normal(2_000) * np.exp(-np.arange(2_000) / 300)
    return ref, path, signal.fftconvolve(ref, path)[: ref.size] + noise * rng.standard_normal(ref.size)


def test_a_path_that_is_shorter_than_the_filter_leaves_the_noise():
    ref, _, echo = scene(noise=0.1)
    rest = oracle.oracle_rest(echo, ref, SPAN)
    # 6400 taps fitted to 16000 samples of white noise take 40 % of the noise with them, 2.2 dB
    assert 10 * np.log10(np.mean(rest**2) / 0.01) == pytest.approx(10 * np.log10(1 - oracle.TAPS / 16_000), abs=0.5)


def test_it_leaves_no_more_than_the_true_path_does():
    ref, path, echo = scene(noise=0.3)
    true = (echo - signal.fftconvolve(ref, path)[: ref.size])[SPAN]
    assert np.mean(oracle.oracle_rest(echo, ref, SPAN) ** 2) < np.mean(true**2)


def test_a_span_at_the_very_beginning_has_silence_before_it():
    ref, _, echo = scene(noise=0.0)
    rest = oracle.oracle_rest(echo, ref, slice(0, 16_000))
    assert oracle.erle_db(echo[:16_000], rest) > 40


def test_rumble_does_not_count():
    t = np.arange(RATE) / RATE
    voice, rumble = np.sin(2 * np.pi * 500 * t), 10 * np.sin(2 * np.pi * 30 * t)
    assert oracle.erle_db(voice + rumble, 0.1 * voice + rumble) == pytest.approx(20.0, abs=0.5)


def test_a_folder_without_recordings_is_one_line(tmp_path: Path, monkeypatch, capsys):
    words = ["oracle", str(tmp_path), "--speech", str(tmp_path), "--output", str(tmp_path / "o")]
    monkeypatch.setattr(sys, "argv", words)
    assert oracle.main() == 1
    assert capsys.readouterr().err.startswith("oracle: ") and not list(tmp_path.iterdir())
