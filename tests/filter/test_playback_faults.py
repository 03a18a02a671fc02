"""At which speed the microphone holds the reference, whatever the lag and the levels are."""

from __future__ import annotations

import numpy as np
import pytest

from edgefilter.filter.playback_faults import AHEAD, BEHIND, CLEAR, LENGTH, other_rates, speeds

SIZE = BEHIND + LENGTH + AHEAD


def voice(seed: int = 0) -> np.ndarray:
    """Ten tones a second, each with harmonics, of which some are louder, for as long as a look at the reference is."""
    rng = np.random.default_rng(seed)
    phase = np.cumsum(np.repeat(rng.uniform(0.04, 0.12, SIZE // 1600 + 1), 1600))[:SIZE]
    return sum(size * np.sin(order * phase) for order, size in enumerate(rng.uniform(0.1, 1.0, 8), 1)).astype(
        np.float32
    )


def heard(said: np.ndarray, speed: float, lag: int = 2000) -> np.ndarray:
    return np.interp(BEHIND - lag + speed * np.arange(LENGTH), np.arange(SIZE), said).astype(np.float32)


def found(mic: np.ndarray, ref: np.ndarray) -> tuple[float, float]:
    *_, (speed, clear) = speeds(mic, ref)
    return speed, clear


@pytest.mark.parametrize("lag", [0, 8000, 40_000])
@pytest.mark.parametrize("speed", [0.9188, 0.973, 1.0, 1.035, 1.0884])
def test_a_speed_is_found_to_a_third_of_a_percent_whatever_the_lag(speed: float, lag: int) -> None:
    told, clear = found(heard(voice(), speed, lag), voice())
    assert told == pytest.approx(speed, rel=0.0033) and clear > CLEAR


def test_neither_level_nor_noise_nor_the_colour_of_a_room_changes_the_speed() -> None:
    mic, rng = heard(voice(), 1.05), np.random.default_rng(1)
    room = rng.standard_normal(400) * np.exp(-np.arange(400) / 60)
    for changed in (
        1e-4 * mic,
        mic + 0.1 * rng.standard_normal(LENGTH),
        np.convolve(mic, room)[:LENGTH],
        np.diff(mic, prepend=0.0),
    ):
        told, clear = found(changed.astype(np.float32), voice())
        assert told == pytest.approx(1.05, rel=0.0033) and clear > CLEAR


def test_another_voice_and_silence_are_no_speed() -> None:
    for other in (heard(voice(7), 1.05), np.zeros(LENGTH, np.float32)):
        assert found(other, voice())[1] < 0.2
    assert found(heard(voice(), 1.05), np.zeros(SIZE, np.float32))[1] == 0.0


def test_two_words_in_a_long_silence_are_not_made_a_clear_speed_by_it() -> None:
    said = voice()
    said[: BEHIND + 4000] = said[BEHIND + 12_000 :] = 0.0
    other = voice(7)[:LENGTH]
    other[8000:] = 0.0
    assert found(other, said)[1] < 0.2


def test_rates_are_named_for_the_speeds_that_they_make_alone() -> None:
    assert "44.1 kHz seems to be played at 48 kHz" in other_rates(48 / 44.1)
    assert "48 kHz seems to be played at 44.1 kHz" in other_rates(44.1 / 48)
    assert not any(map(other_rates, (1.0, 1.07, 1.11, 0.94, 0.9)))
