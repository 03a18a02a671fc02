"""Lost packets are found one by one; what a microphone drops, a codec, a compressor and a jump take away is none."""

from __future__ import annotations

import numpy as np
import pytest

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.diagnose import diagnose
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.trials import Workbench
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.running import reach
from tests.diagnosis.robot_scene import FAN, profile, record, voice
from tests.diagnosis.test_held_down import feedback

SECONDS = 12.0


def loud_frames(x: np.ndarray, length: int, count: int) -> np.ndarray:
    """(count,) frames of that length, all in loud parts of the voice, no two of them neighbours."""
    power = np.mean(x[: x.size // length * length].reshape(-1, length) ** 2, axis=1)
    candidates = np.flatnonzero(power > 0.3 * power.mean())[2::3]
    return np.sort(np.random.default_rng(5).permutation(candidates)[:count])


def lossy(x: np.ndarray, length: int, fill: float, count: int = 14) -> np.ndarray:
    out = x.copy()
    for frame in loud_frames(x, length, count):
        at = frame * length
        out[at : at + length] = fill * out[at - length : at]
    return out


def coded(x: np.ndarray, step_db: float = -12.0) -> np.ndarray:
    """A transform codec: in frames of 20 ms each band is rounded to steps of a part of its own level."""
    window, out = np.sin(np.pi * (np.arange(640) + 0.5) / 640), np.zeros(x.size + 640)
    for at in range(0, x.size - 640, 320):
        spectrum = np.fft.rfft(window * x[at : at + 640])
        bands = np.array_split(spectrum, 16)
        steps = [np.sqrt(12 * np.mean(np.abs(band) ** 2) * 10 ** (step_db / 10)) + 1e-12 for band in bands]
        rounded = [
            step * (np.round(band.real / step) + 1j * np.round(band.imag / step)) for band, step in zip(bands, steps)
        ]
        out[at : at + 640] += window * np.fft.irfft(np.concatenate(rounded))
    return out[: x.size].astype(np.float32)


def dropped(x: np.ndarray) -> np.ndarray:
    """The recording itself has gaps, fan and all."""
    heard = record(x)
    for frame in loud_frames(x, 320, 14):
        heard[frame * 320 + 400 : frame * 320 + 720] = 0.0
    return heard


def jumped(x: np.ndarray) -> np.ndarray:
    """Silence of 40 ms, after which all comes later."""
    at = 80_000
    return record(np.concatenate((x[:at], np.zeros(640, np.float32), x[at:-640])))


@pytest.mark.parametrize(("length", "fill"), [(160, 0.0), (320, 0.6), (640, 0.0)])
def test_every_lost_frame_is_found_with_its_length_and_what_was_played_instead(length: int, fill: float) -> None:
    x = voice(SECONDS)
    prepared = prepare(profile(), record(lossy(x, length, fill)), x)
    values = find("packet_loss").fit(prepared.measurement, prepared.model)
    assert values["length_ms"] == length / 16 and values["fill"] == pytest.approx(fill, abs=0.11)
    # the aligned reference begins at the path's first sample, PRE_ROLL before the direct sound
    shift = profile().delay - 64
    found = np.round(np.asarray(values["times_s"]) * 16000 - shift)
    assert np.abs(found - loud_frames(x, length, 14) * length).max() <= 2


@pytest.mark.slow
def test_lost_packets_are_named_and_nothing_else() -> None:
    x = voice(SECONDS)
    found = diagnose(profile(), record(lossy(x, 320, 0.0)), x)
    assert [finding.effect for finding in found.ranking] == ["packet_loss"] and found.verdict == "missing"
    assert found.ranking[0].excess_after_db < 0.5
    assert "14 frames of 20 ms" in found.ranking[0].evidence
    assert "changes nothing" in reach(find("packet_loss"), found.ranking[0].values)


@pytest.mark.parametrize(
    "change",
    [
        record,
        lambda x: record(coded(x)),
        lambda x: record((2.0 * feedback(x, 8.0, -45.0)).astype(np.float32)),
        dropped,
        jumped,
        lambda x: record(x) * (1 - 0.7 * (np.arange(x.size) // 1600 % 3 == 0)).astype(np.float32),
        lambda x: record(lossy(x, 320, 0.0, count=2)),
    ],
    ids=["nothing", "codec", "compressor", "gaps in the recording", "jump", "a gate", "two frames"],
)
def test_what_is_missing_without_packets_is_not_called_so(change) -> None:
    x = voice(SECONDS)
    prepared = prepare(profile(), change(x), x)
    bench = Workbench(prepared, Criteria())
    trial = bench.attempt("packet_loss", prepared.model)
    assert trial is None or not bench.admissible(trial)


@pytest.mark.slow
def test_the_fan_stays_in_a_lost_frame() -> None:
    """What tells a packet from a gap in the recording: the same frames, with and without the fan."""
    x = voice(SECONDS)
    for heard, expected in ((record(lossy(x, 320, 0.0)), True), (dropped(x), False)):
        prepared = prepare(profile(), heard, x)
        bench = Workbench(prepared, Criteria())
        trial = bench.attempt("packet_loss", prepared.model)
        assert (trial is not None and bench.admissible(trial)) is expected
    assert float(np.std(record(0.0 * x))) == pytest.approx(FAN, rel=0.01)
