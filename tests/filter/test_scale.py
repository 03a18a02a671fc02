"""The levels of reference and microphone mean nothing: both may be multiplied by any factor."""

from __future__ import annotations

import numpy as np
import pytest

from edgefilter.dsp.metrics import si_sdr
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.filter.volume import Volume
from edgefilter.profile.data import Profile
from tests.conformance import robot_speech
from tests.program import DEMO, demo

SAME_DB = 0.5
"""What is asked for at -40 to +40 dB; 0.2 dB were seen."""


@pytest.mark.slow
@pytest.mark.parametrize("known", [False, True], ids=["cold", "profile"])
@pytest.mark.parametrize("engine", ["ss", "crnn"])
def test_neither_the_level_of_the_reference_nor_that_of_the_microphone_changes_the_answer_or_when_a_human_is_noticed(
    engine, known
):
    mic, ref, human = demo("mic", "reference", "human")
    profile = Profile.load(DEMO / "profile.npz") if known else None
    spoken = np.abs(human) > 0
    late = np.flatnonzero(spoken)[0]

    def answered(heard: float, played: float) -> tuple[tuple[float, float], list[int]]:
        """SI-SDR and level, dB, and when a human was noticed, samples."""
        ego = EgoFilter(profile, engine=engine)
        out = np.concatenate((ego.process(np.float32(heard) * mic, np.float32(played) * ref), ego.flush()))[late:]
        level = 10 * np.log10(np.sum(out.astype(float) ** 2) / np.sum((heard * mic[late:].astype(float)) ** 2))
        times = [event.sample for event in ego.events() if event.kind.startswith("speech")]
        return (si_sdr(out, human[late:]), level), times

    usual, noticed = answered(1.0, 1.0)
    assert bool(noticed) is (engine == "crnn")
    for heard, played in ((0.01, 1.0), (0.01, 100.0), (100.0, 0.01), (1.0, 100.0)):
        found, times = answered(heard, played)
        assert found == pytest.approx(usual, abs=SAME_DB), (heard, played)
        assert times == pytest.approx(noticed, abs=1600), (heard, played)  # a tenth of a second


@pytest.mark.parametrize("factor", [1e-4, 0.3, 30.0, 1e4])
def test_the_scale_of_a_calibrated_path_is_found_with_the_first_words(factor):
    """Of another microphone gain or another volume than at the calibration, by any factor."""
    echo = robot_speech(1.0)
    volume = Volume(256, "unscaled")
    turned = 1.0
    for hop in echo[: echo.size // 256 * 256].reshape(-1, 256):
        turned *= volume.follow(np.float32(factor) * hop, np.float32(turned) * hop)
    assert turned == pytest.approx(factor, rel=0.01)
    assert not volume.suspected


def test_a_path_that_explains_nothing_is_adapted_after_a_moment_all_the_same():
    volume, echo, other = Volume(256, "unscaled"), robot_speech(2.0), robot_speech(2.0, seed=9)
    for hop, heard in zip(echo[:16_128].reshape(-1, 256), other[:16_128].reshape(-1, 256), strict=True):
        volume.follow(heard, hop)
    assert not volume.suspected
