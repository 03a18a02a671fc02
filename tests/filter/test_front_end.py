"""What the front end does to every spectrum."""

import numpy as np

from edgefilter import enhance
from edgefilter.engines.linear import Linear
from edgefilter.filter.front_end import RUMBLE, FrontEnd
from edgefilter.filter.residual_echo import Residual
from edgefilter.types import SAMPLE_RATE
from tests.engines.test_engines import robot


def test_without_a_profile_rumble_is_lowered_and_with_one_it_is_as_it_was():
    """A room at 40 Hz under a voice at 400 Hz; the robot is silent."""
    t = np.arange(2 * SAMPLE_RATE) / SAMPLE_RATE
    rumble, voice = ((0.1 * np.sin(2 * np.pi * hz * t)).astype(np.float32) for hz in (40, 400))
    steady = slice(SAMPLE_RATE // 2, -SAMPLE_RATE // 2)
    for profile, left in ((None, RUMBLE), (robot(), 1.0)):
        out = enhance(rumble + voice, np.zeros(t.size, np.float32), profile, "linear")[steady]
        for tone, gain in ((rumble, left), (voice, 1.0)):
            found = float(out.dot(tone[steady]) / tone[steady].dot(tone[steady]))
            assert abs(found - gain) < 0.05, (gain, found)  # a window's main lobe reaches 60 Hz beyond the tone


def test_all_spectra_of_a_frame_lose_the_same_rumble():
    """A mask is a ratio of them; one of them alone would be a wrong mask."""
    front, noise = FrontEnd(Linear(), None), np.random.default_rng(0).standard_normal(512).astype(np.float32)
    for hop in noise.reshape(2, -1):
        frame, _ = front.step(hop, 0 * hop)
    assert np.array_equal(frame.mic, frame.error)
    assert np.abs(frame.mic[0]) < 0.1 * np.abs(frame.mic[3:]).max()


def test_a_frame_says_whether_nothing_of_the_robot_can_be_heard():
    """Silent for a second, speaking for two, silent for three."""
    front, second = FrontEnd(Linear(), robot()), SAMPLE_RATE // 256
    ref = np.zeros(6 * second * 256, np.float32)
    ref[second * 256 : 3 * second * 256] = 0.1 * np.random.default_rng(0).standard_normal(2 * second * 256)
    mic = 0.5 * np.roll(ref, 1600)
    hops = zip(mic.reshape(-1, 256), ref.reshape(-1, 256), strict=True)
    idle = np.array([front.step(*hop)[0].idle for hop in hops])
    assert idle[:second].all() and not idle[second : 3 * second + 7].any() and idle[-second:].all()


def test_the_noise_is_found_again_after_a_microphone_was_muted():
    """An estimate that only grows by a factor could never rise from zero."""
    stft, rng = Linear().stft, np.random.default_rng(0)
    residual, silence = Residual(stft), np.zeros(stft.bins, np.float32)

    def expected(hops: int, level: float) -> float:
        for _ in range(hops):
            error = level * (rng.standard_normal(stft.bins) + 1j * rng.standard_normal(stft.bins)).astype(np.complex64)
            noise, _ = residual.step(silence.astype(np.complex64), error, silence)
        return float(noise.mean())

    before = expected(2000, 1e-4)
    assert expected(4000, 0.0) < 1e-4 * before
    assert expected(6000, 1e-4) > 0.5 * before
