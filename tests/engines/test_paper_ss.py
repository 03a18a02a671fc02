"""The paper's spectral subtraction against a slow oracle that is written straight from eq. (6) and (7)."""

import numpy as np
import pytest

from edgefilter.engines.paper_ss import PAPER_STFT, PaperSpectralSubtraction, smoothing_window
from edgefilter.errors import UsageError
from edgefilter.types import Frame

BINS = PAPER_STFT.bins


def frames(count, seed=0):
    rng = np.random.default_rng(seed)
    mic, ref = (rng.standard_normal((2, count, BINS)) + 1j * rng.standard_normal((2, count, BINS))).astype(np.complex64)
    return mic, ref


def oracle(mic, ref, response, alpha, beta, causal=False):
    """Whole recording, one number at a time, surrounded by silence (where eq. 6 says 1)."""
    window = smoothing_window()
    count = len(mic)
    out = np.zeros_like(mic)
    for t in range(count):
        for f in range(BINS):
            smooth = 0.0
            for dt in range(-3, 4):
                for df in range(-1, 2):
                    s, g = t + dt - (3 if causal else 0), f + df
                    if not 0 <= g < BINS:
                        sm = 0.0
                    elif not 0 <= s < count:
                        sm = 1.0
                    else:
                        sm = float(abs(mic[s, g]) <= alpha * abs(ref[s, g]) * response[g])
                    smooth += window[dt + 3, df + 1] * sm
            out[t, f] = beta * mic[t, f] * (1.0 - smooth)
    return out


def stream(engine, mic, ref):
    state, out = engine.initial_state(), []
    nothing = np.zeros(BINS, np.float32)
    silence = np.zeros(BINS, np.complex64)
    tail = [(silence, silence)] * engine.lookahead
    for m, r in [*zip(mic, ref), *tail]:
        answer, state = engine.step(Frame(m, r, silence, m, nothing, nothing), state)
        out.append(answer.spectrum)
    return np.array(out[engine.lookahead :])


@pytest.mark.parametrize("causal", [False, True])
def test_equals_the_oracle_in_every_bin_from_the_first_frame_to_the_last(causal):
    mic, ref = frames(11)
    response = np.linspace(0.2, 1.5, BINS, dtype=np.float32)
    got = stream(PaperSpectralSubtraction(response, alpha=1.3, beta=1.7, causal=causal), mic, ref)
    # 1e-5: float32 sums of 21 weights times spectra of size about 1
    np.testing.assert_allclose(got, oracle(mic, ref, response, 1.3, 1.7, causal), atol=1e-5)


def test_smoothing_window_is_seven_by_three_sums_to_one_and_has_no_zero_border():
    window = smoothing_window()
    assert window.shape == (7, 3)
    assert window.sum() == pytest.approx(1.0, abs=1e-12)  # float64 sum of 21 terms
    assert window.min() > 0
    np.testing.assert_allclose(window, window[::-1, ::-1], atol=1e-15)  # symmetric to float64 rounding


def test_a_human_far_above_the_robot_passes_and_a_robot_alone_is_removed():
    mic, ref = frames(20, seed=1)
    ones = np.ones(BINS, np.float32)
    engine = PaperSpectralSubtraction(ones, alpha=1.0, beta=1.0)
    human = stream(engine, mic, 1e-4 * ref)
    np.testing.assert_allclose(human[4:-4], mic[4:-4], rtol=1e-5)  # SM = 0 there; only float32 rounding is left
    robot = stream(engine, 0.5 * ref, ref)
    assert np.abs(robot[:, 1:-1]).max() < 1e-5  # SM = 1; the window sums to 1 within float32


def test_refuses_a_response_of_another_size():
    with pytest.raises(UsageError, match=r"shape \(257,\).*expects \(601,\)"):
        PaperSpectralSubtraction(np.ones(257, np.float32))
