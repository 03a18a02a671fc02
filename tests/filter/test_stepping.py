"""Stepping between engines: no click, no sample lost, down under sustained load only, up again with patience."""

import gc
import os
import subprocess
import sys
import time

import numpy as np
import pytest

from edgefilter import EgoFilter
from edgefilter.commands.run import garbage_of_this_run_only
from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.combined import DOWN, UP, Fallback, fallbacks
from edgefilter.engines.linear import Bypass, Linear
from edgefilter.engines.paper_ss import PAPER_STFT
from edgefilter.engines.spectral_subtraction import SpectralSubtraction
from edgefilter.errors import UsageError
from edgefilter.filter.stepping import MOST_PATIENCE_S, PATIENCE_S, Stepping
from edgefilter.filter.stream import Stream
from edgefilter.filter.timing import Histogram
from edgefilter.types import SAMPLE_RATE, Frame, Output
from tests import conformance

HOP = 256
HOPS_A_SECOND = SAMPLE_RATE / HOP


class Late(Bypass):
    """The microphone as well, but answered two frames later."""

    name = "late"

    def __init__(self):
        super().__init__()
        self.lookahead = 2

    def initial_state(self):
        return (np.zeros(self.stft.bins, np.complex64),) * 2

    def step(self, frame, state):
        return Output(state[0]), (state[1], frame.mic)


class Quiet(Bypass):
    """A tenth of the microphone."""

    name = "quiet"

    def step(self, frame, state):
        return Output(frame.mic * np.float32(0.1)), state


class FakeClock:
    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now

    def wait(self, seconds):
        self.now += seconds


class Slow(Bypass):
    """The microphone after cost_s more of the given clock."""

    name = "slow"

    def __init__(self, wait, cost_s):
        super().__init__()
        self.wait, self.cost_s = wait, cost_s

    def step(self, frame, state):
        self.wait(self.cost_s)
        return super().step(frame, state)


def run(stream, mic, ref, wanted):
    """Hop by hop; before hop h the fallback is asked for engine wanted[h], where there is such an entry."""
    out = []
    for hop, at in enumerate(range(0, mic.size, HOP)):
        stream.engine.wanted = wanted.get(hop, stream.engine.wanted)
        out.append(stream.process(mic[at : at + HOP], ref[at : at + HOP]))
    return np.concatenate((*out, stream.flush()))


@pytest.mark.parametrize("ranked", [(Late, Linear), (SpectralSubtraction, Linear)], ids=str)
@pytest.mark.parametrize("check", conformance.CHECKS, ids=lambda c: c.__name__.removeprefix("check_"))
def test_fallback_conforms(check, ranked):
    kinds = [index() for index in ranked]
    for kind in kinds:
        kind.front = "full"
    check(lambda: Stream(Fallback(kinds)))


def test_a_fallback_at_rest_is_its_engine_bit_for_bit():
    mic, ref = conformance.conversation()
    for index, engine in enumerate((SpectralSubtraction(), Linear())):
        fallback = Fallback((SpectralSubtraction(), Linear()))
        fallback.wanted = index
        assert np.array_equal(conformance.run(Stream(fallback), mic, ref), conformance.run(Stream(engine), mic, ref))


@pytest.mark.parametrize("ranked", [(Bypass, Late), (Late, Bypass)])
def test_stepping_between_different_look_aheads_keeps_every_sample_in_its_place(ranked):
    mic, ref = conformance.conversation(40_001)
    out = run(Stream(Fallback([index() for index in ranked])), mic, ref, {20: 1, 60: 0, 61: 1, 110: 0, 112: 1, 113: 0})
    assert out.size == mic.size
    np.testing.assert_allclose(out, mic, atol=1e-6)  # float32 rounding of the blend


class LateAndQuiet(Late):
    """A tenth of the microphone, two frames later."""

    def step(self, frame, state):
        output, state = super().step(frame, state)
        return Output(output.spectrum * np.float32(0.1)), state


def test_a_fallback_gets_to_a_rung_that_looks_ahead():
    mic = np.full(20_000, 0.5, np.float32)
    out = run(Stream(Fallback((Bypass(), LateAndQuiet()))), mic, np.zeros_like(mic), {20: 1})
    np.testing.assert_allclose(out[(22 + DOWN + 3) * HOP : -HOP], 0.05, atol=1e-6)


def test_alignment_and_linear_stage_run_on_through_a_step():
    """Outside of the crossfades the output is that of the engine in use, as if it had been alone from the start."""
    mic, ref = conformance.conversation(60_000)
    alone = [conformance.run(Stream(engine), mic, ref) for engine in (SpectralSubtraction(), Linear())]
    stream = Stream(Fallback((SpectralSubtraction(), Linear())))
    out = run(stream, mic, ref, {100: 1, 160: 0})
    assert out.size == mic.size
    assert np.array_equal(out[: 98 * HOP], alone[0][: 98 * HOP])  # the output of hop h ends one window before hop h + 1
    settled = slice((100 + DOWN) * HOP, 158 * HOP)
    np.testing.assert_array_equal(out[settled], alone[1][settled])
    assert not np.array_equal(out[settled], alone[0][settled])
    again = slice((160 + UP) * HOP, None)
    np.testing.assert_allclose(out[again], alone[0][again], atol=1e-4)  # the mask's memory of 5 frames began anew
    assert stream.front.linear_stage.canceller.stats()["hops"] >= mic.size // HOP


def test_a_step_does_not_click():
    """A 200 Hz tone that falls by 20 dB: what appears above 1 kHz is a click."""
    mic = (0.5 * np.sin(2 * np.pi * 200 / SAMPLE_RATE * np.arange(32_000))).astype(np.float32)
    nothing = np.zeros_like(mic)
    out = run(Stream(Fallback((Bypass(), Quiet()))), mic, nothing, {40: 1, 80: 0})
    cut = np.where((np.arange(mic.size) // HOP < 40) | (np.arange(mic.size) // HOP >= 80), mic, np.float32(0.1) * mic)

    def click_db(x):
        frames = np.lib.stride_tricks.sliding_window_view(x, 1024)[::128] * np.blackman(1024)
        power = np.abs(np.fft.rfft(frames)) ** 2
        return 10 * np.log10(power[:, 1024 * 1000 // SAMPLE_RATE :].sum(axis=1).max() / power.sum(axis=1).max())

    assert np.abs(out[60 * HOP : 70 * HOP]).max() < 0.06 < np.abs(out[-20 * HOP :]).max()  # both engines were heard
    assert click_db(cut) > -45  # cut over hard at a random phase, -33 dB
    assert click_db(out) < click_db(cut) - 35
    steepest = np.abs(np.diff(mic)).max()
    assert np.abs(np.diff(out)).max() < 1.01 * steepest  # nowhere steeper than the tone itself


class Twofold(Bypass):
    """The microphone to listen to, twice of it for a recogniser."""

    def step(self, frame, state):
        return Output(frame.mic, None, 2 * frame.mic), state


def test_both_sounds_fade_to_an_engine_that_has_one():
    engine = Fallback((Twofold(), Quiet()))
    frame = Frame(*np.random.default_rng(0).standard_normal((6, engine.stft.bins)).astype(np.complex64))
    state, engine.wanted, found = engine.initial_state(), 1, []
    for _ in range(DOWN):
        output, state = engine.step(frame, state)
        found.append([np.vdot(frame.mic, sound).real / np.vdot(frame.mic, frame.mic).real for sound in output.sounds])
    steps = np.arange(1, DOWN + 1)[:, None] / DOWN
    np.testing.assert_allclose(found, (1 - steps) * (2.0, 1.0) + steps * (0.1, 0.1), rtol=1e-5)


def test_a_request_during_a_crossfade_turns_it_back():
    """Up and, half way, down again: the better engine is never heard alone, and the weight never jumps."""
    mic = np.full(20_000, 0.5, np.float32)
    out = run(Stream(Fallback((Bypass(), Quiet()))), mic, np.zeros_like(mic), {0: 1, 30: 0, 30 + UP // 2: 1})
    level = out[20 * HOP :: HOP] / 0.5
    assert level.min() == pytest.approx(0.1, abs=1e-6) and level.max() == pytest.approx(0.1 + 0.9 / 2, abs=0.9 / UP)
    assert np.diff(level).max() <= 0.9 / UP + 1e-6 and np.diff(level).min() >= -0.9 / DOWN - 1e-6
    peak = int(np.argmax(level))
    assert level[peak + DOWN] == pytest.approx(0.1, abs=1e-6)


def test_engines_that_cannot_take_turns_are_refused():
    with pytest.raises(UsageError, match="bypass and linear cannot take turns"):
        Fallback((Bypass(), Quiet(), Linear()))
    with pytest.raises(UsageError, match="STFT"):
        Fallback((Linear(), Linear(StftConfig(n_fft=512, hop=128))))
    with pytest.raises(UsageError, match="no engine"):
        Fallback(())


def test_cheaper_engines_take_the_stft_of_the_best():
    stft = StftConfig(n_fft=320, hop=160, window_length=320)
    ranked = fallbacks(SpectralSubtraction(stft), None)
    assert [(index.name, index.stft) for index in ranked] == [("ss", stft), ("linear", stft)]
    assert [index.name for index in fallbacks(Bypass(PAPER_STFT), None)] == ["bypass"]


def overloaded_stream(cost_s, budget_ms=8.0):
    clock = FakeClock()
    slow = Slow(clock.wait, cost_s)
    fallback = Fallback((slow, Bypass(), Quiet()))
    return slow, Stream(fallback, None, Stepping(HOP, fallback, budget_ms, clock))


def feed(stream, seconds):
    """Silence for so long; the kinds and times of what happened, seconds."""
    nothing = np.zeros(HOP, np.float32)
    before = stream.samples_in
    for _ in range(round(seconds * HOPS_A_SECOND)):
        stream.process(nothing, nothing)
    return [(event.kind, (event.sample - before) / SAMPLE_RATE) for event in stream.events if event.sample > before]


def test_a_slow_engine_is_left_within_a_second_and_taken_up_again_when_it_has_recovered():
    slow, stream = overloaded_stream(cost_s=0.030)
    ((kind, at),) = feed(stream, 5.0)
    assert kind == "stepped_down" and at < 0.3  # a quarter of a second's hops were late
    found = stream.stepping.stats()
    assert found["missed_deadlines"] == found["over_budget"] <= 0.25 * HOPS_A_SECOND + 1 + DOWN
    assert found["most_behind_ms"] == pytest.approx((30 - 16) * found["missed_deadlines"], rel=0.01)
    assert "from slow to bypass" in stream.events[0].detail and "8.0 ms" in stream.events[0].detail
    slow.cost_s = 0.001
    ((kind, at),) = feed(stream, 30.0)
    assert kind == "stepped_up" and at < PATIENCE_S
    assert "from bypass to slow" in stream.events[1].detail


def test_an_engine_over_the_budget_is_left_although_it_keeps_up():
    _, stream = overloaded_stream(cost_s=0.010)
    assert [kind for kind, _ in feed(stream, 5.0)] == ["stepped_down"]
    assert stream.stepping.stats()["missed_deadlines"] == 0


def test_a_single_stall_or_rare_late_hops_change_nothing():
    slow, stream = overloaded_stream(cost_s=0.001)
    for hop in range(600):
        slow.cost_s = 0.5 if hop == 100 else 0.012 if hop % 5 == 0 else 0.001
        feed(stream, HOP / SAMPLE_RATE)
    assert not stream.events and stream.stepping.stats()["missed_deadlines"] > 0


@pytest.mark.slow
def test_failed_attempts_to_step_up_become_rarer():
    _, stream = overloaded_stream(cost_s=0.030)
    happened = feed(stream, 600.0)
    up = [at for kind, at in happened if kind == "stepped_up"]
    waits = np.diff(up)
    expected = [min(PATIENCE_S * 2**n, MOST_PATIENCE_S) for n in range(1, waits.size + 1)]
    assert waits.size >= 4
    np.testing.assert_allclose(waits, expected, atol=2.0)  # each attempt itself takes a second
    assert len(happened) in (2 * len(up), 2 * len(up) + 1)  # down after each


def test_patience_is_short_again_after_an_engine_has_proved_itself():
    slow, stream = overloaded_stream(cost_s=0.030)
    feed(stream, 45.0)
    slow.cost_s = 0.001
    feed(stream, 90.0)
    assert stream.engine.wanted == 0
    slow.cost_s = 0.030
    feed(stream, 1.0)
    slow.cost_s = 0.001
    ((kind, at),) = feed(stream, 15.0)
    assert kind == "stepped_up" and at <= PATIENCE_S


def test_the_last_engine_too_slow_is_said_once():
    clock = FakeClock()
    stream = Stream(Slow(clock.wait, 0.020), None, Stepping(HOP, None, 8.0, clock))
    assert [kind for kind, _ in feed(stream, 10.0)] == ["overloaded"]
    assert stream.stepping.stats()["missed_deadlines"] == 625


@pytest.fixture
def busy_cores():
    """Every core has a process that does nothing but count."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(os.cpu_count() or 2)]
    yield
    for process in processes:
        process.kill()
        process.wait()


@pytest.mark.slow
def test_under_real_load_on_all_cores_a_slow_engine_is_left_and_no_sample_is_lost(busy_cores):
    """The slow engine sleeps longer than a hop, so that it is too slow on any machine; the real clock."""
    mic, ref = conformance.conversation(48_000)
    slow = Slow(time.sleep, 0.017)
    slow.front = "full"
    fallback = Fallback((slow, Linear()))
    stepped = Stream(fallback, None, Stepping(HOP, fallback))
    out = conformance.run(stepped, mic, ref, [160, 255, 1000])
    assert [event.kind for event in stepped.events if event.kind == "stepped_down"] == ["stepped_down"]
    assert stepped.stepping.stats()["missed_deadlines"] >= 0.25 * HOPS_A_SECOND
    alone = conformance.run(Stream(Linear()), mic, ref)
    assert out.size == mic.size
    np.testing.assert_array_equal(out[-24_000:], alone[-24_000:])


def test_ego_filter_counts_and_tells():
    mic, ref = conformance.conversation(24_000)
    plain, promised = EgoFilter(engine="ss"), EgoFilter(engine="ss", budget_ms=8.0)
    outs = [np.concatenate((ego.process(mic, ref), ego.flush())) for ego in (plain, promised)]
    assert outs[0].size == outs[1].size == mic.size
    assert plain.stats()["deadline"]["budget_ms"] == 16.0 and promised.stats()["deadline"]["budget_ms"] == 8.0
    assert promised.stats()["engines"] == ["ss", "linear"] and plain.stats()["engines"] == ["ss"]
    assert promised.engine_name == plain.engine_name == "ss"
    hurried = EgoFilter(engine="ss", budget_ms=1e-6)
    hurried.process(mic, ref)
    assert hurried.engine_name == "linear"


def test_hops_that_are_done_early_are_no_credit_for_one_that_is_late():
    stepping = Stepping(256)
    for _ in range(100):
        stepping.note(0.001)
    stepping.note(0.1)
    assert stepping.stats()["most_behind_ms"] == pytest.approx(84.0)


def test_histogram_percentiles_are_true_to_a_bin():
    rng = np.random.default_rng(0)
    times = Histogram()
    drawn = rng.lognormal(0.0, 1.0, 20_000)
    for ms in drawn:
        times.add(ms)
    for percent in (50, 95, 99):
        assert times.percentile(percent) == pytest.approx(np.percentile(drawn, percent), rel=0.05)  # the width of a bin
    assert times.max_ms == drawn.max() and times.sum_ms == pytest.approx(drawn.sum())
    assert Histogram().to_dict()["p99_ms"] == 0.0


@pytest.mark.slow
def test_a_full_garbage_collection_during_a_run_is_a_matter_of_microseconds():
    """Without setting aside what was loaded before it takes many milliseconds, a missed deadline."""

    def full_collection():
        began = time.thread_time()
        gc.collect()
        return time.thread_time() - began

    usual = min(full_collection() for _ in range(3))
    with garbage_of_this_run_only():
        during = min(full_collection() for _ in range(3))
        assert gc.get_freeze_count() > 10_000
    assert during < usual / 10 and gc.get_freeze_count() == 0
