"""The two that compare the predicted echo with the microphone: a volume that was turned, and an echo that is too loud."""

from __future__ import annotations

import numpy as np
import pytest

from edgefilter import EgoFilter
from edgefilter.filter.volume import EchoLimiter, Volume
from tests.program import demo

HOP = 256


def hops(seconds: float, seed: int) -> np.ndarray:
    """(n, HOP) of noise, mean square 1."""
    return np.random.default_rng(seed).standard_normal((round(seconds * 16000 / HOP), HOP)).astype(np.float32)


def limited(mic: np.ndarray, echo: np.ndarray) -> tuple[np.ndarray, list[bool]]:
    """What a limiter lets through of the echo hop by hop, and in which hops it said that the path has changed."""
    limiter, out, changed = EchoLimiter(HOP), [], []
    for m, e in zip(mic, echo, strict=True):
        limiter.measure(m, e)
        out.append(limiter.apply(e))
        changed.append(limiter.changed)
    return np.array(out), changed


def test_an_echo_that_lowers_the_microphone_is_not_touched() -> None:
    echo, human = hops(1.0, 0), hops(1.0, 1)
    out, changed = limited(0.9 * echo + 0.3 * human, echo)
    assert np.array_equal(out, echo) and not any(changed)


@pytest.mark.parametrize("share", [0.0, 0.25])
def test_of_an_echo_that_is_too_loud_as_much_is_subtracted_as_is_heard(share: float) -> None:
    echo = hops(1.0, 0)
    mic = share * echo + 0.02 * hops(1.0, 1)
    out, _ = limited(mic, echo)
    np.testing.assert_allclose(out[2:], share * echo[2:], atol=0.03)  # the noise correlates by chance
    assert np.mean((mic - out) ** 2) < 1.01 * np.mean(mic**2)


def test_a_loudspeaker_that_is_cut_off_in_mid_hop_costs_one_part_of_it() -> None:
    echo = hops(1.0, 0)
    mic = echo + 0.01 * hops(1.0, 1)
    mic[30, 128:] -= echo[30, 128:]
    mic[31:] -= echo[31:]
    out, _ = limited(mic, echo)
    assert np.array_equal(out[:30], echo[:30]) and np.array_equal(out[30, :128], echo[30, :128])
    assert not out[30, 192:].any() and not out[31:].any()
    steps = np.abs(np.diff(out[30, 127:192] / echo[30, 127:192]))
    assert steps.max() <= 1.01  # at once down


def test_what_is_let_through_again_comes_back_without_a_step() -> None:
    echo = np.ones((40, HOP), np.float32)
    mic = echo.copy()
    mic[10:20] = 0.0
    out, _ = limited(mic, echo)
    gain = out.reshape(-1)
    assert gain[11 * HOP] == 0.0 and np.all(gain[30 * HOP :] == 1.0)
    assert np.diff(gain).max() < 0.02  # 4 ms from nothing to all


def test_an_echo_that_stays_too_loud_for_half_a_second_is_put_down_to_another_path() -> None:
    echo, mic = hops(2.0, 0), 0.1 * hops(2.0, 1)
    _, changed = limited(mic, echo)
    first = changed.index(True)
    assert 0.45 < first * HOP / 16000 < 0.55 and 2 <= sum(changed) <= 4


def factor_after(mic: np.ndarray, echo: np.ndarray, path: str = "known") -> float:
    return turns(mic, echo, path)[0].gain


def turns(mic: np.ndarray, echo: np.ndarray, path: str = "known") -> tuple[Volume, list[int], list[int]]:
    """What has followed them, in which hops it turned, and after which ones it was looking for a factor or trying one."""
    volume, turned, suspected = Volume(HOP, path), [], []
    for at, (m, e) in enumerate(zip(mic, echo, strict=True)):
        if volume.follow(m, np.float32(volume.gain) * e) != 1.0:
            turned.append(at)
        if volume.suspected:
            suspected.append(at)
    return volume, turned, suspected


@pytest.mark.parametrize("factor", [0.3, 2.0, 30.0])
def test_a_turned_volume_is_found_within_half_a_second_and_bounded(factor: float) -> None:
    echo = hops(0.5, 0)
    found = factor_after(factor * echo + 0.05 * hops(0.5, 1), echo)
    assert found == pytest.approx(min(factor, 10.0), rel=0.05)


def test_a_volume_that_was_turned_down_is_heard_again_where_soft_speech_tells_that_it_is_up() -> None:
    """How loud an audible echo is moves with the volume: a soft passage is one, 14 dB below the loudest."""
    echo = np.concatenate((hops(0.5, 0), 0.2 * hops(0.5, 1)))
    half = len(echo) // 2
    volume = np.where(np.arange(len(echo)) < half, 0.1, 1.0).astype(np.float32)[:, None]
    assert factor_after(volume[:half] * echo[:half], echo[:half]) == pytest.approx(0.1, rel=0.05)
    assert factor_after(volume * echo, echo) == pytest.approx(1.0, rel=0.05)


def test_whatever_the_scale_the_same_volume_is_found() -> None:
    echo, noise = hops(0.5, 0), hops(0.5, 1)
    found = [factor_after(scale * (2.0 * echo + 0.1 * noise), scale * echo) for scale in (1e-6, 1.0, 1e4)]
    assert found == pytest.approx([found[1]] * 3, rel=1e-3) and found[1] > 1.9


@pytest.mark.parametrize("scale", [0.0, 0.02])
def test_a_microphone_that_does_not_hear_the_echo_turns_no_volume(scale: float) -> None:
    echo = hops(2.0, 0)
    assert factor_after(scale * echo + hops(2.0, 1), echo) == 1.0


def test_the_volume_of_a_path_that_is_unknown_yet_means_nothing() -> None:
    echo = hops(0.5, 0)
    assert factor_after(2.0 * echo, echo, path="unknown") == 1.0
    learned = np.concatenate((echo, 2.0 * echo))
    assert factor_after(learned, np.concatenate((echo, echo)), path="unknown") == pytest.approx(2.0, rel=0.01)


def test_after_a_click_of_the_robot_the_volume_is_followed_once_its_peak_has_faded() -> None:
    echo = hops(8.0, 0)
    echo[5] *= 10 ** (25 / 20)  # audible is what lies within 20 dB, and 5 dB fade in 5 s
    late = len(echo) * 3 // 4
    mic = np.concatenate((echo[:late], 3.0 * echo[late:]))
    assert factor_after(mic, echo) == pytest.approx(3.0, rel=0.01)


def test_an_echo_of_unknown_scale_is_never_louder_than_the_microphone_and_right_after_six_hops_more() -> None:
    echo = hops(0.5, 0)
    volume, turned, suspected = turns(1e-4 * echo, echo, "unscaled")
    assert turned[0] == 0 and suspected == list(range(6)) and volume.gain == pytest.approx(1e-4, rel=1e-3)


def test_a_path_that_does_not_agree_keeps_the_scale_of_the_microphone_and_is_left_to_the_adaptation() -> None:
    volume, turned, suspected = turns(0.5 * hops(0.5, 1), hops(0.5, 0), "unscaled")
    assert volume.gain == pytest.approx(0.5, rel=0.1)
    assert turned[-1] < 6 and suspected[-1] - turned[-1] <= 11  # twice the hops that prove a factor


def test_a_scale_that_is_right_but_for_noise_is_not_touched() -> None:
    assert factor_after(0.9 * hops(0.5, 0) + 0.5 * hops(0.5, 1), hops(0.5, 0), "unscaled") == 1.0


def test_a_volume_is_bounded_by_the_scale_that_was_found_first() -> None:
    echo = hops(0.5, 0)
    mic = np.concatenate((30.0 * echo, 240.0 * echo))
    assert factor_after(mic, np.concatenate((echo, echo)), "unscaled") == pytest.approx(240.0, rel=0.01)


def test_a_volume_that_wavers_is_turned_at_most_every_half_second() -> None:
    echo = hops(2.0, 0)
    mic = echo * np.where(np.arange(len(echo)) // 12 % 2, 3.0, 1.0).astype(np.float32)[:, None]
    _, turned, _ = turns(mic, echo)
    assert len(turned) >= 2 and np.diff(turned).min() > 31


def test_a_suspicion_that_silence_leaves_open_is_dropped() -> None:
    echo = hops(1.0, 0)
    echo[13:] = 0.0
    volume, turned, suspected = turns(np.concatenate((echo[:10], 2.0 * echo[10:])), echo)
    assert not turned and 25 < len(suspected) < 35 and volume.gain == 1.0


def test_a_suspicion_that_the_next_hops_do_not_share_turns_nothing() -> None:
    echo, other = hops(0.3, 0), hops(0.3, 1)
    mic = 0.1 * np.concatenate((echo[:2], other[2:]))
    volume, turned, suspected = turns(mic, echo)
    assert suspected and not turned and volume.gain == 1.0


def test_a_suspicion_turns_nothing_where_the_next_hops_fit_the_old_volume_nearly() -> None:
    echo = hops(0.3, 0)
    loud = np.where(np.arange(len(echo)) < 2, 3.0, 1.1).astype(np.float32)[:, None]
    volume, turned, suspected = turns(loud * echo, echo)
    assert suspected and not turned and volume.gain == 1.0


@pytest.mark.parametrize("path", ["known", "unscaled"])
def test_an_echo_of_the_other_sign_is_another_path_and_no_volume(path: str) -> None:
    echo = hops(1.0, 0)
    volume, turned, suspected = turns(-echo, echo, path)
    assert volume.gain > 0.5 and not turned and not suspected[12:]


def test_no_volume_is_suspected_where_the_robot_is_too_soft_to_be_heard() -> None:
    """What is suspected keeps the path from being learned meanwhile."""
    echo = hops(2.0, 0)
    echo[40:] *= 10 ** (-26 / 20)
    _, turned, suspected = turns(np.concatenate((echo[:40], 3.0 * echo[40:])), echo)
    assert not turned and not suspected


def test_a_limiter_that_is_told_that_the_volume_was_turned_goes_on_as_if_it_had_always_been_so() -> None:
    echo, mic = hops(0.5, 0), 0.9 * hops(0.5, 0) + 0.5 * hops(0.5, 1)
    told, always = EchoLimiter(HOP), EchoLimiter(HOP)
    for at, (m, e) in enumerate(zip(mic, echo, strict=True)):
        if at == 20:
            told.turn(3.0)
        told.measure(m, np.float32(3.0 if at >= 20 else 1.0) * e)
        always.measure(m, np.float32(3.0) * e)
        if at >= 20:
            assert told.heard == pytest.approx(always.heard, rel=1e-3)


def test_an_echo_that_fits_again_is_let_through_at_once() -> None:
    echo = hops(0.5, 0)
    mic = np.concatenate((0.02 * hops(0.5, 1)[:10], 0.7 * echo[10:]))
    out, _ = limited(mic, echo)
    assert np.array_equal(out[10:, 64:], echo[10:, 64:])


def test_another_path_is_noticed_though_now_and_then_a_hop_fits() -> None:
    echo = hops(2.0, 0)
    mic = np.where(np.arange(len(echo))[:, None] % 4 == 3, echo, 0.1 * hops(2.0, 1))
    _, changed = limited(mic, echo)
    assert any(changed[:70])


def test_a_voice_that_is_lowered_for_a_moment_is_no_turned_volume_where_the_reference_carries_it() -> None:
    """By 12 dB for 0.4 s, again and again, as an agent may do at a suspicion; and, last, a reference that does not tell."""
    ref, rng = demo("reference")[0][: 6 * 16000], np.random.default_rng(0)
    since = np.arange(ref.size) % 24000
    gain = np.where((since < 6400) & (np.arange(ref.size) > 3 * 16000), 10 ** (-12 / 20), 1.0)
    lowered = ref * np.convolve(np.pad(gain, (80, 79), mode="edge"), np.full(160, 1 / 160), "valid")
    room = 0.1 * rng.standard_normal(1600) * np.exp(-np.arange(1600) / 250)
    room[0] = 0.3
    full = (np.arange(ref.size) > 3 * 16000) & (since > 8000)
    volume_db, removed_db = [], []
    for played, told in ((ref, ref), (lowered, lowered), (lowered, ref)):
        mic = np.convolve(np.pad(played, (800, 0)), room)[: ref.size] + 3e-5 * rng.standard_normal(ref.size)
        ego = EgoFilter(engine="linear")
        out = np.concatenate((ego.process(mic, told), ego.flush()))
        volume_db.append(ego.stats()["linear_stage"]["gain_db"])
        removed_db.append(10 * np.log10(np.mean(mic[full] ** 2) / np.mean(out[full] ** 2)))
    assert volume_db[1] == pytest.approx(volume_db[0], abs=0.1)
    assert removed_db[1] > removed_db[0] - 4.0 and removed_db[1] > 30.0 > 15.0 > removed_db[2]
