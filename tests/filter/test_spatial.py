"""The spatial filter against a slow one that solves each bin by itself, and against what it must not do to a human."""

from __future__ import annotations

import numpy as np
import pytest

from edgefilter.dsp.stft import StftConfig
from edgefilter.filter.spatial import (
    CARRIED,
    HUMAN_MEMORY_S,
    LIKELY,
    LOADING,
    NOISE_MEMORY_S,
    NOISE_WEIGHT,
    PRIOR,
    UNLIKELY,
    SpatialFilter,
    diffuse_coherence,
    solve,
)

STFT = StftConfig()
SPEECH, UNSURE, NOISE = 0.9, (LIKELY + UNLIKELY) / 2, 0.5 * UNLIKELY
HOP_S = STFT.hop / 16000
PLACES = 0.04 * np.array([[1.0, 0.0, 0.0], [-0.5, 0.866, 0.0], [-0.5, -0.866, 0.0]])


def complex_noise(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)


def plane_wave(direction: np.ndarray) -> np.ndarray:
    """(3, bins) transfer functions of microphones at PLACES, relative to the first."""
    delays = -(PLACES @ direction) / 343.0
    return np.exp(-2j * np.pi * STFT.frequencies * (delays - delays[0])[:, None]).astype(np.complex64)


def point_source(place: np.ndarray) -> np.ndarray:
    distance = np.linalg.norm(PLACES - place, axis=1)[:, None]
    return (np.exp(-2j * np.pi * STFT.frequencies * distance / 343.0) / distance).astype(np.complex64)


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    drawn = rng.standard_normal((count, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def fan_below() -> np.ndarray:
    """(3, 3, bins) of a source 10 cm below the microphones and a tenth of diffuse noise."""
    near = point_source(np.array([0.02, 0.01, -0.1]))
    near = near / np.abs(near[:1])
    diffuse = diffuse_coherence(STFT, 3)
    return (0.9 * near[:, None] * near.conj() + 0.1 * diffuse).astype(np.complex64)


@pytest.mark.parametrize("n", [1, 2, 3, 8])
def test_all_bins_are_solved_as_each_would_be(n: int) -> None:
    rng = np.random.default_rng(n)
    root, right = complex_noise(rng, n, n, 40).astype(np.complex128), complex_noise(rng, n, 40).astype(np.complex128)
    matrix = np.einsum("ikf,jkf->ijf", root, root.conj()) + 0.1 * np.eye(n)[:, :, None]
    expected = np.stack([np.linalg.solve(matrix[:, :, f], right[:, f]) for f in range(40)], axis=1)
    np.testing.assert_allclose(solve(matrix, right), expected, rtol=1e-8)


def slow(frames: list, noise: np.ndarray) -> np.ndarray:
    """Weights after these (error, gain, probability, speaking, idle), each bin by itself, by the inverse matrix."""
    fan, robot, human = noise.astype(complex), noise.astype(complex), np.zeros(noise.shape, complex)
    before, hops, through = False, 0.0, np.zeros(noise.shape[2])
    for error, gain, probability, speaking, idle in frames:
        outer = np.einsum("if,jf->ijf", error, error.conj())
        against = fan if idle else robot
        heard = speaking or probability > LIKELY
        if heard:
            kept = (1.0 if before else CARRIED) * (1.0 - HOP_S / HUMAN_MEMORY_S)
            human = kept * human + (gain**2 * outer if probability > LIKELY else 0.0)
            hops = kept * hops + (probability > LIKELY)
            through = kept * through + (gain**2 if probability > LIKELY else 0.0)
        elif probability < UNLIKELY:
            against += HOP_S / NOISE_MEMORY_S * (outer - against)
        before = heard
    weights = np.zeros(noise.shape[1:], complex)
    prior = PRIOR * diffuse_coherence(STFT, len(noise))
    for f in range(noise.shape[2]):
        level = np.trace(against[:, :, f]).real / len(noise)
        share = min(through[f], (human[0, 0, f] / against[0, 0, f]).real)
        heard = human[:, :, f] / level + prior[:, :, f]
        wanted = (heard - share * against[:, :, f] / level) / (hops + PRIOR)
        loaded = against[:, :, f] / level + LOADING * np.eye(len(noise))
        found = np.linalg.inv(wanted + NOISE_WEIGHT * loaded) @ wanted[:, 0]
        weights[:, f] = found * np.sqrt(heard[0, 0].real / (found.conj() @ heard @ found).real)
    return weights


def test_streaming_weights_are_those_of_the_slow_filter() -> None:
    rng = np.random.default_rng(1)
    human, noise = plane_wave(np.array([0.6, 0.64, 0.48])), fan_below()
    root = np.linalg.cholesky(noise.transpose(2, 0, 1) + 1e-6 * np.eye(3)).transpose(1, 2, 0)
    spatial, frames = SpatialFilter(STFT, 3, noise), []
    for hop in range(150):
        speaks = hop >= 60
        fan = 0.7 * np.einsum("ijf,jf->if", root, complex_noise(rng, 3, STFT.bins))
        error = fan + (4.0 * human * complex_noise(rng, STFT.bins) if speaks else 0.0)
        gain = rng.uniform(0.2, 1.0, STFT.bins).astype(np.float32)
        frames.append((error.astype(np.complex64), gain, SPEECH if speaks else NOISE, speaks, hop % 50 < 10))
        spatial.learn(*frames[-1])
    expected = slow(frames, noise)
    assert np.abs(spatial.weights - expected).max() < 1e-3 * np.abs(expected).max()


def test_a_human_keeps_level_and_phase_and_the_fan_is_lowered() -> None:
    rng = np.random.default_rng(2)
    human, noise = plane_wave(np.array([0.8, 0.0, 0.6])), fan_below()
    spatial = SpatialFilter(STFT, 3, noise)
    for _ in range(100):
        spatial.learn(3.0 * human * complex_noise(rng, STFT.bins), np.ones(STFT.bins, np.float32), SPEECH, True, True)
    heard = spatial.step(human[None])[0][8:]
    assert np.abs(20 * np.log10(np.abs(heard))).max() < 0.5 and np.abs(np.angle(heard)).max() < 0.2
    before, after = noise[0, 0].real[8:], spatial.fan_psd()[8:]
    assert 10 * np.log10(before.sum() / after.sum()) > 6.0


def test_a_human_of_whom_nothing_is_known_loses_at_most_1_db() -> None:
    rng = np.random.default_rng(3)
    spatial = SpatialFilter(STFT, 3, fan_below())
    for _ in range(20):
        spatial.learn(complex_noise(rng, 3, STFT.bins) * 0, np.zeros(STFT.bins, np.float32), UNSURE, False, True)
    powers = [np.abs(spatial.step(plane_wave(one)[None])[0][3:250]) ** 2 for one in directions(rng, 300)]
    assert 10 * np.log10(np.mean(powers)) > -1.0
    lost = -10 * np.log10(np.mean(powers, axis=1))
    assert np.median(lost) < 1.0


def test_the_noise_is_held_while_a_human_speaks() -> None:
    rng = np.random.default_rng(4)
    one = SpatialFilter(STFT, 3, fan_below())
    loud = 10 * complex_noise(rng, 3, STFT.bins)
    nothing = np.zeros(STFT.bins, np.float32)
    for _ in range(20):
        one.learn(loud, nothing, UNSURE, False, False)
    before = one.weights
    for _ in range(50):
        one.learn(loud, nothing, NOISE, True, False)
    still = one.weights
    for _ in range(50):
        one.learn(loud, nothing, NOISE, False, False)
    assert np.abs(one.weights - still).max() > 10 * np.abs(still - before).max()


def test_another_direction_is_followed_within_a_turn() -> None:
    rng = np.random.default_rng(5)
    noise = fan_below()
    spatial, ones = SpatialFilter(STFT, 3, noise), np.ones(STFT.bins, np.float32)
    for place in ([1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]):
        human = plane_wave(np.array(place))
        spatial.learn(np.zeros((3, STFT.bins), np.complex64), ones, NOISE, False, True)  # a turn ends
        for _ in range(32):  # half a second
            spatial.learn(3.0 * human * complex_noise(rng, STFT.bins), ones, SPEECH, True, True)
        assert np.abs(20 * np.log10(np.abs(spatial.step(human[None])[0][8:]))).mean() < 1.0


def test_a_microphone_that_is_left_out_is_not_heard() -> None:
    rng = np.random.default_rng(6)
    spatial = SpatialFilter(STFT, 3, fan_below())
    spatial.use(np.array([False, True, True]))
    for _ in range(10):
        spatial.learn(complex_noise(rng, 3, STFT.bins), np.ones(STFT.bins, np.float32), SPEECH, True, True)
    assert np.abs(spatial.weights[0]).max() < 1e-2 * np.abs(spatial.weights[1:]).max()


def test_where_the_first_microphone_is_left_out_the_human_sounds_as_in_the_second() -> None:
    rng = np.random.default_rng(6)
    spatial = SpatialFilter(STFT, 3, fan_below())
    spatial.use(np.array([False, True, True]))
    human = np.array([[1.0], [2.0], [2.0]], np.float32) * plane_wave(np.array([0.8, 0.0, 0.6]))
    for _ in range(100):
        spatial.learn(3.0 * human * complex_noise(rng, STFT.bins), np.ones(STFT.bins, np.float32), SPEECH, True, True)
    heard = (spatial.step(human[None])[0] / human[1])[8:]
    assert np.abs(20 * np.log10(np.abs(heard))).max() < 0.5 and np.abs(np.angle(heard)).max() < 0.2


@pytest.mark.parametrize("alone", [True, False])
def test_the_fan_is_known_without_a_calibration_once_it_was_heard_alone_for_long_enough(alone: bool) -> None:
    rng = np.random.default_rng(7)
    spatial = SpatialFilter(STFT, 3)
    for _ in range(100):
        spatial.learn(complex_noise(rng, 3, STFT.bins), np.zeros(STFT.bins, np.float32), NOISE, False, alone)
    assert (spatial.fan_psd() is not None) == alone


def test_a_turn_as_a_whole_weighs_all_of_it_the_same() -> None:
    rng = np.random.default_rng(7)
    spatial = SpatialFilter(STFT, 3, fan_below())
    human, ones = plane_wave(np.array([0.0, 0.8, 0.6])), np.ones(STFT.bins, np.float32)
    for _ in range(60):
        spatial.learn(3.0 * human * complex_noise(rng, STFT.bins), ones, SPEECH, True, True)
    found = spatial.finished()
    heard = np.einsum("cf,cf->f", found.conj(), human)[8:]
    assert np.abs(20 * np.log10(np.abs(heard))).max() < 0.5


def test_a_human_who_walks_within_a_turn_is_changed_as_much_at_its_beginning_as_at_its_end() -> None:
    ones, places = np.ones(STFT.bins, np.float32), [plane_wave(np.array([x, 0.0, 0.6])) for x in (0.8, -0.8)]
    changed = []
    for walk in (places, places[::-1]):
        rng, spatial = np.random.default_rng(8), SpatialFilter(STFT, 3, fan_below())
        for place in walk:
            for _ in range(200):  # as long as the streaming filter remembers
                spatial.learn(place * complex_noise(rng, STFT.bins), ones, SPEECH, True, True)
        heard = np.einsum("cf,pcf->pf", spatial.finished().conj(), np.stack(places))
        changed.append(np.mean(np.abs(heard - 1.0) ** 2, axis=1))
    np.testing.assert_allclose(changed[0], changed[1], rtol=0.2)


def test_a_human_in_a_room_is_changed_less_than_the_fan_is_lowered() -> None:
    """By the filter's own weight, beside the first microphone as it is; half of the human comes from everywhere."""
    noise, diffuse = fan_below(), diffuse_coherence(STFT, 3)
    root, field = (
        np.linalg.cholesky(one.transpose(2, 0, 1) + 1e-6 * np.eye(3)).transpose(1, 2, 0) for one in (noise, diffuse)
    )
    for seed in range(3):
        rng = np.random.default_rng(seed)
        spatial, direct = SpatialFilter(STFT, 3, noise), plane_wave(directions(rng, 1)[0])
        changed, left, before = 0.0, 0.0, 0.0
        for _ in range(120):
            level = 2.0 * rng.gamma(0.5, 1.0, STFT.bins)
            fan = 0.7 * np.einsum("ijf,jf->if", root, complex_noise(rng, 3, STFT.bins))
            late = np.einsum("ijf,jf->if", field, complex_noise(rng, 3, STFT.bins))
            human = 0.7 * level * (direct * complex_noise(rng, STFT.bins) + late)
            mask = (level**2 / (level**2 + 0.5)).astype(np.float32)
            changed += np.sum(np.abs(spatial.step(human[None])[0] - human[0]) ** 2)
            left += np.sum(np.abs(spatial.step(fan[None])[0]) ** 2)
            before += np.sum(np.abs(fan[0]) ** 2)
            spatial.learn((human + fan).astype(np.complex64), mask, SPEECH, True, True)
        assert changed + NOISE_WEIGHT * left < NOISE_WEIGHT * before
        assert left < 0.5 * before


def test_a_human_who_is_suddenly_elsewhere_loses_little_and_is_found_within_half_a_second() -> None:
    noise = fan_below()
    root = np.linalg.cholesky(noise.transpose(2, 0, 1) + 1e-6 * np.eye(3)).transpose(1, 2, 0)
    lost = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        spatial = SpatialFilter(STFT, 3, noise)
        for place, hops in zip(directions(rng, 2), (188, 31)):
            human = plane_wave(place)
            for hop in range(hops):
                level = 2.0 * rng.gamma(0.5, 1.0, STFT.bins)
                fan = 0.7 * np.einsum("ijf,jf->if", root, complex_noise(rng, 3, STFT.bins))
                error = (human * level * complex_noise(rng, STFT.bins) + fan).astype(np.complex64)
                spatial.learn(error, (level / (level + 1.0)).astype(np.float32), SPEECH, True, True)
                if hops == 31 and hop in (0, 30):
                    lost.append(-10 * np.log10(np.mean(np.abs(spatial.step(human[None])[0][6:250]) ** 2)))
    at_once, later = np.mean(np.reshape(lost, (4, 2)), axis=0)
    assert at_once < 2.0 and later < 1.0


@pytest.mark.filterwarnings("error")  # not a hop may hold what is no number
@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3])
@pytest.mark.parametrize("human_first", [False, True])
def test_the_level_of_an_array_that_is_not_calibrated_means_nothing(scale: float, human_first: bool) -> None:
    def learned(scale: float) -> np.ndarray:
        rng, spatial = np.random.default_rng(8), SpatialFilter(STFT, 3)
        human, gain = plane_wave(np.array([0.6, 0.64, 0.48])), np.ones(STFT.bins, np.float32)
        for hop in range(60):
            speaks = (hop < 30) == human_first
            error = 0.05 * complex_noise(rng, 3, STFT.bins) + speaks * human * complex_noise(rng, STFT.bins)
            spatial.learn(np.complex64(scale) * error, gain, SPEECH if speaks else NOISE, speaks, True)
        return spatial.weights

    usual = learned(1.0)
    assert np.isfinite(usual).all()
    np.testing.assert_allclose(learned(scale), usual, atol=1e-2 * np.abs(usual).max())


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("microphones", [2, 3, 8])
def test_a_human_without_any_noise_beside_them_stays(microphones: int) -> None:
    rng, spatial = np.random.default_rng(10), SpatialFilter(STFT, microphones)
    human, gain = complex_noise(rng, microphones, STFT.bins), np.ones(STFT.bins, np.float32)
    for _ in range(400):
        spatial.learn(human, gain, SPEECH, True, True)
    np.testing.assert_allclose(spatial.step(human[None])[0], human[0], atol=0.05)


def test_the_weights_of_a_finished_turn_know_nothing_of_the_turn_before() -> None:
    gain, noise = np.ones(STFT.bins, np.float32), fan_below()
    talkers = [plane_wave(np.array(direction)) for direction in ((1.0, 0.0, 0.0), (-0.5, 0.6, 0.62))]

    def finished(turns: list) -> np.ndarray:
        rng, spatial = np.random.default_rng(9), SpatialFilter(STFT, 3, noise)
        for talker in turns:
            for _ in range(60):
                spatial.learn((talker * rng.standard_normal(STFT.bins)).astype(np.complex64), gain, SPEECH, True, True)
            spatial.learn(np.zeros((3, STFT.bins), np.complex64), gain, UNSURE, False, True)
        return spatial.finished()

    alone, after = finished(talkers[1:]), finished(talkers)
    assert np.abs(after - alone).max() < 0.15 * np.abs(alone).max()


@pytest.mark.parametrize(
    ("probability", "changed"), [(UNLIKELY - 0.01, True), (UNLIKELY, False), (LIKELY, False), (LIKELY + 0.01, True)]
)
def test_a_hop_tells_of_the_noise_or_of_the_human_where_it_is_likely_and_of_neither_between(probability, changed):
    rng = np.random.default_rng(0)
    spatial, ones = SpatialFilter(STFT, 3, fan_below()), np.ones(STFT.bins, np.float32)
    before = spatial.weights.copy()
    spatial.learn(complex_noise(rng, 3, STFT.bins), ones, probability, False, True)
    assert np.array_equal(spatial.weights, before) is not changed


def test_a_fan_that_was_not_calibrated_is_known_after_1_2_s_and_followed_over_as_long():
    spatial, ones = SpatialFilter(STFT, 3), np.ones(STFT.bins, np.float32)
    rng = np.random.default_rng(0)
    errors = [np.exp(2j * np.pi * rng.random((3, STFT.bins))).astype(np.complex64) for _ in range(75)]
    for error in errors:
        assert spatial.fan_psd() is None
        spatial.learn(error, ones, 0.0, False, True)
    first = spatial.fan_psd()
    for error in 4 * errors:
        spatial.learn(error, ones, 0.0, False, True)
    assert np.median(first) / np.median(spatial.fan_psd()) == pytest.approx(1 - np.exp(-1.0), rel=0.03)
