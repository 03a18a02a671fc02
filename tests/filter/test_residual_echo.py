"""What is expected of noise and residual echo in the linear stage's error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from edgefilter.dsp.stft import StftConfig
from edgefilter.filter.residual_echo import NoiseTracker, Residual, Unpredictable
from tests.diagnosis.robot_scene import profile

STFT = StftConfig()
NOTHING = np.zeros(STFT.bins, np.float32)
WIDTH = 64
"""Bins in 2 kHz."""


def spectrum(power: np.ndarray | float) -> np.ndarray:
    return np.sqrt(np.broadcast_to(power, STFT.bins)).astype(np.complex64)


def spread(power: np.ndarray) -> np.ndarray:
    """The echo's power with a tenth of its mean over 2 kHz about each bin; beyond the ends it is what it is there."""
    wide = np.pad(power, (WIDTH // 2, WIDTH // 2 - 1), mode="edge")
    return power + 0.1 * np.lib.stride_tricks.sliding_window_view(wide, WIDTH).mean(axis=1)


@pytest.mark.parametrize("power", [np.linspace(1.0, 5.0, STFT.bins) ** 2, np.linspace(5.0, 1.0, STFT.bins) ** 2])
def test_a_part_of_the_echo_is_left_there_and_on_the_frequencies_around(power) -> None:
    _, left = Residual(STFT).step(spectrum(power), spectrum(power), NOTHING)
    np.testing.assert_allclose(left, 0.005 * spread(power), rtol=1e-4)  # float32


def test_what_is_left_fades_by_2_db_a_hop_once_the_echo_is_over() -> None:
    residual = Residual(STFT)
    first, second, third = (residual.step(spectrum(p), spectrum(1.0), NOTHING)[1] for p in (1.0, 0.0, 0.1))
    np.testing.assert_allclose(second, 0.6 * first, rtol=1e-5)
    np.testing.assert_allclose(third, 0.36 * first, rtol=1e-5)


@pytest.mark.parametrize(("known", "weight"), [(None, 2.0), (profile(), 0.5)], ids=["unknown", "calibrated"])
def test_the_misalignment_counts_twice_where_the_path_is_unknown_and_half_where_it_is_calibrated(known, weight) -> None:
    uncertainty, added = np.linspace(0.0, 1.0, STFT.bins, dtype=np.float32), np.full(STFT.bins, 0.25, np.float32)
    _, left = Residual(STFT, known).step(spectrum(0.0), spectrum(1.0), uncertainty)
    np.testing.assert_allclose(left, weight * uncertainty, rtol=1e-6)
    _, more = Residual(STFT, known).step(spectrum(0.0), spectrum(1.0), uncertainty, added)
    np.testing.assert_allclose(more, weight * uncertainty + added, rtol=1e-6)


def leakage(residual: Residual, share: float, frames: int, noise: float = 1e-6, unknown: float = 0.0) -> list[float]:
    """The part of the echo that is expected to stay, frame by frame, where this share of its power does."""
    told = []
    for _ in range(frames):
        error, uncertainty = spectrum(share * 1.1 + noise + unknown), np.full(STFT.bins, unknown / 2.0, np.float32)
        fan = np.full(STFT.bins, noise, np.float32)
        _, left = residual.step(spectrum(1.0), error, uncertainty, fan=fan)
        told.append(float((left - unknown).mean()) / 1.1)
    return told


@pytest.mark.parametrize(("noise", "unknown"), [(1e-6, 0.0), (1e-6, 0.1), (0.015, 0.0)])
def test_what_stays_of_the_echo_is_three_times_what_is_seen_to_stay_in_half_a_second_and_rises_slowly(
    noise, unknown
) -> None:
    residual = Residual(STFT)
    told = leakage(residual, 0.01, 500, noise, unknown)
    assert told[100] == pytest.approx(0.005 * 1.005**101, rel=1e-3)
    assert told[-1] == pytest.approx(0.03, rel=1e-3)
    assert leakage(residual, 0.0, 10, noise, unknown)[-1] == pytest.approx(0.03 * 0.97**10, rel=1e-3)


def test_what_stays_of_the_echo_falls_at_once_and_by_no_more_than_26_db() -> None:
    told = leakage(Residual(STFT), 0.0, 20)
    assert told[:3] == pytest.approx([0.0045, 0.00405, 0.003645], rel=1e-3)
    assert told[-1] == pytest.approx(0.0024, rel=1e-3)


def test_a_noise_that_was_taken_for_louder_than_all_that_is_left_is_no_echo() -> None:
    residual, fan = Residual(STFT), np.full(STFT.bins, 0.015, np.float32)
    first, *_, last = (residual.step(spectrum(1.0), spectrum(0.003), NOTHING, fan=fan)[1].mean() for _ in range(50))
    assert last < 0.6 * first


def test_of_what_is_louder_than_a_tenth_no_more_than_a_tenth_is_put_down_to_the_echo() -> None:
    assert leakage(Residual(STFT), 0.5, 700)[-1] == pytest.approx(0.1, rel=1e-3)


@pytest.mark.parametrize(("noise", "followed"), [(1.1 / 59.0, False), (1.1 / 61.0, True)])
def test_it_is_followed_where_the_echo_is_18_db_over_the_noise(noise, followed) -> None:
    told = leakage(Residual(STFT), 0.05, 10, noise=noise)
    assert (told[-1] > told[0] * 1.01) is followed


@dataclass
class Known:
    """Of a profile: what is calibrated of the loudspeaker's distortion and of the fan."""

    share: float
    fan: np.ndarray
    while_moving: None = None

    @property
    def approximation(self) -> Known:
        return self

    def noise_bins(self, stft: StftConfig) -> np.ndarray:
        return self.fan


@pytest.mark.parametrize(("share", "taken"), [(0.02, 0.02), (0.001, 0.0024), (0.5, 0.1)])
def test_it_begins_with_the_calibrated_distortion(share, taken) -> None:
    _, left = Residual(STFT, Known(share, NOTHING)).step(spectrum(1.0), spectrum(1.0), NOTHING)
    np.testing.assert_allclose(left, taken * 1.1, rtol=1e-5)


def test_a_calibrated_fan_keeps_its_shape_at_the_level_of_the_median_bin() -> None:
    shape = np.linspace(1.0, 3.0, STFT.bins).astype(np.float32)
    heard = 2.0 * shape
    heard[:126] *= 100.0
    heard[-100:] /= 100.0  # so that 31 of 257 are as the fan, those in the middle
    noise, _ = Residual(STFT, Known(0.01, shape)).step(spectrum(0.0), spectrum(heard), NOTHING)
    np.testing.assert_allclose(noise, 2.0 * shape, rtol=1e-5)
    noise, _ = Residual(STFT, Known(0.01, NOTHING)).step(spectrum(0.0), spectrum(heard), NOTHING)
    np.testing.assert_allclose(noise, heard, rtol=1e-5)  # of a fan that is nothing in some bins no shape is known


def powers(frames: int, level: float = 1.0, seed: int = 0) -> np.ndarray:
    """Of a stationary noise, (frames, bins)."""
    return (level * np.random.default_rng(seed).exponential(1.0, (frames, STFT.bins))).astype(np.float32)


def test_the_noise_is_at_first_the_mean_of_five_frames() -> None:
    tracker, seen = NoiseTracker(STFT.bins), powers(5)
    for count, power in enumerate(seen, 1):
        np.testing.assert_allclose(tracker.step(power), seen[:count].mean(axis=0), rtol=1e-5)


def rising() -> np.ndarray:
    """A noise, the same beside a voice with pauses, and a noise that is 30 dB louder."""
    voice = 1000.0 * (np.arange(100) % 20 < 15)
    return np.concatenate((powers(100), powers(100, seed=1) + voice[:, None], powers(300, 1000.0, seed=2)))


def test_the_noise_is_told_beside_a_voice_and_follows_one_that_grows() -> None:
    tracker = NoiseTracker(STFT.bins)
    told = [10.0 * np.log10(tracker.step(power).mean()) for power in rising()]
    # with frames that do not overlap the method is 1.2 dB too low
    assert told[99] == pytest.approx(0.0, abs=1.5) and max(told[100:200]) < 1.5
    assert told[210] < 3.0 and told[-1] == pytest.approx(30.0, abs=1.5)  # what lasts for a second is no voice


def test_the_noise_is_that_of_the_published_method() -> None:
    """Gerkmann & Hendriks (2012), eq. (18), (22) and (23), as they are printed."""
    tracker, ratio = NoiseTracker(STFT.bins), 10.0**1.5
    seen = rising().astype(np.float64)
    noise, mean = seen[:5].mean(axis=0), np.zeros(STFT.bins)
    for number, power in enumerate(seen):
        told = tracker.step(power.astype(np.float32))
        if number >= 5:
            present = 1.0 / (1.0 + (1.0 + ratio) * np.exp(-power / noise * ratio / (1.0 + ratio)))
            mean = 0.9 * mean + 0.1 * present
            present = np.where(mean > 0.99, np.minimum(present, 0.99), present)
            noise = 0.8 * noise + 0.2 * ((1.0 - present) * power + present * noise)
        if number >= 4:
            np.testing.assert_allclose(told, noise, rtol=1e-2)  # float32, 500 frames


def test_no_bins_noise_is_further_below_the_loudest_than_numbers_reach() -> None:
    tracker = NoiseTracker(STFT.bins)
    tracker.step(np.full(STFT.bins, 1.0, np.float32))
    for _ in range(200):
        power = tracker.step(NOTHING)
    assert 0.0 < power.max() < 1e-5


def test_after_a_mute_as_much_noise_is_left_to_find_again_whatever_the_level() -> None:
    left = []
    for level in (1e-6, 1.0, 1e6):
        tracker = NoiseTracker(STFT.bins)
        for power in powers(100, level):
            tracker.step(power)
        for _ in range(400):
            tracker.step(NOTHING)
        left.append(tracker.power.mean() / level)
    assert left == pytest.approx([left[1]] * 3, rel=1e-2, abs=0.0) and left[1] > 0.0


def test_what_no_waveform_predicts_is_expected_as_the_windowed_frame_holds_it() -> None:
    colours = np.ones((2, 601)) / 8000.0
    colours[1] *= np.linspace(0.0, 2.0, 601)
    step, hop = Unpredictable(STFT, colours), STFT.hop
    rng = np.random.default_rng(0)
    squares = rng.uniform(0.0, 1.0, (2, 4 * hop)).astype(np.float32)
    for at in range(0, 4 * hop, hop):
        found = step.step(squares[:, at : at + hop])
    window = np.square(STFT.analysis_window)
    energy = squares[:, -window.size :] @ window
    tilt = np.linspace(0.0, 2.0, STFT.bins)
    np.testing.assert_allclose(found, energy[0] + energy[1] * tilt, rtol=1e-3)  # a grid of 601


def test_what_sounds_with_the_voice_in_other_bins_is_expected_while_nobody_speaks() -> None:
    """A motor 20 dB below the echo, in bins of its own: nothing is learned of it until it is known that nobody speaks."""
    echo, motor, fan = np.zeros((3, STFT.bins), np.float32)
    echo[20:60], motor[150:154], fan[:] = 1.0, 0.1, 1e-6
    residual = Residual(STFT)

    def expected(frames: int) -> float:
        for _ in range(frames):
            _, left = residual.step(spectrum(echo), spectrum(motor + fan), NOTHING, fan=fan)
        return float(left[151])

    unknown = expected(200)
    residual.nobody_speaks = True
    half_a_second, later = expected(31), expected(500)
    assert unknown < half_a_second < 0.02 and later == pytest.approx(0.2, rel=0.02)  # twice as much
    residual.nobody_speaks = False
    motor[151] = 10.0
    assert expected(200) == pytest.approx(later, rel=0.02)


def test_what_sounds_with_the_voice_rises_by_a_twentieth_a_hop_is_forgotten_by_a_fiftieth_and_lasts_half_a_db_longer() -> (
    None
):
    """So that a human who has not been noticed yet hardly raises it, and pauses between words do not end it."""
    echo, motor, fan = np.zeros((3, STFT.bins), np.float32)
    echo[20:60], motor[150:154], fan[:] = 1.0, 0.1, 1e-6
    residual = Residual(STFT)
    residual.nobody_speaks = True

    def expected(frames: int) -> float:
        for _ in range(frames):
            _, left = residual.step(spectrum(echo), spectrum(motor + fan), NOTHING, fan=fan)
        return float(left[151])

    settled = expected(500)
    motor[151] = 10.0
    assert expected(12) == pytest.approx(1.05**12 * settled, rel=0.02)
    motor[151] = 0.0
    assert expected(34) == pytest.approx(0.98**34 * 1.05**12 * settled, rel=0.03)
    residual.nobody_speaks = False
    before = expected(1)
    echo[:] = 0.0
    assert expected(10) == pytest.approx(0.9**10 * before, rel=0.03)


def test_noise_that_begins_with_the_voice_is_at_first_as_much_as_stays_of_the_echo_spread_over_all_bins() -> None:
    echo, motor, fan = np.zeros((3, STFT.bins), np.float32)
    echo[20:60], motor[150:154], fan[:] = 1.0, 1e3, 1e-6
    residual = Residual(STFT)
    residual.nobody_speaks = True
    residual.step(spectrum(echo), spectrum(motor + fan), NOTHING, fan=fan)
    assert residual.with_voice[151] == pytest.approx(1.05 * 0.005 / STFT.bins, rel=1e-3)


def test_noise_is_not_taken_for_motors_while_the_robot_s_echo_is_as_soft() -> None:
    residual, noise = Residual(STFT), powers(300)
    residual.nobody_speaks = True
    for power in noise:
        residual.step(spectrum(1.0), spectrum(power), NOTHING, fan=NOTHING + 1.0)
    assert not residual.with_voice.any()


def test_of_a_steady_noise_nothing_is_taken_for_motors_though_it_goes_up_and_down() -> None:
    residual, fan, echo = Residual(STFT), NOTHING + 1.0, NOTHING.copy()
    echo[20:60] = 1000.0
    residual.nobody_speaks = True
    for power in powers(2000):
        residual.step(spectrum(echo), spectrum(power), NOTHING, fan=fan)
    without_echo = slice(120, None)
    assert abs(residual.with_voice[without_echo].mean()) * echo.sum() < 0.1  # of a noise of 1
    residual.with_voice[:] = -1.0
    _, left = residual.step(spectrum(echo), spectrum(fan), NOTHING, fan=fan)
    assert left.min() >= 0.0  # chance makes it negative in some bins: no power is
