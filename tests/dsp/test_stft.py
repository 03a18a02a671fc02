"""STFT: inverts, refuses what cannot be inverted, equals its definition."""

import numpy as np
import pytest

from edgefilter.dsp.stft import Analyser, StftConfig, Synthesiser
from edgefilter.errors import StftError

GOOD = [
    StftConfig(),
    StftConfig(320, 160, 320),
    StftConfig(1200, 160, 400, "hann"),
    StftConfig(512, 128, 512, "hann"),
    StftConfig(64, 64, 64, "rectangular"),
]


@pytest.mark.parametrize("config", GOOD, ids=str)
def test_synthesis_undoes_analysis_for_every_config(config):
    x = np.random.default_rng(0).standard_normal(20 * config.hop).astype(np.float32)
    analyser, synthesiser = Analyser(config), Synthesiser(config)
    out = np.concatenate([synthesiser.push(analyser.push(hop)[0]) for hop in x.reshape(-1, config.hop)])
    lag = config.window_length - config.hop
    # 2e-6: float32 rounding of FFT, inverse and windows, on samples of about 1
    np.testing.assert_allclose(out[lag:], x[: x.size - lag], atol=2e-6 * np.abs(x).max())
    assert np.abs(out[:lag]).max(initial=0) < 1e-6  # the silence before the start, same rounding


@pytest.mark.parametrize("config", [config for config in GOOD if config.hop < config.window_length], ids=str)
def test_synthesis_undoes_the_analysis_of_channels_that_are_late_without_any_delay(config):
    wait = 32
    x = np.random.default_rng(0).standard_normal(20 * config.hop).astype(np.float32)
    late = np.concatenate((np.zeros(wait, np.float32), x))[: x.size]
    analyser, synthesiser = Analyser(config), Synthesiser(config)
    out = np.concatenate([synthesiser.push(analyser.push(hop, wait=wait)[0]) for hop in late.reshape(-1, config.hop)])
    lag = config.window_length - config.hop
    np.testing.assert_allclose(out[lag:], x[: x.size - lag], atol=2e-6 * np.abs(x).max())


@pytest.mark.parametrize("config", GOOD, ids=str)
def test_a_frame_is_the_fft_of_the_windowed_zero_padded_segment(config):
    x = np.random.default_rng(1).standard_normal(30 * config.hop).astype(np.float32)
    analyser = Analyser(config)
    window = (
        np.hanning(config.window_length + 1)[:-1] if config.window != "rectangular" else np.ones(config.window_length)
    )
    window = np.sqrt(window) if config.window == "root-hann" else window
    for index, hop in enumerate(x.reshape(-1, config.hop)):
        frame = analyser.push(hop)[0]
        end = (index + 1) * config.hop
        segment = np.concatenate(
            (np.zeros(max(0, config.window_length - end)), x[max(0, end - config.window_length) : end])
        )
        np.testing.assert_allclose(
            frame, np.fft.rfft(segment * window, config.n_fft), atol=1e-4
        )  # float32 sums of up to 1200 terms


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ((512, 512, 512, "root-hann"), "cannot be inverted.*hop of at most 256"),
        ((512, 600, 512, "hann"), "cannot be inverted"),
        ((256, 128, 512, "hann"), "window_length <= n_fft"),
        ((512, 0, 512, "hann"), "hop >= 1"),
        ((512, 256, 512, "kaiser"), "window is 'kaiser', expected root-hann"),
    ],
)
def test_refuses_what_cannot_be_inverted(sizes, message):
    with pytest.raises(StftError, match=message):
        StftConfig(*sizes)


def test_noise_gain_is_the_power_of_white_noise_in_a_bin():
    config = StftConfig()
    analyser = Analyser(config)
    rng = np.random.default_rng(2)
    power = np.mean(
        [np.abs(analyser.push(rng.standard_normal(config.hop).astype(np.float32))[0, 1:-1]) ** 2 for _ in range(2000)]
    )
    assert power == pytest.approx(
        config.noise_gain(), rel=0.02
    )  # 255 x 2000 half-overlapping frames: standard error 0.2 %
