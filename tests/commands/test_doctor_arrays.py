"""What the doctor says of the channels of an array."""

from __future__ import annotations

import numpy as np
import pytest

from edgefilter.audio.measure import channels
from edgefilter.calibration.chirps import chirps
from edgefilter.commands.doctor import array_checks, array_set_up


@pytest.fixture
def sound() -> np.ndarray:
    """(n, 3) of one noise that arrives a sample later in each, and each one's own."""
    rng = np.random.default_rng(0)
    one = rng.standard_normal(48003)
    return np.stack([0.01 * (one[3 - at : 48003 - at] + 0.3 * rng.standard_normal(48000)) for at in range(3)], axis=1)


def test_an_array_is_listed_with_levels_floor_and_coherence(sound: np.ndarray) -> None:
    sound[:4000] *= 10.0
    found = channels(sound, [1, 2, 4])
    assert [one.number for one in found] == [1, 2, 4] and found[0].coherence == pytest.approx(1.0)
    assert found[1].floor_db == pytest.approx(-39.6, abs=0.5) and found[1].level_db > found[1].floor_db + 5
    assert 0.8 < found[1].coherence < 0.98
    checks = list(array_checks(found))
    assert [check.state for check in checks] == ["ok"] * 3 and checks[2].name == "channel 4"
    assert "coherence 0.9" in checks[1].found and "with channel 1" in checks[1].found


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda x: 0.0 * x[:, 1], "it is silent"),
        (lambda x: 10.0 * x[:, 1], "another kind"),
        (lambda x: x[:, 0], "a copy of channel 1"),
        (lambda x: 0.01 * np.random.default_rng(9).standard_normal(len(x)), "nothing in common with channel 1"),
    ],
)
def test_a_channel_that_is_no_microphone_of_the_array_is_to_be_left_out(sound: np.ndarray, change, why: str) -> None:
    sound[:, 1] = change(sound)
    states = list(array_checks(channels(sound, [1, 2, 4])))
    assert [check.state for check in states] == ["ok", "warning", "ok"]
    assert states[1].do.startswith("leave it out of --mic-channels") and why in states[1].do


@pytest.mark.parametrize("silent", [0, 1])
def test_a_silent_channel_is_divided_by_nowhere_and_no_other_one_is_blamed(sound: np.ndarray, silent: int) -> None:
    sound[:, silent] = 0.0
    with np.errstate(all="raise"):
        found = channels(sound, [1, 2, 4])
    states = list(array_checks(found))
    assert [check.state for check in states] == ["warning" if at == silent else "ok" for at in range(3)]
    assert "it is silent" in states[silent].do and found[silent].coherence == 0.0


def test_an_array_that_is_all_silent_is_listed_as_such(sound: np.ndarray) -> None:
    with np.errstate(all="raise"):
        states = list(array_checks(channels(0.0 * sound, [1, 2, 4])))
    assert all("it is silent" in check.do for check in states)


def test_one_microphone_has_no_list() -> None:
    assert list(array_checks(())) == []


def test_a_clipped_microphone_is_named(sound: np.ndarray) -> None:
    sound[:, 1] = np.clip(200.0 * sound[:, 1], -1.0, 1.0)
    assert "channel 2" in [check.name for check in array_checks(channels(sound, [1, 2, 4])) if "clipped" in check.do]


def test_chirps_show_which_microphone_is_played_processed_exchanged_or_of_another_gain() -> None:
    from tests.filter.array_scene import PATHS, calibration, fan

    ref = np.pad(chirps(), (4000, 12000)).astype(np.float32)
    mics = np.stack([np.convolve(ref, path)[: ref.size] for path in PATHS[:3]]) + 1e-4 * fan(ref.size, 3, 3).T
    mics = mics.astype(np.float32)
    assert [(check.name, check.state) for check in array_set_up([1, 2, 4], mics, ref, calibration(3))] == [
        ("profile", "ok")
    ]
    assert list(array_set_up([1, 2, 4], mics, ref, None)) == []

    def told(changed: np.ndarray) -> dict[str, str]:
        return {check.name: check.found for check in array_set_up([1, 2, 4], changed, ref, calibration(3))}

    assert "exchanged" in told(mics[[1, 0, 2]])["channel 1"]
    assert "another gain, +6.0 dB" in told(mics * np.array([1, 1, 2], np.float32)[:, None])["channel 4"]
    assert told(np.stack((mics[0], mics[1], ref)))["channel 4"] == "it is what is played"
    assert "ms beside the others" in told(np.stack((mics[0], mics[1], np.roll(mics[2], 800))))["channel 4"]
