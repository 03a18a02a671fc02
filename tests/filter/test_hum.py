"""Hum of the mains is taken off where it is most of what is heard, and nothing else ever is."""

import numpy as np
import pytest

from edgefilter import enhance
from edgefilter.dsp.metrics import si_sdr
from edgefilter.filter.hum import Hum
from edgefilter.types import SAMPLE_RATE
from tests.program import demo

SECONDS = np.arange(16 * SAMPLE_RATE) / SAMPLE_RATE


def through(x, hop=256):
    """What is left of x (..., n), and whether it had hum."""
    hum = Hum(hop)
    hops = [hum.step(x[..., at : at + hop]) for at in range(0, x.shape[-1] - hop + 1, hop)]
    return np.concatenate(hops, axis=-1), hum.known


def tones(*hz):
    return sum(0.05 * np.sin(2 * np.pi * each * SECONDS + k) for k, each in enumerate(hz)).astype(np.float32)


@pytest.mark.parametrize("hop", [128, 256, 320])
@pytest.mark.parametrize("hz", [(50.0, 150.0), (59.95, 119.9)], ids=str)
def test_hum_goes_within_two_seconds_and_the_voice_above_it_stays(hop, hz):
    """The mains are off by 0.05 Hz at times, and their harmonics by as many times that."""
    voice = 0.05 * np.random.default_rng(0).standard_normal(SECONDS.size).astype(np.float32)
    voice[: 2 * SAMPLE_RATE] *= 1e-3
    left, known = through(voice + tones(*hz), hop)
    later = slice(3 * SAMPLE_RATE, left.size)
    assert known
    rest = (left - voice[: left.size])[later]
    assert np.mean(rest**2) < 0.02 * np.mean(tones(*hz)[later] ** 2)
    two = np.stack((voice + tones(*hz), voice))
    np.testing.assert_allclose(through(two, hop)[0][0], left, atol=1e-5)


@pytest.mark.parametrize(("share", "known"), [(0.6, True), (0.4, False)])
def test_hum_is_taken_off_where_it_is_more_than_half_of_what_is_heard(share, known):
    hum, noise = tones(50.0, 150.0), np.random.default_rng(0).standard_normal(SECONDS.size)
    noise *= np.sqrt((1.0 - share) / share) * np.std(hum) / np.std(noise)
    assert through((hum + noise).astype(np.float32))[1] == known


def test_a_harmonic_that_is_softer_than_the_mains_is_taken_off_as_well():
    left, found = through(tones(50.0) + 0.2 * tones(150.0))
    later = slice(left.size // 2, left.size)
    assert found and np.mean(left[later] ** 2) < 0.1 * np.mean((0.2 * tones(150.0)[later]) ** 2)


@pytest.mark.parametrize("name", ["mic", "reference", "human", "noise", "tone", "offset"])
def test_what_is_no_hum_stays_bit_for_bit(name):
    known = {
        "noise": np.random.default_rng(0).standard_normal(SECONDS.size).astype(np.float32),
        "tone": tones(47.0, 155.0, 440.0),
        "offset": np.full(SECONDS.size, 0.03, np.float32),
    }
    x = known[name] if name in known else demo(name)[0]
    left, found = through(x)
    assert not found
    np.testing.assert_array_equal(left, x[: left.size])


def test_a_human_who_interrupts_a_robot_is_nearly_as_clear_beside_hum_as_without():
    """21 dB of SI-SDR were lost: the hum itself, and what it leaked into other bins hid the robot from the canceller."""
    mic, ref, human = demo("mic", "reference", "human")
    part = np.flatnonzero(human)[[0, -1]]
    found = [
        si_sdr(enhance(x, ref, None, engine="linear")[slice(*part)], human[slice(*part)])
        for x in (mic, mic + tones(49.95, 149.85)[: mic.size])
    ]
    assert found[1] > found[0] - 4.0, found
