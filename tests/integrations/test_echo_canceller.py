"""EchoCanceller in the place of the echo cancellers that programs call now."""

import asyncio
import gc
import re
from pathlib import Path

import numpy as np
import pytest
import pywebrtc_audio
import soxr

from edgefilter import EchoCanceller, SignalError, UsageError
from edgefilter.dsp.metrics import si_sdr
from edgefilter.types import Event
from tests.program import DEMO, demo

PAGE = (Path(__file__).parents[2] / "docs/echo_canceller.md").read_text()
RATES = (8000, 11025, 16000, 22050, 24000, 32000, 44100, 48000)
NOISE = (0.1 * np.random.default_rng(0).standard_normal((4800, 2))).astype(np.float32)


def tone(rate, seconds=0.3):
    return (0.1 * np.sin(2 * np.pi * 440 * np.arange(round(rate * seconds)) / rate)).astype(np.float32)


def kept(kind):
    """All objects of that kind that somebody still holds."""
    gc.collect()
    return [each for each in gc.get_objects() if type(each) is kind]


def in_blocks(canceller, mic, ref, sizes):
    """The answers to all of mic, in blocks of these sizes again and again."""
    out, at = [], 0
    while at < len(mic):
        size = sizes[len(out) % len(sizes)]
        out.append(canceller.process(mic[at : at + size], ref[at : at + size]))
        at += size
    return np.concatenate(out)


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("sizes", [(None,), (1, 977, 33)], ids=["10 ms", "any"])
def test_as_many_samples_as_came_in_late_by_what_is_said(rate, sizes):
    canceller = EchoCanceller(rate, engine="bypass")
    mic = tone(rate)
    out = in_blocks(canceller, mic, np.zeros_like(mic), [size or rate // 100 for size in sizes])
    late, edge = canceller.delay, rate // 50  # the tone begins with a step
    assert out.size == mic.size and not out[: late - edge].any()
    np.testing.assert_allclose(out[late + edge :], mic[edge : mic.size - late], atol=1e-4)  # 0.1: 60 dB


def test_what_waits_in_the_player_is_told_to_the_filter_of_each_microphone():
    canceller = EchoCanceller(16000, 2, engine="bypass")
    assert canceller.queued_s == 0.0
    canceller.queued_s = 0.25
    assert [each.queued_s for each in canceller._filters] == [0.25, 0.25] and canceller.queued_s == 0.25


@pytest.mark.parametrize("rate", RATES)
def test_at_another_rate_the_answer_is_8_ms_later_at_most_and_the_page_says_by_how_much(rate):
    late_ms = EchoCanceller(rate, engine="linear").delay_ms
    assert late_ms <= EchoCanceller(16000, engine="linear").delay_ms + 8
    said = dict(re.findall(r"^\| (\d+) Hz \| ([\d.]+) ms \|", PAGE, re.M))
    assert float(said[str(rate)]) == pytest.approx(late_ms, abs=0.06)


def test_nothing_over_8_khz_survives_and_the_log_says_so(caplog):
    canceller = EchoCanceller(48000, engine="bypass")
    assert caplog.text.count("at 48000 Hz nothing above 8000 Hz survives") == 1
    high = np.sin(2 * np.pi * 9000 * np.arange(24000) / 48000).astype(np.float32)
    out = canceller.process(high, 0 * high)
    assert 20 * np.log10(np.abs(out[6000:-6000]).max()) < -60


@pytest.mark.parametrize(
    "given",
    [
        NOISE[:, 0],
        NOISE[:, 0].astype(np.float64),
        (NOISE[:, 0] * 32768).astype(np.int16),
        NOISE[:, :1],
        NOISE,
        NOISE.reshape(-1),
        (NOISE * 32768).astype("<i2").tobytes(),
        bytearray((NOISE * 32768).astype("<i2").tobytes()),
    ],
    ids=["float32", "float64", "int16", "(n, 1)", "(n, 2)", "interleaved", "bytes", "bytearray"],
)
def test_the_answer_has_the_type_and_shape_of_what_came_in(given):
    mono = isinstance(given, np.ndarray) and given.size == len(NOISE)
    canceller = EchoCanceller(16000, 1 if mono else 2, engine="bypass")
    out = canceller.process(given, given)
    assert type(out) is type(given) and len(out) == len(given)
    if isinstance(given, np.ndarray):
        assert out.dtype == given.dtype and out.shape == given.shape
        values = np.asarray(out, np.float64) / (32768 if given.dtype.kind == "i" else 1)
    else:
        values = np.frombuffer(out, "<i2") / 32768
    late = canceller.delay
    channels = values.reshape(len(NOISE), -1)
    np.testing.assert_allclose(channels[late:], NOISE[:-late, : channels.shape[1]], atol=2 / 32768)  # 16 bits, twice


@pytest.mark.parametrize("channels", [1, 2, 8])
def test_each_microphone_is_filtered_by_itself_and_a_stereo_reference_is_its_mean(channels):
    rng = np.random.default_rng(1)
    ref = (0.1 * rng.standard_normal((16000, 2))).astype(np.float32)
    echo = np.stack([np.roll(ref.mean(axis=1), 300 + 40 * number) for number in range(channels)], axis=1)
    out = EchoCanceller(16000, channels, engine="linear").process(echo, ref)
    assert out.shape == echo.shape
    left = 10 * np.log10(np.mean(out[12000:] ** 2, axis=0) / np.mean(echo[12000:] ** 2, axis=0))
    assert (left < -15).all()  # of each; 25 dB and more were seen after 0.75 s


def test_the_sound_to_listen_to_is_the_lower_one_where_nobody_speaks():
    noise = np.tile(NOISE[:, 0], 4)
    loud, soft = (
        EchoCanceller(engine="crnn", output=output).process(noise, 0 * noise) for output in ("recognise", "listen")
    )
    assert np.mean(soft**2) < 0.2 * np.mean(loud**2)


def test_events_of_microphones_that_nobody_can_ask_for_do_not_pile_up():
    """Each finished turn holds the human's sound."""
    canceller, ref = EchoCanceller(16000, 3, engine="linear"), 0.1 * np.random.default_rng(1).standard_normal(16000)
    before = {id(each) for each in kept(Event)}
    canceller.process(np.tile(np.roll(ref, 300)[:, None], 3), ref)
    left = [each for each in kept(Event) if id(each) not in before]
    assert [event.kind for event in left] == ["realigned"] and canceller.events() == left


@pytest.mark.parametrize(
    ("mic", "ref", "words"),
    [
        (np.zeros(160, np.int32), np.zeros(160, np.int16), "mic has dtype int32, expected int16 or float"),
        (b"abc", b"abcd", "mic has 3 bytes, expected whole 16-bit samples"),
        (np.zeros((160, 3), np.int16), np.zeros(160, np.int16), r"mic has shape \(160, 3\), expected \(n, 1\)"),
        (np.zeros(160, np.int16), np.zeros(100, np.int16), "ref has 100 samples, expected the 160"),
        (np.zeros(160, np.int16), np.zeros(0, np.int16), "ref has 0 samples, expected the 160"),
        (np.full(160, np.nan), np.zeros(160), "expected finite samples"),
    ],
)
def test_what_does_not_fit_is_one_line_and_leaves_no_trace(mic, ref, words):
    canceller = EchoCanceller(16000, engine="bypass")
    with pytest.raises(SignalError, match=words):
        canceller.process(mic, ref)
    sound = tone(16000)
    out = in_blocks(canceller, sound, sound, (160,))
    np.testing.assert_array_equal(out, in_blocks(EchoCanceller(16000, engine="bypass"), sound, sound, (160,)))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ({"sample_rate": 96000}, "sample_rate is 96000, expected 8000 to 48000 Hz"),
        ({"sample_rate": 4000}, "sample_rate is 4000"),
        ({"channels": 9}, "channels is 9, expected 1 to 8"),
        ({"channels": 0}, "channels is 0"),
        ({"engine": "no"}, "no"),
    ],
)
def test_a_canceller_that_cannot_be_is_one_line(words, said):
    with pytest.raises(UsageError, match=said):
        EchoCanceller(**words)


@pytest.fixture(scope="module")
def conversation():
    """Microphone, reference and the human alone: the robot talks, from 9.5 s on the human with it."""
    return demo("mic", "reference", "human")


def hear(canceller, rate, mic, ref):
    """A program that calls an echo canceller: 10 ms of 16-bit samples at a time."""
    near, far = ((soxr.resample(x, 16000, rate) * 32767).astype(np.int16) for x in (mic, ref))
    size = rate // 100
    return np.concatenate([
        canceller.process(near[at : at + size], far[at : at + size]) for at in range(0, near.size // size * size, size)
    ])  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("rate", [16000, 48000])
def test_a_program_changes_one_import_and_hears_the_human(conversation, rate):
    mic, ref, human = conversation
    both = slice(9 * 16000, 15 * 16000)
    kept = hear(pywebrtc_audio.EchoCanceller(rate, 1), rate, mic, ref)
    canceller = EchoCanceller(rate)
    out = hear(canceller, rate, mic, ref)
    assert out.dtype == kept.dtype and out.size == kept.size
    out = soxr.resample(out[canceller.delay :].astype(np.float32) / 32767, rate, 16000)
    end = min(both.stop, out.size)
    found = si_sdr(out[both.start : end], human[both.start : end])
    assert si_sdr(mic[both], human[both]) < -20 and found > 2  # 6.2 dB were seen
    kinds = [event.kind for event in canceller.events()]
    assert "speech_started" in kinds and "realigned" in kinds


@pytest.mark.parametrize("rate", [16000, 48000])
def test_one_that_is_made_as_speexdsp_s_is_does_the_same(conversation, rate):
    short = [x[:16000] for x in conversation[:2]]
    made, usual = (
        hear(one, rate, *short) for one in (EchoCanceller.create(rate // 100, 2048, rate), EchoCanceller(rate))
    )
    assert usual.any() and np.array_equal(made, usual)


async def test_the_event_loop_goes_on_while_it_filters_and_calls_are_served_in_their_order():
    mic = tone(16000)
    async with EchoCanceller(16000, engine="bypass") as canceller:
        blocks = [mic[at : at + 160] for at in range(0, mic.size, 160)]
        tasks = [asyncio.create_task(canceller.process_async(block, block)) for block in blocks]
        found = np.concatenate(await asyncio.gather(*tasks))
    np.testing.assert_array_equal(found, in_blocks(EchoCanceller(16000, engine="bypass"), mic, mic, (160,)))


@pytest.mark.slow
def test_it_says_whether_the_human_speaks_and_forgets_all_at_a_reset(conversation):
    mic, ref, _ = (x[7 * 16000 : 11 * 16000] for x in conversation)
    canceller = EchoCanceller(16000, profile=DEMO / "profile.npz")
    first = canceller.process(mic, ref)
    assert canceller.speaking
    canceller.reset()
    assert not canceller.speaking
    np.testing.assert_array_equal(canceller.process(mic, ref), first)


@pytest.mark.parametrize("form", ["int16", "interleaved", "bytes"])
def test_named_channels_are_one_array_and_the_answer_is_one_channel(form):
    rng = np.random.default_rng(1)
    ref = (0.1 * rng.standard_normal(16000)).astype(np.float32)
    echo = np.stack([np.roll(ref, 300 + 40 * number) for number in range(4)], axis=1)
    echo += 1e-3 * rng.standard_normal(echo.shape)
    pcm = np.rint(echo * 32768).astype("<i2")
    given = {"int16": pcm, "interleaved": pcm.reshape(-1), "bytes": pcm.tobytes()}[form]
    with EchoCanceller(16000, 4, engine="linear", mic_channels=[1, 2, 3]) as canceller:
        out = canceller.process(given, np.rint(ref * 32768).astype("<i2"))
    assert type(out) is type(given)
    out = np.frombuffer(out, "<i2") if form == "bytes" else out
    assert out.shape == (16000,) and out.dtype == np.int16
    assert 10 * np.log10(np.mean((out[12000:] / 32768.0) ** 2) / np.mean(echo[12000:, 1] ** 2)) < -15


def test_of_one_named_channel_the_others_are_not_heard():
    canceller = EchoCanceller(16000, 2, engine="bypass", mic_channels=[1])
    out = canceller.process(NOISE, NOISE)
    np.testing.assert_allclose(out[canceller.delay :], NOISE[: -canceller.delay, 1], atol=1e-6)
    with pytest.raises(UsageError, match="2 channels, 0 to 1, found channel 2"):
        EchoCanceller(16000, 2, engine="bypass", mic_channels=[0, 2])
