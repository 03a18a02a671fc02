"""The resampler of live sound: what passes, what is stopped, how late it is, and that pieces do not matter."""

import numpy as np
import pytest

from edgefilter.dsp.resample import Resampler

RATES = (8000, 11025, 16000, 22050, 24000, 32000, 44100, 47999, 48000)
PAIRS = [(rate, 16000) for rate in RATES if rate != 16000] + [(16000, rate) for rate in RATES if rate != 16000]


def through(source, target, x, sizes):
    """All of x in pieces of these sizes, again and again."""
    resampler, out, at = Resampler(source, target), [], 0
    while at < x.size:
        size = sizes[len(out) % len(sizes)]
        out.append(resampler.push(x[at : at + size]))
        at += size
    return np.concatenate((*out, resampler.push(x[:0], last=True)))


def tone(hz, rate, seconds=0.5):
    return np.sin(2 * np.pi * hz * np.arange(round(seconds * rate)) / rate).astype(np.float32)


def db(x):
    middle = x[x.size // 4 : -x.size // 4]
    return 10 * np.log10(2 * np.mean(np.square(middle, dtype=np.float64)) + 1e-30)


@pytest.mark.parametrize(("source", "target"), PAIRS)
def test_a_tone_below_the_last_650_hz_keeps_its_place_and_level(source, target):
    nyquist = min(source, target) / 2
    for hz in (100, nyquist / 2, nyquist - 650):
        out = through(source, target, tone(hz, source), (source // 100,))
        expected = tone(hz, target)
        assert db(out[: expected.size] - expected) < -66  # 70 dB of the window; lines between kernels err by less


@pytest.mark.parametrize(("source", "target"), [pair for pair in PAIRS if pair[0] > pair[1]])
def test_nothing_above_half_of_the_lower_rate_comes_through(source, target):
    for hz in np.linspace(target / 2 + 20, source / 2 - 1, 5):
        assert db(through(source, target, tone(hz, source), (977,))) < -66


@pytest.mark.parametrize(("source", "target"), PAIRS)
def test_pieces_of_any_length_give_the_same_samples_as_long_as_the_input_and_none_earlier_than_said(source, target):
    x = np.random.default_rng(0).standard_normal(source // 4).astype(np.float32)
    whole = through(source, target, x, (x.size,))
    assert whole.size == -(-x.size * target // source)
    np.testing.assert_array_equal(through(source, target, x, (1, 0, source // 100, 977)), whole)
    resampler, given, out = Resampler(source, target), 0, 0
    for size in (1, 50, source // 100) * 8:
        out += resampler.push(x[given : given + size]).size
        given += size
        held_s = given / source - out / target
        assert held_s <= resampler.delay_s + 1 / source + 1 / target, "late by more than it says"
    assert resampler.delay_s < 0.0036


def test_at_equal_rates_the_samples_come_back_at_once():
    x = tone(440, 16000)
    assert Resampler(16000, 16000).push(x) is x and Resampler(16000, 16000).delay_s == 0


def test_a_rate_that_nobody_has_needs_no_more_memory_than_others():
    """A header or a message may say any rate: prime numbers have as many phases as Hz."""
    resampler = Resampler(767_999, 16_000)
    out = np.concatenate([resampler.push(tone(1000, 767_999, 0.01)) for _ in range(4)])
    assert 0.035 * 16_000 < out.size < 0.04 * 16_000


def test_a_low_rate_loses_no_larger_part_of_its_band():
    out = through(1000, 16_000, tone(400, 1000, 2.0), (10,))
    assert db(out - tone(400, 16_000, 2.0)[: out.size]) < -60


def test_several_channels_are_as_each_alone():
    two = np.random.default_rng(3).standard_normal((4800, 2)).astype(np.float32)
    together, alone = Resampler(48000, 16000, channels=2), Resampler(48000, 16000)
    found = np.concatenate([together.push(two[:1000]), together.push(two[1000:], last=True)])
    assert np.array_equal(
        found[:, 1], np.concatenate([alone.push(two[:1000, 1]), alone.push(two[1000:, 1], last=True)])
    )
