"""Lost packets are found one by one; what a microphone drops, a codec, a compressor and a jump take away is none."""

from __future__ import annotations

import numpy as np
import pytest

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.recording import diagnose
from edgefilter.diagnosis.trials import Workbench
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.running import reach
from tests.diagnosis.robot_scene import FAN, coded, feedback, lossy, loud_frames, profile, record, voice

SECONDS = 12.0


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
