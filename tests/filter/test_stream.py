"""EgoFilter as people embed it: what it refuses, what it tells."""

import contextlib

import numpy as np
import pytest

from edgefilter import EgoFilter, engines, enhance
from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.linear import Bypass
from edgefilter.errors import SignalError, UsageError
from edgefilter.filter.stream import Stream, step
from edgefilter.types import Frame, Output
from tests import conformance


@pytest.mark.parametrize(
    ("mic", "ref", "message"),
    [
        (np.zeros(100, np.int16), np.zeros(100, np.float32), "dtype int16.*divide"),
        (np.zeros((2, 100), np.float32), np.zeros(100, np.float32), r"shape \(2, 100\).*1 to 8 channels"),
        (np.full(3, np.nan, np.float32), np.zeros(3, np.float32), "nan at sample 0"),
        (np.zeros(3, np.float32), np.array([0, 0, np.inf], np.float32), "inf at sample 2"),
        (np.full(3, 1e38, np.float32), np.zeros(3, np.float32), "mic holds 1e[+]38 at sample 0.*its scaling is wrong"),
        (np.zeros(3, np.float32), np.array([0, -1e8, 0], np.float32), "ref holds -1e[+]08 at sample 1.*full scale"),
        (np.zeros(3, np.float32), np.zeros(4, np.float32), "3 samples and ref 4"),
    ],
)
def test_unusable_blocks_are_refused_and_change_nothing(mic, ref, message):
    good = np.random.default_rng(0).standard_normal(3000).astype(np.float32)
    ego = EgoFilter(engine="bypass")
    first = ego.process(good[:1000], good[:1000])
    with pytest.raises(SignalError, match=message):
        ego.process(mic, ref)
    out = np.concatenate((first, ego.process(good[1000:], good[1000:]), ego.flush()))
    assert np.array_equal(out, enhance(good, good, engine="bypass"))


def test_after_flush_only_reset_helps():
    ego = EgoFilter(engine="bypass")
    ego.process(*conformance.conversation(1000))
    assert ego.flush().size > 0 and ego.flush().size == 0
    with pytest.raises(SignalError, match="reset"):
        ego.process(*conformance.conversation(1000))
    ego.reset()
    assert ego.process(*conformance.conversation(1000)).size > 0


def test_samples_as_loud_as_any_recording_are_taken():
    loud = np.array([1e6, 0, -1e6], np.float32)
    assert np.isfinite(enhance(loud, loud, engine="linear")).all()


class Closing:
    """A learner that learns nothing and counts how often it was closed."""

    past, closed = 0, 0

    def start(self, path, hop):
        pass

    def observe(self, hop):
        return None

    def stats(self):
        return {}

    def close(self):
        self.closed += 1


def test_as_a_context_manager_it_closes_the_learner_also_after_an_error():
    for error in (None, KeyError):
        learner = Closing()
        with contextlib.suppress(KeyError), EgoFilter(engine="linear", learn=learner) as ego:
            assert ego.process(*conformance.conversation(1000)).size > 0
            if error:
                raise error
        assert learner.closed == 1


def test_float64_input_is_taken_without_writing_into_it():
    mic, ref = (x.astype(np.float64) for x in conformance.conversation(4000))
    mic.flags.writeable = ref.flags.writeable = False
    np.testing.assert_array_equal(
        enhance(mic, ref, engine="linear"), enhance(mic.astype(np.float32), ref.astype(np.float32), engine="linear")
    )


def test_a_found_reference_is_an_event_and_stands_in_the_stats():
    mic, ref = conformance.conversation(48_000)
    ego = EgoFilter(engine="linear")
    ego.process(mic, ref)
    kinds = [event.kind for event in ego.events()]
    # a busy machine may add the latter
    assert kinds.count("realigned") == 1 and set(kinds) <= {"realigned", "overloaded"} and ego.events() == []
    assert ego.stats()["alignment"]["delay_samples"] == pytest.approx(900, abs=16)  # 1 ms, the reach of the aligner


def test_enhance_lowers_a_purely_linear_echo_by_20_db():
    rng = np.random.default_rng(3)
    ref = (0.1 * rng.standard_normal(96_000)).astype(np.float32)
    mic = np.concatenate((np.zeros(900, np.float32), 0.5 * ref[:-900]))
    out = enhance(mic, ref, engine="linear")
    last = slice(-32_000, None)
    # a plain delay; 26 dB and more were seen
    assert 10 * np.log10(np.mean(out[last] ** 2) / np.mean(mic[last] ** 2)) < -20


@pytest.mark.parametrize("engine", ["bypass", "linear"])
def test_adapted_profile_needs_a_profile_and_a_linear_stage(engine):
    with pytest.raises(SignalError, match="give a profile and an engine with a linear stage"):
        EgoFilter(engine=engine).adapted_profile()


class Talkative(Bypass):
    """Says that somebody speaks for 32 s of each 34."""

    name, hop_s = "talkative", 0.256

    def __init__(self):
        super().__init__(StftConfig(window_length=8192, hop=4096, n_fft=8192))
        self._hop = 0

    def step(self, frame, state):
        output, state = super().step(frame, state)
        self._hop += 1
        speaks = self._hop * self.hop_s % 34.0 < 32.0
        return Output(output.spectrum, 0.999 if speaks else 0.001), state


class Judging(Bypass):
    """Says that nobody speaks in the first half of a second, then that somebody does, who pauses after 0.3 s."""

    def __init__(self):
        super().__init__()
        self.heard = 0

    def step(self, frame, state):
        self.heard += 1
        return Output(frame.error, float(31 < self.heard < 50)), state


def test_two_sounds_of_the_same_block_differ_where_nobody_speaks():
    mic = 0.1 * np.random.default_rng(0).standard_normal(16000).astype(np.float32)
    found = {}
    for output in ("recognise", "listen"):
        stream, parts = Stream(Judging(), output=output), []
        for size in (1000, 700, 0, 14300):
            at = stream.samples_in
            out = stream.process(mic[at : at + size], mic[at : at + size])
            parts.append((out, stream.other))
        parts.append((stream.flush(), stream.other))
        assert all(out.shape == other.shape for out, other in parts)
        found[output] = [np.concatenate(sound) for sound in zip(*parts, strict=True)]
    recognise, listen = found["recognise"]
    assert np.array_equal(recognise, enhance(mic, mic, engine="bypass"))
    assert np.array_equal(listen, found["listen"][0]) and np.array_equal(recognise, found["listen"][1])
    assert np.allclose(listen[:7000], 0.17 * recognise[:7000], atol=1e-6)
    assert np.allclose(listen[9000:], recognise[9000:], atol=1e-6)


class Twofold(Bypass):
    """Half the microphone to listen to, all of it for a recogniser; somebody always speaks."""

    def step(self, frame, state):
        return Output(frame.error * np.float32(0.5), 1.0, frame.error), state


def test_an_engine_may_give_another_sound_for_a_recogniser_which_turns_have_too():
    mic = 0.1 * np.random.default_rng(0).standard_normal(32000).astype(np.float32)
    stream = Stream(Twofold())
    recognise, listen = [
        np.concatenate(s) for s in zip(*((stream.process(mic, mic), stream.other), (stream.flush(), stream.other)))
    ]
    whole = enhance(mic, mic, engine="bypass")
    np.testing.assert_allclose(recognise, whole, atol=1e-6)
    np.testing.assert_allclose(listen[4000:], 0.5 * whole[4000:], atol=1e-6)
    *_, turn = (event.turn for event in stream.events if event.turn is not None)
    assert turn.start == 0
    np.testing.assert_allclose(turn.samples[: whole.size], whole, atol=1e-5)


def test_an_engine_that_judges_no_speech_has_one_sound_and_no_third_is_known():
    ego = EgoFilter(engine="linear", output="listen")
    out = ego.process(*conformance.conversation(3000))
    assert out.size and np.array_equal(out, ego.other()) and ego.stats()["output"] == "listen"
    with pytest.raises(UsageError, match="output 'hear', expected one of recognise, listen"):
        EgoFilter(engine="linear", output="hear")


def test_events_that_nobody_asks_for_hold_the_sound_of_the_latest_ten_minutes():
    """A turn may have 30 s: of a thousand events it would have been a gigabyte."""
    stream = Stream(Talkative())
    minute = 0.1 * np.random.default_rng(0).standard_normal(60 * 16_000).astype(np.float32)
    for _ in range(13):
        stream.process(minute, minute)
    ends = [event for event in stream.events if event.kind == "speech_stopped"]
    kept = [event.turn is not None for event in ends]
    assert len(ends) > 20 and kept == sorted(kept) and not kept[0]
    held = sum(event.turn.samples.size for event in ends if event.turn)
    assert 570 * 16_000 < held <= 600 * 16_000


@pytest.mark.parametrize("name", ["linear", "ss", "crnn"])
def test_of_what_may_be_the_robot_at_any_lag_no_more_than_the_noise_is_delivered_and_nothing_is_remembered(name):
    engine = engines.create(name)
    rng, bins = np.random.default_rng(0), engine.stft.bins
    spectra = (rng.standard_normal((4, bins)) + 1j * rng.standard_normal((4, bins))).astype(np.complex64)
    noise, echo = np.full(bins, 0.01, np.float32), np.ones(bins, np.float32)
    frame = Frame(*spectra, noise, echo, at_any_lag=True)
    state = engine.initial_state()
    output, after = step(engine, frame, state)
    assert after is state and not output.speech_probability
    assert np.all(np.abs(output.spectrum) ** 2 <= noise)
    softer = frame._replace(error=1e-3 * frame.error)  # than the noise is said to be: nothing is made louder
    assert np.all(np.abs(step(engine, softer, state)[0].spectrum) <= np.abs(softer.error))
    known, _ = step(engine, frame._replace(at_any_lag=False), state)
    assert (known.speech_probability is None) == (output.speech_probability is None)
    assert not np.allclose(known.spectrum, output.spectrum, atol=1e-3)
