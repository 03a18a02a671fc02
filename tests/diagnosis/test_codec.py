"""Noise that follows the voice as a codec's does is named so; what moves, distorts or sounds by itself is not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.recording import Recording, diagnose
from edgefilter.diagnosis.straightened import Straightened
from edgefilter.echo.effect import complete, vanishes
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.measurement import Values
from tests.diagnosis.robot_scene import coded, lossy, profile, record, voice

SECONDS = 5.5


def fitted(recording: np.ndarray, x: np.ndarray) -> tuple[Straightened, Values]:
    """The codec fitted to a recording beside nothing else."""
    prepared = prepare(profile(), recording, x)
    return prepared, prepared.model.fitted("codec", prepared.measurement)


def trembling(x: np.ndarray) -> np.ndarray:
    place = np.arange(x.size) + 1.5 * np.sin(2 * np.pi * 5 * np.arange(x.size) / 16000)
    return np.interp(place, np.arange(x.size), x).astype(np.float32)


def talked_into(x: np.ndarray) -> np.ndarray:
    return record(x) + 0.3 * np.roll(record(voice(SECONDS)[::-1]), 40_000)


@pytest.mark.slow
@pytest.mark.parametrize("step_db", [-8.0, -14.0])
def test_a_codec_is_named_with_how_loud_its_noise_is(step_db: float) -> None:
    x = voice(SECONDS)
    recording = record(coded(x, step_db))
    found = diagnose(profile(), recording, x)
    assert Recording(recording, x, profile()).settle(found, ["codec"])[2].irreducible_db == found.irreducible_db
    assert [finding.effect for finding in found.ranking] == ["codec"] and found.verdict == "missing"
    finding = found.ranking[0]
    assert finding.excess_after_db < 0.5 * finding.excess_before_db and found.irreducible_db > 2.0
    assert finding.parameters["below_voice_db"].value == pytest.approx(-step_db, abs=3.0)
    assert "follows it in every band" in finding.evidence and "codec" in [row.effect for row in found.tried]


@pytest.mark.slow
def test_where_the_codec_cuts_the_band_both_are_named() -> None:
    x = voice(SECONDS)
    low = signal.sosfilt(signal.cheby2(10, 50, 4000, fs=16000, output="sos"), coded(x, -8.0)).astype(np.float32)
    assert {finding.effect for finding in diagnose(profile(), record(low), x).ranking} == {"bandlimit", "codec"}


def test_the_noise_in_a_band_follows_the_voice_in_that_band() -> None:
    n = 16_000
    low, high = (np.sin(2 * np.pi * hz * np.arange(n) / 16_000).astype(np.float32) for hz in (750.0, 6250.0))
    half = np.arange(n) < n // 2
    values = complete(find("codec"), {"power": np.ones(16), "decay_ms": 4.0})
    noise = find("codec").variance(np.where(half, low, high), values, 16_000)
    assert noise.shape == (16, n)
    first, second = noise[:, n // 4], noise[:, 3 * n // 4]
    assert first.argmax() == 1 and second.argmax() == 12
    assert first[12] < 1e-3 * first[1] and second[1] < 1e-3 * second[12]


@pytest.mark.parametrize(
    "change",
    [
        record,
        lambda x: record((x * (1 + 0.4 * np.sin(2 * np.pi * 5 * np.arange(x.size) / 16000))).astype(np.float32)),
        lambda x: record(trembling(x)),
        lambda x: record((x + 2.0 * x * np.abs(x)).astype(np.float32)),
        lambda x: record(np.clip(x, -0.1, 0.1).astype(np.float32)),
        lambda x: record(lossy(x, 320, 0.0)),
        talked_into,
        lambda x: record(x) + np.float32(0.01) * np.random.default_rng(1).standard_normal(x.size).astype(np.float32),
    ],
    ids=["nothing", "tremolo", "flutter", "distortion", "clipping", "lost packets", "talker", "fan"],
)
def test_what_is_left_of_something_else_is_no_codec(change) -> None:
    x = voice(SECONDS)
    _, values = fitted(change(x), x)
    assert vanishes(find("codec"), values)


def test_the_score_counts_the_noise_as_expected() -> None:
    x = voice(SECONDS)
    prepared, values = fitted(record(coded(x, -8.0)), x)
    before, after = (prepared.of(model) for model in (prepared.model, prepared.model.with_effect("codec", values)))
    assert after.excess_db < 0.4 * before.excess_db and prepared.silences_db(after) < 0.5
    assert after.irreducible_db > 2.0
