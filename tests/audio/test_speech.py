"""Speech that is played here and is the reference: what the device got is what is read, sample by sample."""

from types import SimpleNamespace

import numpy as np
import pytest

from edgefilter.audio.device import find
from edgefilter.audio.fade import FADE_S
from edgefilter.audio.live import LiveSource
from edgefilter.audio.pairing import TOLERANCE
from edgefilter.audio.port import SpokenReference
from edgefilter.audio.pulse import Device
from edgefilter.commands.run import limited
from tests.audio.virtual_portaudio import VirtualDevice

SPEECH = 0.5 * np.random.default_rng(3).standard_normal(48_000).astype(np.float32).clip(-1, 1)
FINE = SimpleNamespace(output_underflow=False)


class Loudspeaker:
    """PortAudio with one output device of a rate, whose callback the test calls itself."""

    PortAudioError = RuntimeError

    def __init__(self, rate, channels=1):
        self.rate, self.channels, self.played = rate, channels, []

    def check_output_settings(self, channels, samplerate, **settings):
        if (samplerate, channels) != (self.rate, self.channels):
            raise self.PortAudioError("no")

    def OutputStream(self, callback, **settings):
        self.callback = callback
        return SimpleNamespace(start=lambda: None)

    def ask(self, count, status=FINE):
        out = np.full((count, self.channels), np.nan, np.float32)
        self.callback(out, count, None, status)
        self.played.append(out)

    def sound(self):
        return np.concatenate(self.played)


def spoken(rate=16000, channels=1):
    loudspeaker = Loudspeaker(rate, channels)
    reference = SpokenReference(loudspeaker, Device(0, "speaker", 0, channels, rate), iter((SPEECH[:7], SPEECH[7:])))
    reference.open()
    return loudspeaker, reference


def test_what_is_played_is_read_and_nothing_is_played_before_the_first_read():
    loudspeaker, reference = spoken(channels=2)
    loudspeaker.ask(500)
    heard = [reference.take()]
    for _ in range(200):
        loudspeaker.ask(250)
        heard.append(reference.take())
    heard, played = np.concatenate(heard), loudspeaker.sound()
    np.testing.assert_array_equal(played[:, 0], heard)
    np.testing.assert_array_equal(played[:, 1], heard)
    np.testing.assert_array_equal(heard[:500], 0.0)
    np.testing.assert_array_equal(heard[500 : 500 + SPEECH.size], SPEECH)
    np.testing.assert_array_equal(heard[500 + SPEECH.size :], 0.0)


def test_a_reader_that_is_late_makes_a_gap_in_both_and_an_underflow_is_counted():
    loudspeaker, reference = spoken()
    reference.take()
    for _ in range(100):
        loudspeaker.ask(256, SimpleNamespace(output_underflow=True))  # 1.6 s, of which one waits
    heard = reference.take()
    np.testing.assert_array_equal(heard, loudspeaker.sound()[:, 0])
    assert np.all(heard[-4000:] == 0.0) and reference.inlet.flags == 100


@pytest.mark.parametrize("gain", [0.0, 10**-0.5])
def test_a_lower_gain_comes_within_its_time_without_a_click_and_is_in_the_reference(gain):
    loudspeaker, reference = spoken()
    reference.take()
    for block in range(60):
        if block == 20:
            reference.fade(gain)
        if block == 40:
            reference.fade(1.0)
        loudspeaker.ask(256)
    played = loudspeaker.sound()[:, 0]
    np.testing.assert_array_equal(played, reference.take())
    faded = round(FADE_S * 16000)
    gains = np.median(played / SPEECH[: played.size].reshape(1, -1), axis=0)
    np.testing.assert_allclose(gains[: 20 * 256], 1.0)
    np.testing.assert_allclose(gains[20 * 256 + faded : 40 * 256], gain, rtol=1e-5)
    np.testing.assert_allclose(gains[40 * 256 + faded :], 1.0, rtol=1e-5)
    assert np.abs(np.diff(gains)).max() < 1.01 / faded


def test_a_device_of_another_rate_plays_all_of_it_and_is_read_at_16_khz():
    loudspeaker, reference = spoken(rate=48000)
    heard = [reference.take()]
    for _ in range(320):
        loudspeaker.ask(480)
        heard.append(reference.take())
    heard = np.concatenate(heard)
    assert np.mean(np.square(loudspeaker.sound())) * 320 * 480 == pytest.approx(
        3 * np.sum(SPEECH**2), rel=0.06
    )  # the resampler leaves out the last 5 % of the band
    lags = np.correlate(heard[:1500], SPEECH[:1000], "valid")
    lag = int(np.argmax(lags))
    error = heard[lag : lag + 40_000] - SPEECH[:40_000]
    assert lag < 200 and np.mean(error**2) < 0.1 * np.mean(SPEECH**2)  # twice that


@pytest.mark.parametrize("stall_s", [0.1, 0.6])
def test_speech_that_a_stalled_device_plays_later_is_in_the_reference_later_and_whole(plug, stall_s):
    """The counter of what is played stands still meanwhile; what comes after it was not late, it was played then."""
    mic, speaker = VirtualDevice("mic", "input"), VirtualDevice("speaker", "output")
    system = plug(mic, speaker)
    spoken = np.arange(1, 16_000 * 8 + 1, dtype=np.float32) / 2**18
    reference = SpokenReference(system, find("speaker", "output"), iter((spoken,)))
    system.at(2.0, lambda: setattr(speaker, "swallows", stall_s))
    with LiveSource("mic", reference) as source:
        heard = np.concatenate([block.ref for block in limited(source, 9 * 16_000)])
    np.testing.assert_array_equal(heard[heard > 0], spoken)
    silent = np.flatnonzero(heard[: 8 * 16_000 + round(16_000 * stall_s)] == 0.0)
    assert silent.size == pytest.approx(16_000 * stall_s, abs=TOLERANCE + 160) and np.ptp(silent) < 16_000
